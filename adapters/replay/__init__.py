"""What is on disk, derived again: the records of a log one by one, the tables of a folder trial by trial."""

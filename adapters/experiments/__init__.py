"""Experiments: agents on the same seeds, measured and compared."""

"""The command line `mapek`."""

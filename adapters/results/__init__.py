"""Results on disk: a folder per run, written so that nothing is ever half there."""

from adapters.results.folder import RunFolder
from adapters.results.table import COLUMNS, read_episodes

__all__ = ["COLUMNS", "RunFolder", "read_episodes"]

"""Where Knowledge keeps what must outlive its process."""

from adapters.stores.sqlite_store import SCHEMA, Event, Snapshot, Store, Swap

LOG_NAME = "log.sqlite"
"""Name of Knowledge's file in the folder of a run."""

__all__ = ["LOG_NAME", "SCHEMA", "Event", "Snapshot", "Store", "Swap"]

"""Where Knowledge keeps what must outlive its process."""

from adapters.stores.sqlite_store import SCHEMA, Event, Snapshot, Store, Swap

__all__ = ["SCHEMA", "Event", "Snapshot", "Store", "Swap"]

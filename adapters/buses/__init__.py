"""Buses between processes."""

from adapters.buses.wire import Wire
from adapters.buses.zenoh_bus import ZenohBus
from adapters.buses.zenoh_hub import KnowledgeHub

__all__ = ["KnowledgeHub", "Wire", "ZenohBus"]

"""Monitor: holds the return stream and the tests over it."""

from mape.monitor.component import Monitor

__all__ = ["Monitor"]

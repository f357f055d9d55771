"""Execute: drives the managed system, learns, and is the Q-table's only writer."""

from mape.execute.component import Execute

__all__ = ["Execute"]

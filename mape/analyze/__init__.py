"""Analyze: turns readings and action sets into events."""

from mape.analyze.component import Analyze

__all__ = ["Analyze"]

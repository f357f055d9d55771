"""Plan: decides on the exploration rate, the learning rate and the action set of the next episode."""

from mape.plan.component import Plan

__all__ = ["Plan"]

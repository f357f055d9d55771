"""Conformance checks for parts of your own. They need no pytest; `mapek check` prints what they find.

Each check takes a function that makes a fresh part, puts a number of such parts through a fixed script, and returns
one `Finding` per clause of the contract in `mape.ports`:

>>> from mape.monitor.page_hinkley import PageHinkley, PageHinkleyConfig
>>> for finding in check_detector(lambda: PageHinkley(PageHinkleyConfig())):
...     print(finding)
ok      has the members of the port
ok      gives plain readings: a bool, and a finite statistic or None
ok      is deterministic: two fresh ones agree, step by step
ok      gives its state as plain JSON, and as a copy
ok      takes up where its state was given, fresh or used
ok      forgets on reset the values that it has seen
ok      has a rule that does what its methods do, in Python and compiled

In a test of your own, ``require(check_detector(make))`` raises where a clause is broken.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from mape.testing.clauses import Finding, require
from mape.testing.decisions import check_analyzer, check_planner, check_schedule
from mape.testing.detectors import check_detector
from mape.testing.learners import check_learner
from mape.testing.plants import check_plant
from mape.testing.systems import check_system

__all__ = [
    "CHECKS",
    "Finding",
    "check_analyzer",
    "check_detector",
    "check_learner",
    "check_planner",
    "check_plant",
    "check_schedule",
    "check_system",
    "require",
]

CHECKS: dict[str, Callable[[Callable[[], Any]], list[Finding]]] = {
    "detector": check_detector,
    "analyzer": check_analyzer,
    "schedule": check_schedule,
    "planner": check_planner,
    "learner": check_learner,
    "system": check_system,
}
"""The check of each kind of part, under the kind's name in `mape.registry`."""

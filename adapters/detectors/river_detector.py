"""Any drift detector of River (https://riverml.xyz, the package `river`) as a detector of the loop.

River's detectors offer no state to write down. So the values seen since the last reset are kept, and `restore` feeds
them to a fresh detector again. That is exact as long as all of them are kept; to bound the memory, each time `memory`
values have come without a reset, the older half is dropped and a fresh detector is fed the newer half. From then on
the test knows that half only, in the running process just as in a restored one. It forgets, and it forgets the same
everywhere; with `memory` above the length of a run it forgets nothing.

Tests of an error rate (`ERROR_RATE`) were made for a classifier's mistakes, 1 for an error, and alarm when errors
become more frequent. A return of 0 and 1 is the other way round, 1 for success: with ``invert = true`` the test sees
``1 - x``, and alarms when success becomes rarer. FHDDM is the exception: River's text says that it takes 1 as an error
too, but its code alarms when ones become rarer, so it watches a return as it is. Each side is held by a test.
"""

from __future__ import annotations

import functools
import importlib
import inspect
import math
from typing import Any

from pydantic import Field, ValidationInfo, field_validator

from knowledge.records import Direction
from mape.errors import ConfigError, UnknownName
from mape.specs import PartConfig

STATISTICS = {"ADWIN": "estimation", "KSWIN": "p_value"}
"""Public attributes of River's that say what the test sees now; its other detectors expose none."""

ERROR_RATE = ("DDM", "EDDM", "HDDMA", "HDDMW")
"""Detectors of River that take 1 as an error, and alarm when ones become more frequent."""

SUCCESS_RATE = ("FHDDM",)
"""Those that alarm when ones become rarer."""

_MIRRORED: dict[Direction, Direction] = {"down": "up", "up": "down", "unknown": "unknown"}


@functools.cache
def _classes() -> dict[str, Any]:
    """Return River's drift detectors by name, those for streams of 0 and 1 included."""
    # Imported when used: River is an optional extra, and takes a second or two.
    modules = [importlib.import_module(name) for name in ("river.drift", "river.drift.binary")]
    bases = importlib.import_module("river.base")
    kinds = (bases.DriftDetector, bases.BinaryDriftDetector)
    # From `vars`: River's `__all__` has named classes that were not there.
    return {
        name: found
        for module in modules
        for name, found in vars(module).items()
        if inspect.isclass(found) and issubclass(found, kinds) and not inspect.isabstract(found)
    }


def river_class(name: str) -> Any:
    """Return the class of River's drift detector `name`.

    Raises
    ------
    ConfigError
        River is not installed.
    UnknownName
        It has no such detector.
    """
    try:
        classes = _classes()
    except ModuleNotFoundError as error:
        raise ConfigError(
            f"River's detector {name!r} needs the package {(error.name or 'river').partition('.')[0]!r}, which is not "
            "installed: pip install river"
        ) from None
    if name not in classes:
        raise UnknownName("detector of River", name, classes)
    return classes[name]


class RiverConfig(PartConfig):
    """Options of `RiverDetector`."""

    detector: str = Field("ADWIN", min_length=1, description="name of the class in river.drift or river.drift.binary")
    options: dict[str, Any] = Field(default_factory=dict, description="its parameters, under River's names")
    memory: int = Field(10_000, ge=2, description="values kept since the last reset, 8 bytes each; see the module")
    invert: bool = Field(False, description="let the test see 1 - x, for tests that take 1 as an error")

    @field_validator("detector")
    @classmethod
    def _exists(cls, detector: str) -> str:
        try:
            river_class(detector)
        except ConfigError as error:
            raise ValueError(str(error)) from None
        return detector

    @field_validator("options")
    @classmethod
    def _fit(cls, options: dict[str, Any], info: ValidationInfo) -> dict[str, Any]:
        if "detector" in info.data:
            detector = info.data["detector"]
            legal = inspect.signature(river_class(detector)).parameters
            for name, value in options.items():
                if name not in legal:
                    raise ValueError(str(UnknownName(f"option of River's {detector}", name, legal)))
                if isinstance(value, float) and not math.isfinite(value):
                    raise ValueError(f"{name} = {value} is not a finite number")
        return options


class RiverDetector:
    """A drift detector of River.

    Its `direction` is ``"unknown"``, but for a PageHinkley whose `mode` says which side it watches, and for a test of
    an error rate that `invert` turns to the other side. Where a detector takes a `seed` and none is given, it is 0: two
    runs must agree.

    Examples
    --------
    >>> test = RiverDetector(RiverConfig(detector="ADWIN", options={"delta": 0.002}))
    >>> alarms = [test.update(x) for x in [0.0] * 100 + [5.0] * 100]
    >>> alarms.index(True), test.direction
    (127, 'unknown')
    >>> test = RiverDetector(RiverConfig(detector="DDM", invert=True))
    >>> alarms = [test.update(x) for x in [1.0] * 100 + [0.0] * 100]
    >>> any(alarms), test.direction
    (True, 'down')
    """

    Config: type[PartConfig] = RiverConfig

    def __init__(self, config: RiverConfig) -> None:
        self.config: PartConfig = config
        self._set_up(config.detector, dict(config.options), config.memory, invert=config.invert)

    def _set_up(self, name: str, options: dict[str, Any], memory: int, *, invert: bool = False) -> None:
        self._class = river_class(name)
        if "seed" in inspect.signature(self._class).parameters:
            options.setdefault("seed", 0)
        self._options = options
        self._memory = memory
        self._statistic = STATISTICS.get(name)
        self._binary = self._class.__module__.startswith("river.drift.binary")
        self._invert = invert
        # The side of the values that the test sees; a two-sided one has none.
        side: Direction = "unknown"
        if name == "PageHinkley" and options.get("mode") in ("down", "up"):
            side = options["mode"]
        elif self._binary and not options.get("two_sided_test"):
            side = "up" if name in ERROR_RATE else "down" if name in SUCCESS_RATE else "unknown"
        self._side = _MIRRORED[side] if invert else side
        # Of a test for 0 and 1 that is not inverted it has always been "unknown", and stands so in the hashes of logs.
        self.direction: Direction = self._side if invert or not self._binary else "unknown"
        self.reset()

    def caution(self, signal: str) -> str | None:
        """Say what is odd where this test watches `signal`; None where nothing is."""
        if signal != "return" or not self._binary or self._side != "up":
            return None
        set_to, other = ("true", "false") if self._invert else ("false", "true")
        return (
            f"River's {self._class.__name__} with invert = {set_to} alarms when ones become more frequent, as a rate "
            f"of errors does: of a return it sees the rise, and never the fall. Give it invert = {other}, or a signal "
            "on which 1 is an error."
        )

    @property
    def statistic(self) -> float | None:
        """What River's detector exposes: ADWIN the mean of its window, KSWIN its p-value; else None."""
        return None if self._statistic is None else float(getattr(self._test, self._statistic))

    def update(self, x: float) -> bool:
        """Take one value, as ``1 - x`` where `invert` is set; say whether the test alarms.

        Raises
        ------
        ValueError
            The test is for streams of 0 and 1, and `x` is neither.
        """
        if self._binary and x not in (0.0, 1.0):
            raise ValueError(f"River's {self._class.__name__} watches a signal of 0 and 1, got {x}")
        if self._invert:
            x = 1.0 - x
        self._signal.append(x)
        if len(self._signal) > self._memory:
            self._replay(self._signal[-(self._memory // 2) :])
        else:
            self._test.update(x)
        return bool(self._test.drift_detected)

    def reset(self) -> None:
        """Forget everything."""
        self._replay([])

    def state(self) -> dict[str, list[float]]:
        """Return the values that the test saw since the last reset, as many as are kept."""
        return {"signal": list(self._signal)}

    def restore(self, state: Any) -> None:
        """Take up where `state` was given, by feeding a fresh detector the same values."""
        self._replay([float(x) for x in state["signal"]])

    def _replay(self, signal: list[float]) -> None:
        # Constructed anew, not cloned: River's clone copies the seed's generator where it has been used.
        self._test = self._class(**self._options)
        for x in signal:
            self._test.update(x)
        self._signal = signal


class AdwinConfig(PartConfig):
    """Options of `Adwin`."""

    delta: float = Field(0.002, gt=0, lt=1, description="significance; smaller is more cautious")
    clock: int = Field(32, ge=1, description="passes between two looks")
    max_buckets: int = Field(5, ge=1, description="buckets of each size")
    min_window_length: int = Field(5, ge=1, description="fewest values in a sub-window")
    grace_period: int = Field(10, ge=1, description="fewest values before the first look")
    memory: int = Field(10_000, ge=2, description="values kept since the last reset, 8 bytes each; see the module")


class Adwin(RiverDetector):
    """ADWIN: keeps a window whose halves agree, and alarms when they do not (Bifet & Gavaldà, SDM 2007). Two-sided."""

    Config = AdwinConfig

    def __init__(self, config: AdwinConfig) -> None:
        self.config = config
        options = config.model_dump()
        self._set_up("ADWIN", options, options.pop("memory"))

"""Other people's drift detectors, under the loop's detector port."""

from mape import registry

__all__ = ["register"]


def register() -> None:
    """Give these detectors their short names; a second call changes nothing.

    >>> register()
    >>> registry.PARTS["detector"]["adwin"].summary
    "River's ADWIN: adaptive window, both sides; needs the package river"
    """
    home = "adapters.detectors.river_detector"
    registry.register(
        "detector",
        "river",
        f"{home}:RiverDetector",
        "any drift detector of River by name; DDM, EDDM, HDDMA, HDDMW take 1 as an error (invert = true for a return "
        "of 0 and 1); needs the package river",
    )
    registry.register(
        "detector", "adwin", f"{home}:Adwin", "River's ADWIN: adaptive window, both sides; needs the package river"
    )

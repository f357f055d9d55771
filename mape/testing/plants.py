"""The contract of a plant: a managed system that is not driven unasked, and of which there is one."""

from __future__ import annotations

from mape.ports import ManagedSystem
from mape.testing.clauses import Finding, Noted, judge
from mape.testing.systems import MEMBERS, describe, play_at_random


def check_plant(plant: ManagedSystem, episodes: int = 0) -> list[Finding]:
    """Check a system whose episodes cannot be driven again: by what it says, and by as many episodes as one asks for.

    Parameters
    ----------
    plant
        The only one; nothing is done to it beyond these episodes.
    episodes
        How many are driven, by random actions, from number 1 on.
    """

    def plays() -> None:
        if not episodes:
            raise Noted("nothing was driven: it cannot be driven again, so it is left alone unless --drive N asks")
        for number in range(1, episodes + 1):
            play_at_random(plant, number)

    def repeats() -> None:
        raise Noted(
            "not redrivable, as it says itself (redrivable = False): an episode that is broken off is not driven "
            "again, and a run is not taken up elsewhere to the same bits"
        )

    return judge(
        lambda: plant,
        MEMBERS,
        [
            ("describes itself in numbers", lambda: describe(plant)),
            ("stays within its states, with finite rewards and known actions", plays),
            ("plays an episode the same whatever was played before", repeats),
        ],
    )

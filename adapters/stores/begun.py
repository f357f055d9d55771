"""Which episode of each loop was begun, and how often one was broken off: of systems that cannot be driven again."""

from __future__ import annotations

from adapters.stores.ledger import Ledger
from adapters.stores.sqlite_store import Store

_BEGUN, _FAILED = "begun", "failed"


def begins(store: Store, loop: int, number: int) -> None:
    """Write that episode `number` of a loop is begun; only the last of them counts."""
    store.set_facts(**{_BEGUN: {**store.facts().get(_BEGUN, {}), str(loop): number}})


def breaks_off(ledger: Ledger, text: str, loop: int, number: int) -> None:
    """Note that an attempt at episode `number` of a loop is over, and why; it counts until the episode is driven."""
    facts = ledger.store.facts()
    begun, failed = facts.get(_BEGUN, {}), facts.get(_FAILED, {})
    times = failures(ledger.store, loop, number) + 1
    ledger.store.set_facts(
        **{_BEGUN: {**begun, str(loop): number - 1}, _FAILED: {**failed, str(loop): [number, times]}}
    )
    ledger.note("execute", "aborted", text, loop, number)


def begun(store: Store, loop: int) -> int:
    """Return the last episode of a loop that was begun and is not known to be broken off, 0 for none."""
    return int(store.facts().get(_BEGUN, {}).get(str(loop), 0))


def failures(store: Store, loop: int, number: int) -> int:
    """Return how many attempts at episode `number` of a loop were broken off."""
    episode, times = store.facts().get(_FAILED, {}).get(str(loop), (0, 0))
    return int(times) if episode == number else 0


def go_on(ledger: Ledger) -> None:
    """Note what was broken off with the processes of an earlier life, and allow as many attempts as ever.

    For whoever lets a run go on: that an episode is begun anew is what was asked for.
    """
    for loop in range(ledger.units):
        # Who runs freely may have driven several of which no Observation came.
        for number in range(begun(ledger.store, loop), ledger.last(loop)[0], -1):
            breaks_off(ledger, f"{BROKEN_OFF.format(number)}; it is begun anew", loop, number)
    if ledger.store.facts().get(_FAILED):
        ledger.store.set_facts(**{_FAILED: {}})
    ledger.commit()


BROKEN_OFF = "episode {} was broken off with its process, and the system cannot be driven through it again"
"""What is noted of an attempt of which nobody could tell more."""

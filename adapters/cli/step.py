"""`mapek step`: a run, record by record."""

from __future__ import annotations

import argparse
import sys

from adapters.cli.common import caution, config_of, prepare
from adapters.cli.sentences import sentence
from adapters.systems import make_system
from knowledge import ChangePlan, Observation
from mape.errors import ConfigError
from mape.loop import Loop
from mape.swap import swap_sentence

HELP = "Enter: next record; a number: run to that pass; q: leave"


def execute(chosen: argparse.Namespace) -> int:
    """Run the command."""
    prepare()
    config = config_of(chosen.config, chosen, chosen.agent)
    if chosen.first > config.episodes:
        raise ConfigError(f"--from {chosen.first} goes beyond the run's {config.episodes} episodes")
    caution([config])
    loop = Loop(config, make_system(config.system))
    loop.on_swap(lambda swap, handed_over: print(swap_sentence(swap, handed_over)))
    try:
        print(f"{config.name}, {config.unit_name(0, 0)}, seed {config.seed}. {HELP}.")
        if chosen.first > 1:
            loop.run(chosen.first - 1)
        while loop.log.passes < config.episodes:
            answer = _ask(f"[pass {loop.log.passes + 1}] ")
            if answer is None or answer in ("q", "quit", "exit"):
                return 0
            if answer:
                _run_to(loop, answer, config.episodes)
                continue
            record = loop.advance()
            if isinstance(record, Observation):
                print(f"--- pass {record.pass_no}")
            elif isinstance(record, ChangePlan) and record.pass_no == 0:
                print("--- start")
            print(sentence(record))
        # The last plan drives no episode, but is a record of its pass.
        while (left := loop.bus.deliver()) is not None:
            print(sentence(left))
        print(f"the run ends after {config.episodes} passes. log {loop.log.sha256()}")
    finally:
        loop.system.close()
    return 0


def _ask(prompt: str) -> str | None:
    try:
        return input(prompt).strip()
    except EOFError:
        print()
        return None


def _run_to(loop: Loop, answer: str, episodes: int) -> None:
    if not answer.isdecimal() or not loop.log.passes < int(answer) <= episodes:
        print(f"{answer!r} is no pass from {loop.log.passes + 1} to {episodes}. {HELP}.", file=sys.stderr)
        return
    while loop.bus.deliver() is not None:
        pass  # the pass that is open is finished first
    loop.run(int(answer) - 1 - loop.log.passes)

"""Five roles over TLS, each on a host of its own, and nothing between them but a switch of this test."""

import itertools
import json
from contextlib import ExitStack, contextmanager

from real_processes import EXAMPLES, ROLES, hashes, serve, until, write_config
from real_runs import MAPEK
from user_space_switch import Switch

from adapters.buses import certificates
from adapters.systems import make_system
from mape import load, run_trial
from mape.config import from_table, merge

HOSTS = (*ROLES, "operator")
PORT = 7447


def grid(episodes, table=None, *, side=9):
    """Return a config of goals in a grid, of which a Q-table takes 32 bytes a cell."""
    base = json.loads(load(EXAMPLES / "gridworld_goals.toml").to_json())
    over = {
        "episodes": episodes,
        "system": {"options": {"switch_at": [episodes // 2 + 1]}},
        "monitor": {"detectors": [{"name": "page_hinkley", "signal": "return", "delta": 0.5, "threshold": 60.0}]},
    }
    if side != 9:
        over["system"]["options"] |= {"size": [side, side], "goals": [[0, 0], [side - 1, side - 1]]}
    return json.loads(from_table(merge(merge(base, over), table or {}), "the grid").to_json())


def alone(table):
    """Return the hashes of a config as one process makes them."""
    config = from_table(table, "alone")
    units = itertools.product(range(config.trials), range(config.loops))
    found = [run_trial(config, trial, make_system, loop=loop) for trial, loop in units]
    return [(one.log_sha256, one.q_table_sha256) for one in found]


class Deployment:
    """A config over a switch; `start` starts a role on its host."""

    def __init__(self, folder, table, switch, opened, *options):
        self.folder, self.switch, self.opened, self.options = folder, switch, opened, options
        self.config = write_config(folder, table)
        self.keys = folder / "keys"
        certificates.make(self.keys, [switch.addresses["knowledge"]])
        self.served = {}

    @property
    def endpoint(self):
        return f"tcp/{self.switch.addresses['knowledge']}:{PORT}"

    def start(self, role, *options):
        where = f"tcp/0.0.0.0:{PORT}" if role == "knowledge" else self.endpoint
        self.served[role] = self.opened.enter_context(
            serve(
                self.config, role, where, "--tls", str(self.keys), *self.options, *options,
                start=[*self.switch.start(role), *MAPEK],
            )
        )  # fmt: skip

    def start_all(self):
        for role in ROLES:
            self.start(role)

    @property
    def log(self):
        return self.folder / "served" / "log.sqlite"

    def said(self):
        return "\n".join(f"--- {role}: {process.said[-1500:]}" for role, process in self.served.items())

    def end(self, within=600.0):
        """Wait until all have ended, each with exit code 0, and return the hashes of their run."""

        def ended_or_failed():
            codes = [process.process.poll() for process in self.served.values()]
            return None not in codes or any(codes)

        try:
            until(ended_or_failed, "the end of the run", within, every=0.1)
            for process in self.served.values():
                process.end()
        except AssertionError as error:
            raise AssertionError(f"{error}\n{self.said()}\n{self.switch.seen}") from None
        return hashes(json.loads((self.folder / "served" / "result.json").read_bytes()))

    def cut(self, *names, there=True, back=True):
        """Cut the lines between Knowledge and others, or have them pass again."""
        for name in names:
            to, back_from = self.switch.between(name, "knowledge")
            to.cut, back_from.cut = there, back


@contextmanager
def deployed(folder, table, *options, seed=0, **line):
    with ExitStack() as opened:
        switch = opened.enter_context(Switch(HOSTS, seed, **line))
        yield Deployment(folder, table, switch, opened, *options)

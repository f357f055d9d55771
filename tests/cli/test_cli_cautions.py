"""What the commands say once, on standard error, of what runs and yet is hardly meant."""

from pathlib import Path

import pytest
from command_line import Mapek

QUIETLY = ("--no-figures", "-q", "--set", "episodes=2")
WATCH = "monitor.detectors=[{name='river', detector='DDM', signal='SIGNAL'INVERT}]"


def watching(signal: str = "return", invert: str = "") -> tuple[str, str]:
    return "--set", WATCH.replace("SIGNAL", signal).replace("INVERT", invert)


@pytest.fixture
def bits(here: Path) -> str:
    (here / "bits.py").write_text(
        "import gymnasium\n"
        "from gymnasium.spaces import Discrete\n\n\n"
        "class Bits(gymnasium.Env):\n"
        "    observation_space, action_space = Discrete(1), Discrete(2)\n\n"
        "    def reset(self, *, seed=None, options=None):\n"
        "        super().reset(seed=seed)\n"
        "        return 0, {}\n\n"
        "    def step(self, action):\n"
        "        return 0, float(action), True, False, {}\n\n\n"
        "gymnasium.register('Bits-v0', Bits, max_episode_steps=1)\n"
    )
    (here / "bits.toml").write_text("episodes = 2\nsystem.id = 'bits:Bits-v0'\n[agents.one]\n[agents.two]\n")
    return "bits.toml"


@pytest.mark.parametrize("command", [("run", "--trials", 3, "--workers", 2), ("compare", "--trials", 2)])
def test_a_test_of_errors_that_watches_the_return_is_said_once(
    command: tuple[object, ...], bits: str, mapek: Mapek
) -> None:
    name, *options = command
    outcome = mapek(name, bits, *options, *QUIETLY, *watching())

    assert outcome.code == 0, outcome.err
    assert outcome.err.count("caution: detector 'river' on signal 'return'") == 1
    assert "Give it invert = true" in outcome.err


def test_nothing_is_said_of_an_inverted_one(bits: str, mapek: Mapek) -> None:
    outcome = mapek("run", bits, *QUIETLY, *watching(invert=", invert=true"))

    assert (outcome.code, "caution" in outcome.err) == (0, False)


def test_the_list_says_which_detectors_take_one_as_an_error(mapek: Mapek) -> None:
    (line,) = (line for line in mapek("list").out.splitlines() if line.split()[:2] == ["detector", "river"])

    assert all(name in line for name in ("DDM", "EDDM", "HDDMA", "HDDMW", "invert = true"))
    assert "FHDDM" not in line

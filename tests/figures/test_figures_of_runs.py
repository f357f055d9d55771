"""A figure of a run tells what is in its tables and its log, each number at its own episodes."""

import math
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from gymnasium.spaces import Discrete
from PIL import Image

from adapters.cli.main import main
from adapters.experiments import pictures
from adapters.experiments.runner import run_agents
from adapters.results import RunFolder
from adapters.systems import make_system
from mape.config import from_table
from mape.trials import run_trial

EPISODES = 120
FALL, BACK = 51, 71


def outcome(episode: int) -> float:
    return -3.0 if FALL <= episode < BACK else 7.0


class Fall(gymnasium.Env):
    """Its return falls at one episode and is back at another, whatever is done."""

    observation_space, action_space = Discrete(1), Discrete(2)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.episode = (options or {}).get("episode", 1)
        return 0, {}

    def step(self, action):
        return 0, outcome(self.episode), True, False, {}


gymnasium.register("FallForFigures-v0", Fall, max_episode_steps=1)


def fall(**over):
    return from_table({"name": "fall", "episodes": EPISODES, "system": {"id": "FallForFigures-v0"}, **over})


@pytest.fixture
def figure_of(tmp_path, monkeypatch):
    """Run a config, draw it, and return a figure of it by the name of its files."""

    def draw(name, config, trace=None):
        figures = {}
        monkeypatch.setattr(pictures, "_put", lambda folder, figure, name: figures.update({name: figure}) or [])
        folder = RunFolder(tmp_path / "out", "run", {"fall": config}, trace)
        try:
            run_agents({"fall": config}, folder, workers=1, quiet=True, trace=trace)
            pictures.pictures_of_run(folder, "fall")
        finally:
            folder.close()
        return figures[name]

    return draw


def by_gid(owner, gid):
    return owner.findobj(lambda artist: artist.get_gid() == gid)


@pytest.mark.parametrize("trials", [1, 4, 100])
def test_each_mean_is_drawn_over_the_episodes_that_it_is_the_mean_of(figure_of, trials):
    figure = figure_of("learning_curve", fall(trials=trials))
    (line,) = by_gid(figure, "fall")
    edges, drawn = np.asarray(line.get_xdata()), np.asarray(line.get_ydata())
    assert line.get_drawstyle() == "steps-post"
    assert (edges[0], edges[-1]) == (0.5, EPISODES + 0.5)
    for left, right, mean in zip(edges, edges[1:], drawn, strict=False):
        inside = range(math.ceil(left), math.ceil(right))
        assert mean == pytest.approx(np.mean([outcome(e) for e in inside])), inside
    if trials == 100:
        assert len(edges) == EPISODES + 1, "many trials need no smoothing"
    assert len(by_gid(figure, "episodes")) == (trials == 1), "the episodes of a single trial stand beside"


WATCHED = [
    {"name": "page_hinkley", "threshold": 12.0},
    {"name": "two_window", "reference": 6, "recent": 3, "threshold": 2.0},
    {"name": "oracle", "episodes": [FALL + 1]},
]
SWAP = {"pass": 60, "part": "monitor.0", "to": {"name": "page_hinkley", "threshold": 25.0}}


@pytest.mark.parametrize("trace", [(1, EPISODES), (45, 80)])
def test_statistics_and_thresholds_are_those_of_the_log_and_alarm_where_it_does(figure_of, trace):
    config = fall(monitor={"detectors": WATCHED}, swap=[SWAP])
    figure = figure_of("internal_dynamics", config, trace)
    kept = []
    result = run_trial(config, 0, make_system, on_rows=lambda rows: kept.append(rows.copy()))
    rows = np.concatenate(kept)[trace[0] - 1 : trace[1]]
    statistics, thresholds = (by_gid(figure, name) for name in ("statistic", "threshold"))
    assert len(statistics) == len(thresholds) == 2, "the oracle exposes none"
    for k, (statistic, threshold) in enumerate(zip(statistics, thresholds, strict=True)):
        drawn, held = statistic.get_data().values, threshold.get_data().values
        np.testing.assert_array_equal(drawn, rows["statistic"][:, k])
        expected = [12.0 if n < 60 else 25.0 for n in rows["pass"]] if k == 0 else [2.0] * len(rows)
        np.testing.assert_array_equal(held, expected)
        np.testing.assert_array_equal(drawn > held, rows["alarm"][:, k])
    ends = statistics[0].get_data().edges[1:]
    alarms = [a for a in result.alarms if trace[0] <= a <= trace[1]]
    assert len(alarms) > 1
    for lines in by_gid(figure, "alarm"):
        assert [segment[0][0] for segment in lines.get_segments()] == [ends[a - trace[0]] for a in alarms]
    assert sum(text.get_text() == "exposes no statistic" for axes in figure.axes for text in axes.texts) == 1


def metadata(folder: Path):
    with Image.open(folder / "figures" / "learning_curve.png") as image:
        return dict(image.text)


def test_a_file_of_a_figure_names_its_run_and_is_the_same_wherever_it_is_made(tmp_path, capsys):
    config = Path(__file__).parents[2] / "examples" / "jump.toml"
    for name, seed in (("one", 1), ("two", 1), ("three", 2)):
        options = ["--seed", str(seed), "--set", "episodes=30", "--quiet", "--out", str(tmp_path / name)]
        assert main(["run", str(config), *options]) == 0
    one, two, three = (tmp_path / name for name in ("one", "two", "three"))
    (log,) = {line.split()[1] for line in capsys.readouterr().out.splitlines()[:20] if line.startswith("log:")}
    about = metadata(one)
    assert log in about["Description"]
    assert "seed 1" in about["Description"]
    assert "jump" in about["Title"]
    assert about["Software"].startswith("mapek ")
    assert metadata(three)["Description"] != about["Description"]
    for ending in ("png", "pdf"):
        first, again = ((path / "figures" / f"learning_curve.{ending}").read_bytes() for path in (one, two))
        assert first == again
    pdf = (one / "figures" / "learning_curve.pdf").read_bytes()
    assert log.encode() in pdf
    assert b"/Title" in pdf

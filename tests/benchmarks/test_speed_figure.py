"""The figure of speed: measured, drawn, and its numbers beside it."""

import json

import c_reference
import figure_of_speed
import pytest

pytestmark = pytest.mark.skipif(c_reference.compiler() is None, reason="there is no C compiler")
TINY = figure_of_speed.Sweep(trials=(1, 2), sides=(9, 12), actions=(4, 20), episodes=5, few=1, rounds=2, command=False)


def test_it_has_a_panel_each_for_trials_states_and_actions(tmp_path, monkeypatch):
    monkeypatch.setattr(figure_of_speed, "QUICK", TINY)
    figure_of_speed.main(["--quick", "--out", str(tmp_path / "speed.pdf")])
    assert {path.name for path in tmp_path.iterdir()} == {"speed.pdf", "speed.png", "speed.json"}
    points = json.loads((tmp_path / "speed.json").read_text())["points"]
    assert [(one["panel"], one["at"]) for one in points] == [
        ("trials", 1),
        ("trials", 2),
        ("states", 81),
        ("states", 144),
        ("actions", 4),
        ("actions", 20),
    ]
    for one in points:
        assert {line: len(seconds) for line, seconds in one["seconds"].items()} == {"mapek, run_trial": 2, "C": 2}
        assert all(speed > 0 for speed in one["million_steps_per_s"].values())
    drawn = figure_of_speed.draw(points).axes
    assert [axes.get_xlabel() for axes in drawn] == ["number of trials", "number of states", "number of actions"]
    assert [[len(line.get_xdata()) for line in axes.lines] for axes in drawn] == [[2, 2]] * 3


def test_the_command_does_the_same_steps(tmp_path):
    ((_, _, config, command),) = figure_of_speed.points(TINY._replace(trials=(2,), sides=(), actions=(), command=True))
    assert command
    steps, seconds = figure_of_speed.by_command(config, tmp_path)
    assert steps == figure_of_speed.in_the_loop(config)[0]
    assert seconds > 0


def test_other_work_is_no_comparison(monkeypatch):
    monkeypatch.setattr(figure_of_speed, "in_the_loop", lambda config: (1, 1.0))
    with pytest.raises(RuntimeError, match="not the same work at 1 trials"):
        figure_of_speed.measure(TINY)

"""Figures get to the disk whole, with the same bytes each time, and from any thread."""

import os
import re
import subprocess
import sys
import textwrap
from concurrent.futures import ThreadPoolExecutor

import matplotlib
import numpy as np
import pytest

from adapters.figures import (
    Compared,
    Panel,
    comparison,
    convergence,
    internal_dynamics,
    learning_curve,
    q_heatmaps,
    save,
)
from adapters.figures.style import number, shorten


class Stage:
    converged = np.array([3, 5, 8, 9, 9, 12])
    trials = 8


def figures():
    steps = {"episode": [1, 1, 2], "exploratory": [0, 1, 0], "q": [0.0, 1.0, 2.0], "alpha": [0.1, 0.2, 0.1]}
    episodes = {"episode": [1, 2], "epsilon": [1.0, 0.5], "return": [3.0, 4.0]}
    values = np.arange(32.0).reshape(8, 4)
    return {
        "dynamics": internal_dynamics(steps, episodes, alarms=[1], drifts=[2]),
        "heatmaps": q_heatmaps(
            [Panel("a", values, tuple(range(8)), 0)], rows=2, columns=2, walls=[(1, 0)], goals=[(0, 0)], start=(1, 1)
        ),
        "curve": learning_curve(
            {"a": np.arange(20.0).reshape(2, 10)}, drifts=[5], detections={"a": [6]}, ylabel="return"
        ),
        "convergence": convergence({"a": [Stage()]}),
        "comparison": comparison({"a": Compared([1.0, 2.0], (1.2, 1.8))}, xlabel="steps"),
    }


def small():
    return comparison({"a": Compared([1.0, 2.0], (1.2, 1.8))}, xlabel="steps")


def test_both_formats_are_written_with_the_same_bytes_each_time(tmp_path):
    twins = figures()
    for name, figure in figures().items():
        paths = save(figure, tmp_path / "one", name)
        assert [p.name for p in paths] == [f"{name}.png", f"{name}.pdf"]
        png, pdf = (path.read_bytes() for path in paths)
        assert png.startswith(b"\x89PNG")
        assert pdf.startswith(b"%PDF")
        assert b"CreationDate" not in pdf
        assert b"tIME" not in png
        assert b"/Subtype /Type3" not in pdf, "text of type 42 stays text"
        assert re.search(rb"/CIDFontType2|/TrueType", pdf)
    assert len(os.listdir(tmp_path / "one")) == 2 * len(twins)
    for name in ("dynamics", "heatmaps"):  # the ones with dots as pixels, hatches and a bar of colours
        for after in save(twins[name], tmp_path / "two", name):
            assert after.read_bytes() == (tmp_path / "one" / after.name).read_bytes(), after.name


def test_saving_one_figure_twice_gives_the_same_bytes_and_leaves_matplotlib_as_it_was(tmp_path):
    before = dict(matplotlib.rcParams)
    figure = small()
    first, second = save(figure, tmp_path, "a"), save(figure, tmp_path, "b")
    assert [p.read_bytes() for p in first] == [p.read_bytes() for p in second]
    assert dict(matplotlib.rcParams) == before


def test_threads_draw_what_one_thread_draws(tmp_path):
    expected = [path.read_bytes() for path in save(small(), tmp_path, "alone")]
    with ThreadPoolExecutor(4) as pool:
        for paths in pool.map(lambda i: save(small(), tmp_path, f"f{i}"), range(4)):
            assert [path.read_bytes() for path in paths] == expected, paths[0].name


def test_a_failing_rename_leaves_the_old_files_and_nothing_else(tmp_path, monkeypatch):
    save(small(), tmp_path, "figure")
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}

    def refuse(source, target):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "replace", refuse)
    with pytest.raises(OSError, match="No space left"):
        save(comparison({"b": Compared([9.0], None)}, xlabel="steps"), tmp_path, "figure")
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_a_disk_that_is_full_leaves_nothing(tmp_path):
    resource = pytest.importorskip("resource")
    assert resource
    code = """
        import resource, sys
        from pathlib import Path
        from adapters.figures import Compared, comparison, save
        figure = comparison({"a": Compared([1.0, 2.0], None)}, xlabel="steps")
        resource.setrlimit(resource.RLIMIT_FSIZE, (2000, 2000))
        try:
            save(figure, Path(sys.argv[1]), "figure")
        except OSError as error:
            print(type(error).__name__, error.errno)
    """
    folder = tmp_path / "out"
    ran = subprocess.run(
        [sys.executable, "-B", "-c", textwrap.dedent(code), str(folder)], capture_output=True, text=True, timeout=60
    )
    assert (ran.returncode, ran.stdout) == (0, "OSError 27\n"), ran.stderr
    assert list(folder.iterdir()) == []


def test_a_folder_that_cannot_be_is_an_error(tmp_path):
    (tmp_path / "file").write_text("no folder")
    with pytest.raises(OSError, match="file"):
        save(small(), tmp_path / "file" / "figures", "figure")
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


@pytest.mark.parametrize("name", ["", "a/b", "..", ".hidden", "a\\b"])
def test_a_name_is_a_name_and_not_a_path(tmp_path, name):
    with pytest.raises(ValueError, match="name is"):
        save(small(), tmp_path, name)
    assert list(tmp_path.iterdir()) == []


def test_pyplot_is_not_imported():
    code = "import adapters.figures, sys; print('matplotlib.pyplot' in sys.modules)"
    ran = subprocess.run([sys.executable, "-B", "-c", code], capture_output=True, text=True, timeout=60)
    assert ran.stdout == "False\n", ran.stderr


def test_numbers_show_what_can_be_told():
    assert number(23348.4, 180.0) == "23,348"
    assert number(-0.0123, 0.004) == "\N{MINUS SIGN}0.012"
    assert number(0.0, 0.0) == "0"
    assert shorten("x" * 40) == "x" * 25 + "…"

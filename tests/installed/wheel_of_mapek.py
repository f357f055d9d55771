"""The wheel of this checkout, and the command as it is installed from it."""

import configparser
import os
import subprocess
import sys
import zipfile
from pathlib import Path

ROOT = Path(__file__).parents[2]


def build(folder):
    """Build the wheel into a folder, without an index."""
    done = subprocess.run(
        [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(folder)],
        cwd=ROOT, capture_output=True, text=True, timeout=120,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    (wheel,) = Path(folder).glob("*.whl")
    return wheel


def unpack(wheel, site):
    """Put a wheel's content where `pip install --target` puts it."""
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(site)
    return site


def typed(site, *arguments, cwd, before="pass", path=(), **options):
    """Type a command, by the entry point that the console script in `site` would call, after the statement `before`."""
    (points,) = site.glob("mapek-*.dist-info/entry_points.txt")
    parser = configparser.ConfigParser()
    parser.read(points)
    module, _, function = parser["console_scripts"]["mapek"].partition(":")
    code = f"import sys; sys.argv[0] = 'mapek'; {before}\nfrom {module} import {function}\nsys.exit({function}())"
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(map(str, (*path, site))), "HOME": str(cwd)}
    return subprocess.run(
        # -P: as of a console script, the present folder is not on the path.
        [sys.executable, "-P", "-c", code, *map(str, arguments)],
        cwd=cwd, capture_output=True, text=True, timeout=120, env=environment, **options,
    )  # fmt: skip

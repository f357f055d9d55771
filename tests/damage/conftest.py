"""Lets the tests of this folder import what stands beside them, and beside those of the store and the folders."""

import sys
from pathlib import Path

for _folder in (Path(__file__).parent, *(Path(__file__).parents[1] / name for name in ("buses", "results"))):
    sys.path.append(str(_folder))

"""Lets the tests of this folder import what stands beside them."""

import sys
from pathlib import Path

sys.path.append(str(Path(__file__).parent))

# With --doctest-modules pytest would import it a second time, under the name of another folder's.
collect_ignore = ["conftest.py"]

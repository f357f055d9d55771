import sys
from pathlib import Path

# The records are those of the tests of the wire, which keeps them in such a store.
sys.path.append(str(Path(__file__).parents[1] / "buses"))

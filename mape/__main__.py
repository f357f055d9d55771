"""``python -m mape``: the command line, wherever the console script is not on the path."""

import os
import sys

# As for the console script, what lies in the present folder is not to stand in the way of what mapek is built on, be it
# a folder `mapek` or a module `random`; parts are found there all the same (`mape.registry.look_here`).
_HERE, _HOME = os.getcwd(), os.path.dirname(os.path.dirname(os.path.realpath(__file__)))
if not sys.flags.safe_path and sys.path[0] in ("", _HERE) and os.path.realpath(_HERE) != _HOME:
    del sys.path[0]

from mapek import main  # noqa: E402

if __name__ == "__main__":
    sys.exit(main())

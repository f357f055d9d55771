"""``python -m mape``: the command line, wherever the console script is not on the path."""

import sys

from mapek import main

if __name__ == "__main__":
    sys.exit(main())

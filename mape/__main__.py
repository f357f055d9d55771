"""``python -m mape``: the command line, wherever the console script is not on the path."""

import sys

from adapters.cli.main import main

if __name__ == "__main__":
    sys.exit(main())

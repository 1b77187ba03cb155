"""``python -m rankone`` is the command line."""

import sys

from rankone.commands.cli import main

if __name__ == "__main__":
    sys.exit(main())

"""``python -m rankone`` is the command line."""

import sys

from rankone.share.commands.cli import main

if __name__ == "__main__":
    sys.exit(main())

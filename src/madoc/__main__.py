"""`python -m madoc` is the command `madoc`."""

import sys

from madoc.commands.main import main

if __name__ == "__main__":
    sys.exit(main())

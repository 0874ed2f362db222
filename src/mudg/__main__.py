"""``python -m mudg`` is the ``mudg`` command."""

import sys

from mudg.app import main

if __name__ == "__main__":
    sys.exit(main())

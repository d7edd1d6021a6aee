"""`python -m vn_nav.cli`, as torchrun starts it."""

import sys

from vn_nav.cli import main

if __name__ == '__main__':
    sys.exit(main())

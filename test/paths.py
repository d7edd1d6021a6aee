"""Where the tests and the project are."""

from pathlib import Path

TESTS = Path(__file__).resolve().parent  # helper modules lie here
ROOT = TESTS.parent

"""The command line: the one place where simulator and stack meet, and where options are read.

Light to import: the nodes' executables handle signals before the seconds of imports begin.
"""

from __future__ import annotations


def main(argv: list[str] | None = None) -> int:
    """The `vn_nav` command: its exit code, 2 for bad input."""
    from vn_nav.cli import commands
    return commands.main(argv)

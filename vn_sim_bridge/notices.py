"""One line, once, about what a file means and this package does not draw as it means it."""

from __future__ import annotations

import sys

_SAID: set[str] = set()


def say_once(text: str) -> None:
    """Write a line to standard error, unless this process has said it before."""
    if text not in _SAID:
        _SAID.add(text)
        print(f'note: {text}', file=sys.stderr)

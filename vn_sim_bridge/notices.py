"""One line, once, about what a file means and this package does not draw as it means it."""

from __future__ import annotations

import sys
from collections import Counter

MOST = 5  # notes of one kind: a split may have thousands of places
_SAID: set[str] = set()
_KINDS: Counter[tuple[str, int]] = Counter()  # notes by the line of code that says them


def say_once(text: str) -> None:
    """Write a line to standard error, unless this process has said it before.

    The last of `MOST` that the same line of code says tells that there may be more.
    """
    if text in _SAID:
        return
    _SAID.add(text)
    caller = sys._getframe(1)
    kind = caller.f_code.co_filename, caller.f_lineno
    _KINDS[kind] += 1
    if _KINDS[kind] <= MOST:
        last = ' (more notes of this kind are left out)' if _KINDS[kind] == MOST else ''
        print(f'note: {text}{last}', file=sys.stderr)

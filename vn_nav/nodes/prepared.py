"""A picture out of a message, whatever the message is."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any, TypeVar

Prepared = TypeVar('Prepared')


def prepared(prepare: Callable[[Any], Prepared], message: Any, wake: threading.Condition,
             refuse: Callable[[str], None]) -> Prepared | None:
    """What `prepare` makes of a message; None: it failed.

    Whatever is thrown, the message is as good as none and no thread ends: `refuse` gets the
    reason, with `wake` held, and who waits for it is woken.
    """
    try:
        return prepare(message)
    except Exception as error:  # pictures come from anywhere: there is no end to what is wrong
        with wake:
            refuse(str(error) or repr(error))
            wake.notify_all()
        return None

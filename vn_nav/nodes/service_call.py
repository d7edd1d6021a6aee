"""A service call that is repeated where no answer comes.

Fast DDS finds request and answer of a service apart. A server that has not found a client's reader
0.1 s after the request drops its answer ("failed to send response"); a loaded machine may need
longer, and the client would wait for ever.
"""

from __future__ import annotations

import math
import time

REPEAT_PERIOD_S = 5.0  # s without an answer after which it is asked again


class ServiceCall:
    """Call a service; for what may be done twice. The caller serves the node meanwhile.

    Args:
        client: its service is ready.
        request: of its type.
        again: time without an answer after which it is asked again [s].
    """

    def __init__(self, client, request, *, again: float = REPEAT_PERIOD_S):
        self._client, self._request, self._again = client, request, again
        self._futures: list = []
        self._asked_at = -math.inf  # steady time [s]

    @property
    def asked(self) -> int:
        """How often it was asked."""
        return len(self._futures)

    def is_answered(self) -> bool:
        """Ask where that is due; whether there is an answer.

        A server that was merely slow answers all that it was asked: that is waited for, so that
        nothing is done later, up to `again`.
        """
        done = [future.done() for future in self._futures]
        waited = time.monotonic() - self._asked_at > self._again
        if waited and not any(done):
            self._asked_at = time.monotonic()
            self._futures.append(self._client.call_async(self._request))
            return False
        return any(done) and (all(done) or waited)

    @property
    def answer(self):
        """The newest answer, once `is_answered`."""
        return next(future.result() for future in reversed(self._futures) if future.done())

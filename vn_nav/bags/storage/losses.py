"""Messages that were published and not received."""

from __future__ import annotations


class Losses:
    """Counts what is missing between the numbers that publishers give their messages.

    The numbers come without their publisher's name. A number that follows none of the last ones
    is a gap behind the nearest lower one, unless somebody has to be new: where several publish on
    one topic, the count is an estimate; with one it is exact.
    """

    REMEMBERED = 16

    def __init__(self):
        self._last: list[int] = []  # number of each publisher; the latest at the end

    def add(self, number: int, publishers: int) -> int:
        """Messages lost before this one.

        Args:
            number: of the message.
            publishers: how many there are now.
        """
        before = number - 1
        if before not in self._last:
            lower = [last for last in self._last if last < number]
            if not lower or len(self._last) < publishers:
                self._last = [*self._last, number][-self.REMEMBERED:]
                return 0
            before = max(lower)
        self._last.remove(before)
        self._last.append(number)
        return number - 1 - before

"""What was read of a file, compared with what the file counts, channel by channel."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

from vn_nav.bags.storage.records import Declared

MAX_NAMED_CHANNELS = 3  # channels that are named


class Count(NamedTuple):
    """How what was read differs from what the file counts."""

    missing: int | None  # messages that it counts and that were not read; None: unknown
    surplus: int = 0  # messages that were read and that it does not count
    faults: tuple[str, ...] = ()
    doubts: tuple[str, ...] = ()  # faults of the counts themselves


def compared(total: int | None, counts: Mapping[int, int] | None, declared: Declared) -> Count:
    """Compare.

    The counts stand twice in a file: by channel, and in all. Where these two disagree, the one
    that agrees with what was read is right.

    Args:
        total: messages of the file, as it says; None: it does not.
        counts: the same by channel.
        declared: what was read, and which channels were asked for.
    """
    read, chosen = declared.read, declared.chosen
    everything = None not in chosen.values()
    if counts is None:
        if total is None or not everything:
            return Count(None)
        return _difference({'': (total, read.total())})
    numbers = counts.keys() | read.keys() if everything else [
        number for number, connection in chosen.items() if connection is not None]
    differing = {number: (counts.get(number, 0), read[number]) for number in sorted(numbers)
                 if counts.get(number, 0) != read[number]}
    agreed = total is None or sum(counts.values()) == total
    doubt = (f'it counts {total} messages, and {sum(counts.values())} by channel',) * (not agreed)
    if not differing or not agreed and everything and total == read.total():
        return Count(0, doubts=doubt)
    if not agreed:
        return Count(None, faults=(f'{doubt[0]}; {read.total()} were read',))
    if everything and (number := _renamed(differing, declared)) is not None:
        return Count(0, doubts=(f'it counts messages of channel {number}, which nothing '
                                'declares',))
    return _difference({_name(number, declared): pair for number, pair in differing.items()})


def _difference(differing: Mapping[str, tuple[int, int]]) -> Count:
    """By what it is of: messages that are counted, and read."""
    apart = {name: pair for name, pair in differing.items() if pair[0] != pair[1]}
    faults = [f'it counts {counted} messages{name}, and {read} were read'
              for name, (counted, read) in apart.items()]
    if len(faults) > MAX_NAMED_CHANNELS:
        faults[MAX_NAMED_CHANNELS:] = [
            f'and so with {len(faults) - MAX_NAMED_CHANNELS} other channels']
    return Count(sum(max(counted - read, 0) for counted, read in apart.values()),
                 sum(max(read - counted, 0) for counted, read in apart.values()),
                 ('; '.join(faults),) if faults else ())


def _name(number: int, declared: Declared) -> str:
    connection = declared.channels.get(number)
    return f' of channel {number}' + (f' ({connection.topic})' if connection else '')


def _renamed(differing: Mapping[int, tuple[int, int]], declared: Declared) -> int | None:
    """The number in the counts that stands for another one, if that is all."""
    if len(differing) != 2:
        return None
    (one, (counted, _)), (other, (_, read)) = sorted(
        differing.items(), key=lambda item: item[0] in declared)
    whole = differing[one] == (counted, 0) and differing[other] == (0, read)
    return one if whole and counted == read and one not in declared else None

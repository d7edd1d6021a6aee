"""Shared memory of Fast DDS that killed processes have left behind."""

from __future__ import annotations

import contextlib
import fcntl
import time
from pathlib import Path

FOLDER = Path('/dev/shm')
LOCKS = 'fastrtps_*_el'  # each next to the segment of its name without `_el`; held while in use
MIN_AGE_S = 10.0  # a lock file is made before it is locked: a new one is left alone


def remove_dead_segments(folder: Path = FOLDER, min_age: float = MIN_AGE_S) -> int:
    """Free the segments of processes that ended without closing them (SIGKILL, power).

    Fast DDS never does. With the package's profiles each is 32 MiB of memory; a node that is
    killed and respawned again and again would fill `/dev/shm`, and with it the machine. A segment
    is dead if nobody holds the lock on its lock file, by which `fastdds shm clean` goes, too.

    Args:
        folder: where the segments are.
        min_age: of a lock file at least [s].

    Returns:
        Bytes freed; 0 where there is no such folder.
    """
    freed = 0
    for path in folder.glob(LOCKS):
        segment = path.with_name(path.name.removesuffix('_el'))
        if '_port' in segment.name:  # small, and shared by several processes
            continue
        # Of another user, or gone meanwhile, or in use.
        with contextlib.suppress(OSError):
            # Before the lock is tried: its owner may be about to take it.
            if time.time() - path.stat().st_mtime < min_age:
                continue
            with open(path, 'rb') as lock:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                freed += _size(segment)
                segment.unlink(missing_ok=True)
                path.unlink()
    return freed


def _size(segment: Path) -> int:
    """Bytes of memory that a segment takes; 0: there is none."""
    try:
        return segment.stat().st_blocks * 512
    except FileNotFoundError:
        return 0

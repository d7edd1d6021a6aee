"""What a policy that searches knew along a recorded drive: `~/map` and `~/hypotheses` of its node.

Both are in the frame of the robot's odometry. It is laid onto the place where the episode began:
from there the map drifts against the place as the odometry does.
"""

from __future__ import annotations

import bisect
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from vn_msgs_py.motion import odometry_to_array
from vn_nav.bags.mapping.pose_graph import between, compose
from vn_nav.bags.storage.reader import read_bag
from vn_nav.policy.search.snapshot import Snapshot, snapshot_of

BASE = 'base_link'  # frame of a map whose place in the odometry's frame nobody knew
SAME_S = 1e-3  # stamps that differ by less are one


class PlacedSearch(NamedTuple):
    """What was known at a picture."""

    recorded: int  # when, ns since 1970
    stamp: float  # of the picture [s]
    search: Snapshot
    frame: np.ndarray  # [3] x, y [m], yaw [rad] of the snapshot's frame in that of the place


def read_searches(folder: str | Path, nodes: Sequence[str], begins: Sequence[float],
                  starts: Sequence[np.ndarray]) -> list[list[PlacedSearch]]:
    """Of every episode, in the order of time.

    Args:
        folder: of the bag.
        nodes: names of the policies' nodes.
        begins: stamps [s] at which episodes begin.
        starts: [7] of each: where the robot really was first, as `odometry_to_array` says.
    """
    found: list[list[PlacedSearch]] = [[] for _ in begins]
    if not nodes:
        return found
    maps, hypotheses = ({f'{node}/{name}': node for node in nodes}
                        for name in ('map', 'hypotheses'))
    odometry: list[np.ndarray] = []
    charted: list[tuple[int, str, Any]] = []
    guessed: dict[tuple[str, float], Any] = {}
    for record in read_bag(folder, ('odom', *maps, *hypotheses)):
        if record.topic == 'odom':
            odometry.append(odometry_to_array(record.message))
        elif record.topic in maps:
            charted.append((record.stamp, maps[record.topic], record.message))
        else:
            guessed[hypotheses[record.topic], _seconds(record.message)] = record.message
    odometry.sort(key=lambda values: values[6])
    for recorded, node, message in charted:
        stamp = _seconds(message)
        k = max(0, bisect.bisect_right(begins, stamp + 1e-6) - 1)
        own, first = (_pose_at(odometry, when) for when in (stamp, starts[k][6]))
        if own is None or first is None or message.header.frame_id == BASE:
            continue  # nobody knows where the map lies
        # The odometry's frame in that of the place, by where the episode began.
        place = compose(starts[k][:3], between(first, np.zeros(3)))
        search, origin = snapshot_of(message, guessed.get((node, stamp)), own)
        found[k].append(PlacedSearch(recorded, stamp, search, compose(place, origin)))
    return found


def _pose_at(odometry: list[np.ndarray], stamp: float) -> np.ndarray | None:
    """The pose [3] that odometry, in the order of time, has for a stamp [s]."""
    k = bisect.bisect_left(odometry, stamp - SAME_S, key=lambda values: values[6])
    return odometry[k][:3] if k < len(odometry) and odometry[k][6] <= stamp + SAME_S else None


def _seconds(message: Any) -> float:
    return message.header.stamp.sec + message.header.stamp.nanosec * 1e-9

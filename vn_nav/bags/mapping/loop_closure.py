"""Corrects drifting odometry by loop closures and pose-graph optimisation.

Keyframes of the drive are compared with those that may show the same place, by what is known of
the drift so far. The motion that two pictures show (`two_view`) goes into a pose graph
(`pose_graph`) together with odometry. The surest pairs come first, and each round of closures
narrows what the next may lie off.

Four tests keep wrong closures out, in this order. A motion on a plane must explain most matches of
the features. It must lie within what odometry allows. A second closure next to it must say the
same. And in the graph a closure loses its weight with what it contradicts.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from vn_nav.bags.dataset import DriveSet, Pictures
from vn_nav.bags.mapping.closures import CLOSURE_DTYPE, MIN_CLOSURES, LoopClosures
from vn_nav.bags.mapping.keyframes import DriveGraph
from vn_nav.bags.mapping.pose_graph import between, misfit, solve
from vn_nav.robot import RobotSpec

# Rounds of the search; times `closures.CANDIDATE_SIGMA_M_RAD`, how uncertain a candidate may be.
ROUND_FACTORS = (1, 1, 1, 2, 4, 8)
FEATURE_TIME_SHARE = 0.4  # of the time, to find features


class OptimisedOdometry(NamedTuple):
    """A drive in one frame; N pictures, K closures."""

    poses: np.ndarray  # [N,3] float64 x, y [m], yaw [rad]; the first is that of odometry
    closures: np.ndarray  # [K] of `CLOSURE_DTYPE`: pictures, matches, motion between them, chi^2
    stretch: np.ndarray  # [N] int64, of each picture; those that were given, and what they hide
    place: np.ndarray  # [S] int64: which of the stretches belong together
    facts: dict  # counts; how far poses were moved [m] and turned [rad], at most; `strain` [chi^2]
    # that is left of odometry where it fits worst, and `strained`, the picture before that


def optimise_odometry(drives: DriveSet, robot: RobotSpec, pictures: Pictures | None = None, *,
                      stretch: np.ndarray | None = None,
                      show: Callable[[float], None] = lambda share: None,
                      until: float = math.inf) -> OptimisedOdometry:
    """Correct the poses of a drive by loop closures: places that it shows twice.

    Args:
        drives: of one bag, with every picture (`Wanted(every=True)`). Depth is used if it is
            there.
        robot: its camera.
        pictures: [N,3,S,S] uint8; default: those of the drives. 128 to 160 pixels are enough.
        stretch: [N] int64, 0 and up: between two of them odometry does not hold
            (`continuity.divide`); default: it holds throughout.
        show: receives the share that is done.
        until: `time.monotonic()` after which no further round of the search begins, unless
            there are several stretches.

    Returns:
        The poses; as odometry has them where too little was recognised (`facts['corrected']`).
    """
    drive = DriveGraph(drives, robot, drives.image if pictures is None else pictures, stretch,
                       lambda share: show(FEATURE_TIME_SHARE * share))
    found = LoopClosures(drive)
    solution = solve(drive.odometry[drive.node], drive.edges, found.edges())
    rounds = 0
    for loosen in ROUND_FACTORS:
        if rounds and time.monotonic() > until and not drive.stretch.any():
            break
        done = FEATURE_TIME_SHARE + (1 - FEATURE_TIME_SHARE) * rounds / len(ROUND_FACTORS)

        def show_search(share: float, done: float = done) -> None:
            show(done + share * (1 - FEATURE_TIME_SHARE) / len(ROUND_FACTORS))

        if found.search(solution, loosen, show_search):
            solution = found.settle(solution)
        rounds += 1
    facts = {'pictures': len(drive.odometry), 'keyframes': len(drive.key),
             'compared': len(found.tested), 'recognised': len(found.closures),
             'closures': int(found.kept.sum()),
             'corrected': bool(found.kept.sum() >= MIN_CLOSURES), 'rounds': rounds, 'strain': 0.0}
    own, place = found.places()
    if not facts['corrected']:
        return OptimisedOdometry(drive.odometry.copy(), np.zeros(0, CLOSURE_DTYPE), own, place,
                                 facts)
    poses = drive.spread(solution.poses)
    off = between(drive.odometry, poses)
    strain = misfit(solution.poses, drive.edges, solution.shares)
    facts |= {'moved': float(np.hypot(off[:, 0], off[:, 1]).max()),
              'turned': float(np.abs(off[:, 2]).max()), 'strain': float(strain.max(initial=0.0)),
              'strained': int(drive.node[np.argmax(strain)]) if len(strain) else 0}
    return OptimisedOdometry(poses, found.table(solution), own, place, facts)

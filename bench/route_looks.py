"""How far a policy's eyes can be trusted among the pictures of a route.

    python bench/teach_and_drive.py --out runs/routes --no-turns --camera-height 1.0 \
      --checkpoint models/search --house 12001 12002 --stage record
    python bench/route_looks.py runs/routes/house_12001/bag runs/routes/house_12002/bag

Other pictures of the same drive look at its route. A picture is right where the robot stands as
far from it as the eyes say, give or take 1.2 m, by `ground_truth/odom`. Rows are thresholds of the
probability that a picture is in view, alone and with a neighbour that is, too. Columns: pictures
in view less than 3 m away, in a look; the share of them that is right; and the share of looks in
which the last one along the route is: that is the one that `route_node` would drive to.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np
from record_drive import read_drive

from vn_nav.arrival import wrap_angle
from vn_nav.errors import UserError
from vn_nav.observation import preprocess
from vn_nav.policy.backend import load_backend
from vn_nav.report.tables import markdown
from vn_nav.resources import share_file
from vn_nav.routes import recognition
from vn_nav.routes.follower import REACH_M
from vn_nav.routes.from_bag import EVERY_DEG, EVERY_M

THRESHOLDS = (0.5, 0.9, 0.97, 0.99)
RIGHT_M = 1.2


def looks(bag: Path, eyes, size: int, count: int) -> list[tuple[np.ndarray, ...]]:
    """Of so many pictures of a drive: co-visibility, distance said and true, [K] each."""
    drive = read_drive(bag)
    kept = [0]
    for k, pose in enumerate(drive.pictured):
        before = drive.pictured[kept[-1]]
        if np.hypot(*(pose[:2] - before[:2])) >= EVERY_M or (
                abs(np.degrees(wrap_angle(pose[2] - before[2]))) >= EVERY_DEG):
            kept.append(k)
    route = recognition.RouteEyes(
        eyes, np.stack([preprocess(drive.pictures[k], size) for k in kept]))
    found = []
    for k in np.random.default_rng(0).permutation(len(drive.pictures))[:count]:
        seen = route.look(preprocess(drive.pictures[k], size), np.arange(len(kept)))
        true = np.hypot(*(drive.pictured[kept, :2] - drive.pictured[k, :2]).T)
        found.append((seen.co_visible, seen.distance, true))
    return found


def row(found: list[tuple[np.ndarray, ...]], threshold: float, neighbour: bool) -> list[str]:
    """Of a table, see the module."""
    count = right = 0
    first = []
    for seen, said, true in found:
        chosen = seen >= threshold
        if neighbour:
            chosen = chosen & (np.append(chosen[1:], False) | np.insert(chosen[:-1], 0, False))
        chosen &= said <= REACH_M
        good = np.abs(said - true) <= RIGHT_M
        count, right = count + chosen.sum(), right + (chosen & good).sum()
        if chosen.any():
            first.append(good[np.flatnonzero(chosen)[-1]])
    name = f'{threshold:g}{" with a neighbour" if neighbour else ""}'
    return [name, f'{count / len(found):.1f}',
            f'{right / max(count, 1):.2f}', f'{np.mean(first):.2f}' if first else '-',
            f'{len(first)} of {len(found)}']


def main() -> int:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__.split('\n')[0])
    parser.add_argument('bags', nargs='+', type=Path, metavar='BAG')
    parser.add_argument('--checkpoint', type=Path, default=share_file('models/search'))
    parser.add_argument('--looks', type=int, default=60, help='a bag')
    options = parser.parse_args()
    recognition.COMPARED = 10**9  # all of them
    try:
        backend = load_backend(options.checkpoint, 0)
        if backend.eyes is None:
            raise UserError('routes are looked at by a policy that searches', options.checkpoint,
                            'give --checkpoint models/search')
        found = [one for bag in options.bags
                 for one in looks(bag, backend.eyes, backend.config.size, options.looks)]
    except UserError as error:
        print(f'route_looks: {error}', file=sys.stderr)
        return 2
    print(markdown([['in view from', 'pictures', 'right', 'the one driven to', 'looks with any'],
                    ['---'] * 5,
                    *(row(found, threshold, neighbour) for threshold in THRESHOLDS
                      for neighbour in (False, True))]))
    return 0


if __name__ == '__main__':
    sys.exit(main())

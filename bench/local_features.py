"""Fits what local features of two pictures say of them: `vn_nav/policy/search/verification.py`.

    python bench/local_features.py

Pairs of pictures of `local_features.SIDE` pixels in houses of the simulator's train split, light
and camera drawn apart, through lenses of `LENSES_DEG`: logistic regressions of co-visibility (a
tenth of the goal is shown, against nothing) and of arrival, and how right the motions are. Prints
the constants, and the figures of them on houses of the validation split.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from typing import NamedTuple

import cv2
import numpy as np

from vn_nav.arrival import arrived
from vn_nav.learning.auxiliary import POSE_OVERLAP
from vn_nav.learning.sight_figures import angle_between, auc
from vn_nav.policy.search.local_features import SIDE, Comparison, compare, extract
from vn_nav.policy.search.verification import FAR, TURNED
from vn_nav.robot import RobotSpec
from vn_nav.scenes import house_scenes
from vn_sim_bridge.datasets.view_pairs import PairSampler
from vn_sim_bridge.render.randomisation import load_randomisation

LENSES_DEG = (57, 70, 90)
TRAIN, VALIDATION, ROOMS = range(0, 40), range(10_000, 10_010), 3  # seeds of houses
DRAW = 40  # pairs at once
RIDGE, STEPS = 1e-3, 50  # of the fit


class Compared(NamedTuple):
    """K pairs of pictures."""

    found: list[Comparison]
    truth: np.ndarray  # [K,4] as of `relative_pose`
    overlap: np.ndarray  # [K]
    arrived: np.ndarray  # [K] bool, as the crow flies


def compared(seeds: range, count: int) -> Compared:
    """Pairs in some houses, so many for each lens, in which both pictures have features enough."""
    found, truth, overlap = [], [], []
    spent = {'extract': 0.0, 'compare': 0.0}
    for lens in LENSES_DEG:
        fov = math.radians(lens)
        sampler = PairSampler(house_scenes(seeds, ROOMS), size=SIDE,
                              robot=RobotSpec(camera_fov=fov), mix='recognition', seed=lens,
                              randomisation=load_randomisation('standard'))
        for _ in range(0, count, DRAW):
            drawn = sampler.draw(DRAW)
            for k in range(DRAW):
                begun = time.process_time()
                own, goal = (extract(drawn[name][k].transpose(1, 2, 0), fov)
                             for name in ('image', 'goal'))
                between = time.process_time()
                both = compare(own, goal)
                spent['compare'] += time.process_time() - between
                spent['extract'] += (between - begun) / 2
                if both.rich:
                    found.append(both)
                    truth.append(drawn['goal_pose'][k])
                    overlap.append(drawn['overlap'][k])
        sampler.simulator.close()
    pairs = count * len(LENSES_DEG)
    print(f'{pairs:,} pairs, {len(found):,} rich; processor time: '
          + ', '.join(f'{name} {1e3 * value / pairs:.1f} ms' for name, value in spent.items()),
          flush=True)
    relative = np.array(truth)
    return Compared(found, relative, np.array(overlap), arrived(
        np.hypot(*relative[:, :2].T), np.abs(np.arctan2(relative[:, 3], relative[:, 2]))))


def inputs(found: list[Comparison]) -> tuple[np.ndarray, np.ndarray]:
    """Of co-visibility [K,3] and of arrival [K,5], in the order of the constants."""
    moved = np.array([own.inliers > 0 for own in found], float)
    metres = [min(float(np.hypot(*own.position)), FAR) if own.inliers else 0.0 for own in found]
    turns = [min(abs(own.heading), TURNED) if own.inliers else 0.0 for own in found]
    one = np.ones(len(found))
    return (np.column_stack([one, [own.likeness for own in found], moved]),
            np.column_stack([one, [math.log1p(own.matches) for own in found], moved, metres,
                             turns]))


def fitted(given: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Logistic regression [D] of given [K,D] by Newton's method."""
    weights = np.zeros(given.shape[1])
    ridge = RIDGE * np.eye(len(weights))
    for _ in range(STEPS):
        said = 1 / (1 + np.exp(-given @ weights))
        hessian = (given * (said * (1 - said))[:, None]).T @ given + ridge
        weights += np.linalg.solve(hessian, given.T @ (right - said) - ridge @ weights)
    return weights


def report(pairs: Compared, co_visible: np.ndarray, arrival: np.ndarray) -> None:
    """Figures of the constants on pairs."""
    shares, stands = inputs(pairs.found)
    seen = pairs.overlap >= POSE_OVERLAP
    sure = seen | (pairs.overlap == 0)
    score = shares @ co_visible
    print(f'co-visibility: AUC {auc(score[sure], seen[sure]):.3f}; arrival: AUC '
          f'{auc(stands @ arrival, pairs.arrived):.3f}')
    for low, high in ((0, 0.2), (0.2, 0.5), (0.5, 0.8), (0.8, 1)):
        said = 1 / (1 + np.exp(-score))
        own = sure & (said > low) & (said <= high)
        print(f'  said {low:.1f} to {high:.1f}: {own.sum()} pairs, {seen[own].mean():.2f} true')
    rows = np.flatnonzero([own.inliers > 0 for own in pairs.found])
    position = np.array([pairs.found[k].position for k in rows])
    turn = np.array([pairs.found[k].heading for k in rows])
    truth = pairs.truth[rows]
    far = np.hypot(*truth[:, :2].T) > 0.3
    length = np.hypot(*position[far].T) / np.hypot(*truth[far, :2].T)
    bearing = _degrees(angle_between(position[far], truth[far, :2]))
    turned = np.column_stack([np.cos(turn), np.sin(turn)])
    heading = _degrees(angle_between(turned, truth[:, 2:]))
    print(f'{len(rows)} motions, {seen[rows].mean():.2f} of pictures that overlap; median errors: '
          f'bearing {bearing:.1f} deg, heading {heading:.1f} deg; length {np.median(length):.2f} '
          'of the true one')


def _degrees(angles: np.ndarray) -> float:
    return float(np.degrees(np.median(angles)))


def main() -> int:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__.split('\n')[0])
    parser.add_argument('--pairs', type=int, default=240, help='for each lens')
    options = parser.parse_args()
    cv2.setNumThreads(1)
    pairs = compared(TRAIN, options.pairs)
    shares, stands = inputs(pairs.found)
    seen = pairs.overlap >= POSE_OVERLAP
    sure = seen | (pairs.overlap == 0)
    co_visible, arrival = fitted(shares[sure], seen[sure]), fitted(stands, pairs.arrived)
    print('co-visible:', ' '.join(f'{value:.2f}' for value in co_visible))
    print('arrived:', ' '.join(f'{value:.2f}' for value in arrival))
    report(compared(VALIDATION, options.pairs // 2), co_visible, arrival)
    return 0


if __name__ == '__main__':
    sys.exit(main())

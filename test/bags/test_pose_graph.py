"""Two rounds of a square, with odometry that turns too little: the pose graph puts them right."""

import math

import numpy as np

from vn_nav.bags.mapping.pose_graph import Edges, between, compose, solve

SIDE = 8  # steps of half a metre
TURN = math.radians(1.5)  # that odometry misses at every corner
CLEAR = np.diag([0.02, 0.02, 0.01]) ** 2


def rounds(missed):
    """Poses [A,3] of two rounds, ending where they began."""
    poses = [np.zeros(3)]
    for k in range(8 * SIDE):
        corner = math.pi / 2 - missed if k % SIDE == SIDE - 1 else 0.0
        poses.append(compose(poses[-1], np.array([0.5, 0.0, corner])))
    return np.array(poses)


def edges(poses, pairs, covariance):
    """What was measured between some of the poses."""
    first, second = np.array(pairs).T
    none = np.zeros((len(pairs), 3))
    return Edges(first, second, none, none, between(poses[first], poses[second]),
                 np.repeat(covariance[None], len(pairs), axis=0))


def solved(wrong=()):
    truth, odometry = rounds(0.0), rounds(TURN)
    steps = [(k, k + 1) for k in range(len(truth) - 1)]
    closures = edges(truth, [(k, k + 4 * SIDE) for k in range(0, 4 * SIDE, 4)], CLEAR)
    for number in wrong:
        closures.motion[number] += [2.0, -1.0, 0.8]
    loose = np.diag([0.02, 0.02, math.radians(1.5)]) ** 2
    return truth, odometry, solve(odometry, edges(odometry, steps, loose), closures)


def off(poses, truth):
    """The largest distance [m] from the truth."""
    return np.hypot(*(poses - truth)[:, :2].T).max()


def test_what_was_recognised_brings_the_rounds_together():
    truth, odometry, solution = solved()
    half = 4 * SIDE
    assert off(odometry[half:], odometry[:half + 1]) > 0.25  # the second round lies elsewhere
    assert off(solution.poses[half:], solution.poses[:half + 1]) < 0.05
    assert (solution.chi < 16.3).all()
    assert np.allclose(solution.poses[0], truth[0])


def test_a_wrong_closure_is_outvoted():
    _, _, clean = solved()
    _, _, solution = solved(wrong=[3])
    assert solution.chi[3] > 100 and (np.delete(solution.chi, 3) < 16.3).all()
    assert off(solution.poses, clean.poses) < 0.05

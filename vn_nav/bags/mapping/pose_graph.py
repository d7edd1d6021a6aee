"""Poses on a floor that agree best with odometry and with what was recognised: a pose graph.

Odometry may count all ways or all turns too long, and pictures, which see distances only as far as
depths are known, all motions: these three shares are unknowns in addition to the poses.
Wrong measurements do not pull: their weight falls with what they contradict, at first hardly
(graduated non-convexity: Yang, Antonante, Tzoumas and Carlone, "Graduated Non-Convexity for Robust
Spatial Perception", 2020, with Geman and McClure's kernel).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from vn_nav.arrival import wrap_angle

MAX_CHI2 = 16.3  # chi^2 of a measurement, 3 degrees of freedom, 99.9 %
WAY_SHARE_SIGMA, TURN_SHARE_SIGMA = 0.02, 0.01  # standard deviations of the shares of odometry
ODOMETRY_SHARES = np.array([[1, 0, 0], [1, 0, 0], [0, 1.0, 0]])  # which share acts on x, y and yaw
CLOSURE_SHARES = np.array([[0, 0, 1], [0, 0, 1], [0, 0, 0.0]])
FIRST_POSE_INFORMATION = 1e9  # information that holds the first pose
MIN_STEP = 1e-4  # m or rad: steps below end the search


class Edges(NamedTuple):
    """Measurements between places that are rigidly attached to two nodes each; E of them."""

    first: np.ndarray  # [E] int64 node
    second: np.ndarray  # [E] int64
    at_first: np.ndarray  # [E,3] place as its node sees it: x, y [m], yaw [rad]
    at_second: np.ndarray  # [E,3]
    motion: np.ndarray  # [E,3] the second place as the first sees it
    covariance: np.ndarray  # [E,3,3]

    def take(self, which: np.ndarray) -> Edges:
        """Some of them."""
        return Edges(*(part[which] for part in self))


class Solution(NamedTuple):
    """Nodes; A of them."""

    poses: np.ndarray  # [A,3]
    shares: np.ndarray  # [3] by which ways, turns and motions of closures are too long
    chi: np.ndarray  # [E] chi^2 of the measurements
    information: np.ndarray  # [3A+3,3A+3] of poses and shares; the first pose is held

    def covariance(self) -> np.ndarray:
        """Of the poses, [A,3,A,3]."""
        count = len(self.poses)
        return np.linalg.inv(self.information)[:3 * count, :3 * count].reshape(count, 3, count, 3)


def compose(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Poses [...,3] of what stands at `other` as seen from `one`."""
    c, s = np.cos(one[..., 2]), np.sin(one[..., 2])
    return np.stack([one[..., 0] + c * other[..., 0] - s * other[..., 1],
                     one[..., 1] + s * other[..., 0] + c * other[..., 1],
                     wrap_angle(one[..., 2] + other[..., 2])], axis=-1)


def between(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Poses [...,3] as seen from others: x forward, y left [m], yaw [rad]."""
    c, s = np.cos(one[..., 2]), np.sin(one[..., 2])
    x, y = other[..., 0] - one[..., 0], other[..., 1] - one[..., 1]
    return np.stack([c * x + s * y, c * y - s * x, wrap_angle(other[..., 2] - one[..., 2])],
                    axis=-1)


def solve(poses: np.ndarray, odometry: Edges, closures: Edges, scale: float = 0.4,
          shares: np.ndarray | None = None) -> Solution:
    """The poses that agree best.

    Args:
        poses: [A,3] to begin with; the first stays.
        odometry: from each node to the next; is not tested.
        closures: the others; may be wrong.
        scale: standard deviation of the share of closures.
        shares: [3] to begin with.
    """
    prior = np.array([WAY_SHARE_SIGMA, TURN_SHARE_SIGMA, scale])**-2.0
    poses, shares = poses.copy(), np.zeros(3) if shares is None else shares.copy()
    chi = _errors(poses, closures, CLOSURE_SHARES @ shares)[1]
    wide = max(1.0, 2 * float(chi.max(initial=0.0)) / MAX_CHI2)
    for _ in range(60):
        weight = (wide * MAX_CHI2 / (wide * MAX_CHI2 + chi))**2
        information, slope = _equations(poses, shares, prior, odometry, closures, weight)
        step = np.linalg.solve(information, slope)
        poses = poses + step[:-3].reshape(-1, 3)
        shares = shares + step[-3:]
        chi = _errors(poses, closures, CLOSURE_SHARES @ shares)[1]
        if wide == 1.0 and np.abs(step).max() < MIN_STEP:
            break
        wide = max(1.0, wide / 1.6)
    poses[:, 2] = wrap_angle(poses[:, 2])
    return Solution(poses, shares, chi, information)


def misfit(poses: np.ndarray, odometry: Edges, shares: np.ndarray) -> np.ndarray:
    """Chi^2 [E] that poses leave of odometry: what they contradict is far above `MAX_CHI2`."""
    return _errors(poses, odometry, ODOMETRY_SHARES @ shares)[1]


def relative(solution: Solution, covariance: np.ndarray, edges: Edges
             ) -> tuple[np.ndarray, np.ndarray]:
    """How measurements differ from what is known: errors [E,3], covariances [E,3,3] of that.

    Args:
        solution: of the graph without these measurements.
        covariance: as `Solution.covariance` gives it.
        edges: the measurements.
    """
    error, _, one, other, _ = _errors(solution.poses, edges, CLOSURE_SHARES @ solution.shares,
                                      lean=False)
    a, b = edges.first, edges.second
    cross = one @ covariance[a, :, b] @ other.transpose(0, 2, 1)
    return error, (one @ covariance[a, :, a] @ one.transpose(0, 2, 1)
                   + other @ covariance[b, :, b] @ other.transpose(0, 2, 1)
                   + cross + cross.transpose(0, 2, 1) + edges.covariance)


def _errors(poses: np.ndarray, edges: Edges, longer: np.ndarray, lean: bool = True):
    """How measurements, each too long by shares [3], miss the poses: errors [E,3], chi^2 [E].

    Not lean, also derivatives [E,3,3] by the two nodes, and what should have been seen [E,3].
    """
    one = compose(poses[edges.first], edges.at_first)
    other = compose(poses[edges.second], edges.at_second)
    seen = between(one, other)
    error = (1 + longer) * seen - edges.motion
    error[:, 2] = wrap_angle(error[:, 2])
    chi = chi_squared(error, edges.covariance)
    if lean:
        return error, chi
    by_one, by_other = np.zeros((2, len(error), 3, 3))
    c, s = np.cos(one[:, 2]), np.sin(one[:, 2])
    by_other[:, 0, 0] = by_other[:, 1, 1] = c
    by_other[:, 0, 1], by_other[:, 1, 0], by_other[:, 2, 2] = s, -s, 1
    by_one[:] = -by_other
    by_one[:, 0, 2], by_one[:, 1, 2] = seen[:, 1], -seen[:, 0]
    stretch = (1 + longer)[:, None]
    return (error, chi, stretch * by_one @ _lever(poses[edges.first], one),
            stretch * by_other @ _lever(poses[edges.second], other), seen)


def _lever(nodes: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Derivatives [E,3,3] of places that are attached to nodes, by the nodes."""
    out = np.tile(np.eye(3), (len(nodes), 1, 1))
    out[:, 0, 2] = nodes[:, 1] - places[:, 1]
    out[:, 1, 2] = places[:, 0] - nodes[:, 0]
    return out


def _equations(poses, shares, prior, odometry: Edges, closures: Edges, weight: np.ndarray
               ) -> tuple[np.ndarray, np.ndarray]:
    """Normal equations of a step."""
    size = 3 * len(poses)
    blocks, slope = np.zeros((len(poses), 3, len(poses), 3)), np.zeros((len(poses), 3))
    shared, down = np.zeros((len(poses), 3, 3)), np.zeros(size + 3)
    information = np.zeros((size + 3, size + 3))
    for edges, acts, trust in ((odometry, ODOMETRY_SHARES, 1.0),
                               (closures, CLOSURE_SHARES, weight[:, None, None])):
        error, _, one, other, seen = _errors(poses, edges, acts @ shares, lean=False)
        inverse = trust * np.linalg.inv(edges.covariance)
        by_shares = seen[:, :, None] * acts
        sides = ((edges.first, one), (edges.second, other))
        for node, by in sides:
            left = by.transpose(0, 2, 1) @ inverse
            np.add.at(slope, node, -(left @ error[..., None])[..., 0])
            np.add.at(shared, node, left @ by_shares)
            for node2, by2 in sides:
                # NumPy's annotations know no slice among the indices of `at`.
                np.add.at(blocks, (node, slice(None), node2),  # type: ignore[arg-type]
                          left @ by2)
        left = by_shares.transpose(0, 2, 1) @ inverse
        down[size:] -= (left @ error[..., None])[..., 0].sum(axis=0)
        information[size:, size:] += (left @ by_shares).sum(axis=0)
    blocks[0, :, 0] += FIRST_POSE_INFORMATION * np.eye(3)
    information[:size, :size] = blocks.reshape(size, size)
    information[:size, size:] = shared.reshape(size, 3)
    information[size:, :size] = information[:size, size:].T
    information[size:, size:] += np.diag(prior)
    down[:size] = slope.reshape(-1)
    down[size:] -= prior * shares
    return information, down


def odometry_covariance(motion: np.ndarray, way: np.ndarray, turn: np.ndarray) -> np.ndarray:
    """Of short motions by odometry, [E,3,3].

    The odometry model of Thrun, Burgard and Fox ("Probabilistic Robotics", 2005, 5.4) with
    variances by the way: for the heading with three times the standard deviations of a good
    indoor robot.

    Args:
        motion: [E,3] of the robot.
        way, turn: [E] that it drove and turned on the way [m], [rad].
    """
    heading = 1e-4 * turn + 4e-4 * way
    along = 4e-4 * way + 2e-4 * turn
    # A turn somewhere on the way: half of it acts on the motion.
    lever = np.stack([-motion[:, 1] / 2, motion[:, 0] / 2, np.ones(len(motion))], axis=1)
    return (along[:, None, None] * np.diag([1.0, 1.0, 0.0]) + 1e-6 * np.eye(3)
            + heading[:, None, None] * lever[:, :, None] * lever[:, None])


def chi_squared(error: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """Of errors [E,3] with covariances [E,3,3], [E]."""
    return np.einsum('ei,ei->e', error, np.linalg.solve(covariance, error[..., None])[..., 0])

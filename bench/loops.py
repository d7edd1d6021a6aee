"""How far odometry drifts over a long drive, and what `mapping.loop_closure` makes of it.

    python bench/loops.py --houses 12000 12001 --minutes 10 --size 128 --drift 1

A robot drives a tour of an embedded house: places about a metre apart, at each first visit a full
turn, every stretch at least twice. The pictures are rendered in one light and through one camera
of the randomisation, which the robot does not know, with noise and blur. Its odometry goes astray
as `vn_sim_bridge.robot.odometry` has it. A table compares odometry and what is made of it with the
truth; a closure is false where it lies farther than `FALSE` from what really relates its two
pictures.
"""

from __future__ import annotations

import argparse
import math
import time
from types import SimpleNamespace
from typing import NamedTuple

import cv2
import numpy as np
from common import pin

from vn_nav.arrival import wrap_angle
from vn_nav.bags.mapping.loop_closure import between, optimise_odometry
from vn_nav.robot import DRIVE_ACTIONS, RobotSpec
from vn_sim_bridge.counter_random import Stream, key
from vn_sim_bridge.floor.floor_map import CELL
from vn_sim_bridge.houses.house import House
from vn_sim_bridge.houses.procedural import generate_house
from vn_sim_bridge.render.randomisation import load_randomisation
from vn_sim_bridge.robot.odometry import advance, drift_errors
from vn_sim_bridge.simulator import Frames
from vn_sim_bridge.simulators.house import HouseSimulator

ROBOT = RobotSpec().with_actions(DRIVE_ACTIONS)
RATE = 8.0  # pictures a second
SPACING, REACH = 0.9, 1.5  # m between places of the tour, and at most along one stretch of it
FALSE = (0.5, math.radians(10))  # m, rad
FAR = 2.5  # m
BATCH = 64  # pictures that are rendered at a time


class Drive(NamedTuple):
    """What a robot did and saw; N pictures, S pixels a side."""

    pose: np.ndarray  # [N,3] float64 x, y [m], yaw [rad], the truth
    time: np.ndarray  # [N] float64 s
    image: np.ndarray  # [N,3,S,S] uint8
    depth: np.ndarray  # [N,S,S] uint8 as `dataset.DriveSet` has it


def tour(house: House, seconds: float, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Poses [N,3] and times [N] of a drive over all places of a house and back, again and again.

    A full turn where it is for the first time in a round.
    """
    chance = np.random.default_rng(seed)
    places, reach = _places(house, chance)
    state = np.array([*places[0], chance.uniform(-math.pi, math.pi)])
    pieces, seen, way = [], set(), [0]
    while sum(map(len, pieces)) < seconds * RATE:
        moves = []
        if way[-1] not in seen:
            seen.add(way[-1])
            moves.append((0.0, chance.choice([-1, 1]) * 2 * math.pi))
        onward = [k for k in np.flatnonzero(reach[way[-1]]) if k not in seen]
        if onward:
            way.append(int(chance.choice(onward)))
        elif len(way) > 1:
            way.pop()
        else:
            seen = {way[-1]}
            continue
        gap = places[way[-1]] - state[:2]
        moves += [(0.0, wrap_angle(math.atan2(gap[1], gap[0]) - state[2])),
                  (math.hypot(*gap), 0.0)]
        for metres, turn in moves:
            piece = _piece(state, metres, turn)
            pieces.append(piece[:-1])
            state = piece[-1]
    poses = np.concatenate(pieces)[:int(seconds * RATE)]
    return poses, 1.0 + np.arange(len(poses)) / RATE


def _places(house: House, chance: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Places [P,2] that lie apart, and which of them can be reached straight from which.

    Where that leaves parts of the house alone, places between them (in doors) are added.
    """
    free = house.floor.centres()
    free = free[chance.permutation(len(free))]
    places = free[:1]
    for place in free:
        if np.hypot(*(places - place).T).min() >= SPACING:
            places = np.concatenate([places, [place]])
    reach = np.array([_straight(house, place, places) for place in places])
    part = np.arange(len(places))
    for k in range(len(places)):
        part[np.isin(part, part[reach[k]])] = part[k]
    for place in free:
        row = _straight(house, place, places)
        if len(set(part[row])) > 1:
            reach = np.block([[reach, row[:, None]], [row, False]])
            places = np.concatenate([places, [place]])
            part = np.append(np.where(np.isin(part, part[row]), part[row][0], part), part[row][0])
    return places, reach


def _straight(house: House, place: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Which places [P,2] a robot at another one can drive to along a line, [P] bool."""
    line = place + np.linspace(0, 1, 40)[:, None, None] * (places - place)
    column, row = np.moveaxis(((line - house.floor.origin) / CELL).astype(int), -1, 0)
    gap = np.hypot(*(places - place).T)
    return house.floor.free[row, column].all(axis=0) & (gap > 0) & (gap <= REACH)


def _piece(state: np.ndarray, way: float, turn: float) -> np.ndarray:
    """Poses along one motion at the robot's speed, one every 1 / RATE s, the end included."""
    size, speed, gain = ((abs(turn), ROBOT.max_angular, ROBOT.angular_acceleration) if turn else
                         (way, ROBOT.max_linear, ROBOT.linear_acceleration))
    if size == 0.0:
        return state[None]
    ramp = min(speed / gain, math.sqrt(size / gain))
    last = size / (gain * ramp) + ramp
    at = np.append(np.arange(0, last, 1 / RATE), last)
    share = (gain * (np.minimum(at, ramp)**2 / 2 + ramp * np.clip(at - ramp, 0, last - 2 * ramp))
             + gain * ramp**2 / 2 - gain * np.minimum(last - at, ramp)**2 / 2) / size
    poses = np.repeat(state[None], len(at), axis=0)
    poses[:, :2] += share[:, None] * way * np.array([math.cos(state[2]), math.sin(state[2])])
    poses[:, 2] += share * turn
    return poses


def drift(poses: np.ndarray, factor: float, scale: float, seed: int) -> np.ndarray:
    """Odometry [N,3] of a true drive [N,3], from its first pose on.

    Args:
        poses: the truth.
        factor: of the errors of `vn_sim_bridge.robot.odometry`.
        scale: share by which all ways and turns are counted too long.
        seed: of the errors.
    """
    chance = np.random.default_rng(seed)
    out = poses.copy()
    for k, motion in enumerate(between(poses[:-1], poses[1:])):
        out[k + 1] = advance(out[k], (1 + scale) * motion,
                             drift_errors(motion, factor, chance.normal(size=3)))
    return out


def drive(house: House, seconds: float, size: int, randomisation: str, seed: int) -> Drive:
    """A tour, rendered in one light and through one camera."""
    poses, times = tour(house, seconds, seed)
    simulator = HouseSimulator([house], [0], robot=ROBOT, size=size,
                           randomisation=load_randomisation(randomisation))
    drawn = simulator.appearance(seed, Stream.APPEARANCE, [0], [0])
    images = np.empty((len(poses), 3, size, size), np.uint8)
    depth = np.empty((len(poses), size, size), np.uint8)
    for first in range(0, len(poses), BATCH):
        part = np.arange(first, min(first + BATCH, len(poses)))
        seen: Frames = simulator.view(
            np.zeros(len(part), np.int64), np.column_stack([poses[part], 0 * part]), None,
            type(drawn)(*(np.repeat(field, len(part), axis=0) for field in drawn)),
            key(seed, Stream.SENSOR, part, 0))
        images[part] = seen.rgb
        depth[part] = np.clip(seen.depth * 25.5, 1, 255)
    return Drive(poses, times, images, depth)


def errors(poses: np.ndarray, truth: np.ndarray) -> tuple[float, float, float]:
    """Of poses after their best rigid fit: RMS and largest distance [m], RMS heading [deg]."""
    a, b = poses[:, :2] - poses[:, :2].mean(0), truth[:, :2] - truth[:, :2].mean(0)
    angle = math.atan2((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum(), (a * b).sum())
    c, s = math.cos(angle), math.sin(angle)
    gap = np.hypot(*(a @ np.array([[c, s], [-s, c]]) - b).T)
    yaw = wrap_angle(poses[:, 2] + angle - truth[:, 2])
    return math.sqrt((gap**2).mean()), gap.max(), math.degrees(math.sqrt((yaw**2).mean()))


def false(closures: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Which closures are not true, [K] bool."""
    real, stated = between(truth[closures['first']], truth[closures['second']]), closures['motion']
    ahead = stated[:, :2] / np.maximum(np.hypot(stated[:, 0], stated[:, 1]), 1e-9)[:, None]
    across = np.abs(real[:, 0] * ahead[:, 1] - real[:, 1] * ahead[:, 0])
    return ((across > FALSE[0]) | (np.hypot(real[:, 0], real[:, 1]) > FAR)
            | (np.abs(wrap_angle(real[:, 2] - stated[:, 2])) > FALSE[1]))


def main():
    """Drive, add drift, close loops, report."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--houses', type=int, nargs='+', default=[12000, 12001])
    parser.add_argument('--rooms', type=int, default=5)
    parser.add_argument('--minutes', type=float, default=10.0)
    parser.add_argument('--size', type=int, nargs='+', default=[128])
    parser.add_argument('--drift', type=float, nargs='+', default=[1.0])
    parser.add_argument('--randomisation', default='standard')
    parser.add_argument('--depth', action='store_true', help='the bag has depth pictures')
    parser.add_argument('--seed', type=int, default=0)
    arguments = parser.parse_args()
    pin(1)
    cv2.setNumThreads(1)
    print('house size drift pictures |  odometry: m  (max)   deg |      after: m  (max)   deg | '
          'closures  false      s')
    for house in arguments.houses:
        for size in arguments.size:
            driven = drive(generate_house(house, rooms=arguments.rooms), 60 * arguments.minutes,
                           size, arguments.randomisation, arguments.seed)
            for factor in arguments.drift:
                _compare(house, driven, factor, arguments)


def _compare(house: int, driven: Drive, factor: float, arguments: argparse.Namespace) -> None:
    odometry = drift(driven.pose, factor, arguments.seed)
    drives = SimpleNamespace(
        image=driven.image, pose=odometry, time=driven.time,
        episode=np.zeros(len(odometry), np.int64), depth=driven.depth if arguments.depth else None)
    begun = time.process_time()
    made = optimise_odometry(drives, ROBOT)
    spent = time.process_time() - begun
    before, after = errors(odometry, driven.pose), errors(made.poses, driven.pose)
    print(f'{house:5} {driven.image.shape[-1]:4} {factor:5.1f} {len(odometry):8} | '
          f'{before[0]:12.2f} {before[1]:7.2f} {before[2]:5.1f} | '
          f'{after[0]:12.2f} {after[1]:7.2f} {after[2]:5.1f} | {len(made.closures):8} '
          f'{int(false(made.closures, driven.pose).sum()):6} {spent:6.0f}  {made.facts}',
          flush=True)


if __name__ == '__main__':
    main()

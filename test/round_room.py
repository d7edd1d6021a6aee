"""A round room in a few lines of geometry, and drives through it, for learning from drives.

Its wall has a colour for every direction, so that one picture tells where the robot stands and
looks. A driver turns to a place, drives there, and turns to the heading that is wanted.
"""

from __future__ import annotations

import math

import numpy as np

from vn_nav.bags.dataset import DriveSet
from vn_nav.bags.segmenter import NO_ACTION
from vn_nav.robot import DRIVE_ACTIONS, RobotSpec

ROBOT = RobotSpec().with_actions(DRIVE_ACTIONS)
RADIUS, CEILING = 4.0, 2.6  # m
LIMIT = 2.8  # m from the centre, for the driver


def look(poses: np.ndarray, size: int = 36) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pictures [N,3,S,S] uint8, depth [N,S,S] m, labels [N,S,S]: 1 wall, 2 floor, 3 ceiling."""
    slope = (np.arange(size) + 0.5 - size / 2) / (size / 2)
    angle = -np.arctan(slope)  # left is positive
    heading = poses[:, 2:3] + angle
    along = np.stack([np.cos(heading), np.sin(heading)], axis=2)
    at = poses[:, None, :2]
    b = (at * along).sum(2)
    reach = -b + np.sqrt(b**2 - (at**2).sum(2) + RADIUS**2)
    hit = at + reach[..., None] * along
    wall = reach * np.cos(angle)  # [N,S] depth of the columns
    phi = np.arctan2(hit[..., 1], hit[..., 0])
    colour = 128 + np.stack([80 * np.cos(phi) + 30 * np.cos(7 * phi),
                             80 * np.sin(phi) + 30 * np.cos(5 * phi + 1),
                             60 * np.cos(2 * phi + 1) + 50 * np.sin(9 * phi)], axis=1)
    down = slope[None, :, None]
    floor = down > ROBOT.camera_height / wall[:, None]
    ceiling = -down > (CEILING - ROBOT.camera_height) / wall[:, None]
    image = np.where(floor[:, None], 70.0, np.where(ceiling[:, None], 200.0, colour[:, :, None]))
    depth = np.where(floor, ROBOT.camera_height / np.abs(down), np.where(
        ceiling, (CEILING - ROBOT.camera_height) / np.abs(down), wall[:, None]))
    labels = np.where(floor, 2, np.where(ceiling, 3, 1))
    return image.astype(np.uint8), depth.astype(np.float32), labels.astype(np.uint8)


def advance(pose: np.ndarray, action: int) -> np.ndarray:
    """A pose [3] after one of the robot's actions."""
    dx, dy, turn = ROBOT.moves[action]
    c, s = math.cos(pose[2]), math.sin(pose[2])
    return pose + [c * dx - s * dy, s * dx + c * dy, turn]


def towards(pose: np.ndarray, goal: np.ndarray) -> int | None:
    """What the driver does; None: it is there."""
    gap = goal[:2] - pose[:2]
    heading = math.atan2(gap[1], gap[0]) if np.hypot(*gap) > 0.3 else goal[2]
    turn = (heading - pose[2] + math.pi) % (2 * math.pi) - math.pi
    if abs(turn) > math.radians(16):
        return 2 if turn > 0 else 3
    return 0 if np.hypot(*gap) > 0.3 else None


def drive(rng: np.random.Generator) -> tuple[np.ndarray, list[int]]:
    """Poses [N,3] and actions of an episode; the last pose has none."""
    def somewhere():
        r, phi, yaw = rng.random(3) * [1.0, 2 * math.pi, 2 * math.pi]
        r = LIMIT * math.sqrt(r)
        return np.array([r * math.cos(phi), r * math.sin(phi), yaw])
    pose, goal = somewhere(), somewhere()
    poses, actions = [pose], []
    while (action := towards(pose, goal)) is not None and len(poses) < 40:
        pose = advance(pose, action)
        poses.append(pose)
        actions.append(action)
    return np.array(poses), actions


def drive_set(episodes: int, seed: int = 0, *, depth: bool = True, labels: bool = True,
              size: int = 36, lengths: list[int] | None = None) -> DriveSet:
    """Recorded episodes of two steps at least; `lengths` cuts or joins them to these instead."""
    rng, rows = np.random.default_rng(seed), []
    wanted = lengths or [0] * episodes
    for number, length in enumerate(wanted):
        poses, actions = np.zeros((0, 3)), []
        while len(poses) < max(length, 2):
            more, done = drive(rng)
            actions += [NO_ACTION] * bool(len(poses)) + done  # the drives do not join
            poses = np.concatenate([poses, more])
        poses = poses[:length or None]
        actions = [*actions[:len(poses) - 1], NO_ACTION]
        rows += [(*pose, action, number) for pose, action in zip(poses, actions, strict=True)]
    table = np.array(rows)
    image, metres, classes = look(table[:, :3], size)
    count = len(table)
    return DriveSet(
        image=image, pose=table[:, :3], time=np.arange(count) * 1.0,
        action=table[:, 3].astype(np.int16), episode=table[:, 4].astype(np.int64),
        goal=np.full(count, -1), goals=np.zeros((0, 3, size, size), np.uint8),
        depth=np.clip(metres * 25.5, 1, 255).astype(np.uint8) if depth else None,
        labels=classes if labels else None, facts={})

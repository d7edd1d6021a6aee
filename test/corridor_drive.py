"""A drive through a corridor, and other short ways, as places."""

import math

import numpy as np

from vn_nav.arrival import wrap_angle
from vn_nav.robot import DRIVE_ACTIONS, RobotSpec
from vn_sim_bridge.recorded.image_graph import build_graph

ROBOT = RobotSpec().with_actions(DRIVE_ACTIONS)
SIZE = 16


def line(length, yaw=0.0, x=0.0, y=0.0, every=0.1):
    """Poses along a straight way."""
    along = np.arange(0, length + 1e-9, every)
    return np.column_stack([x + along * math.cos(yaw), y + along * math.sin(yaw),
                            np.full(len(along), yaw)])


def spin(x, y, yaw=0.0):
    """Poses of a turn on the spot."""
    return np.array([[x, y, wrap_angle(yaw + math.radians(a))] for a in range(0, 360, 10)])


def show(poses):
    """A picture of each pose, unlike any other."""
    return np.stack([np.random.default_rng(k).integers(0, 256, (3, SIZE, SIZE), np.uint8)
                     for k in range(len(poses))])


def graph_of(*parts, episode=None, **options):
    """A graph of some pieces of a drive, one episode if nothing else is said."""
    poses = np.concatenate(parts)
    episode = np.zeros(len(poses), int) if episode is None else episode
    return build_graph(show(poses), poses, episode, ROBOT, world_version='recorded', **options)


def corridor_graph():
    """Forth and back through a corridor of 4 m, with a turn on the spot at each metre."""
    parts = []
    for x in range(4):
        parts += [spin(x, 0), line(1, x=x)]
    return graph_of(*parts, spin(4, 0), line(4, math.pi, x=4), goals=12)

"""Corridors that differ: with many classes, without depth or labels, with objects, with rooms."""

import dataclasses
import sys
import types

import numpy as np

from examples import corridor
from vn_sim_bridge import simulators
from vn_sim_bridge.floor.distance import FloorDistance
from vn_sim_bridge.floor.floor_map import Rect, Room, floor_map
from vn_sim_bridge.simulator import Goal, no_objects

BASE = corridor.CorridorSimulator
SHIFT = 290  # of the class ids of `ManyLabels`
CLASSES = 300


class ManyLabels(BASE):
    """The same walls, with numbers that a byte does not hold."""

    label_names = tuple(f'class {number}' for number in range(CLASSES))

    def draw(self, place_index, poses):
        frames = super().draw(place_index, poses)
        return frames._replace(labels=frames.labels.astype(np.uint16) + np.uint16(SHIFT))


class Lacking(BASE):
    """Sees colours alone."""

    capabilities = dataclasses.replace(BASE.capabilities, depth=False, labels=False)
    label_names = ()

    def draw(self, place_index, poses):
        frames = super().draw(place_index, poses)
        return frames._replace(depth=np.zeros_like(frames.depth),
                               labels=np.zeros_like(frames.labels))


class Placing(BASE):
    """Puts objects onto the floor; nobody sees them."""

    capabilities = dataclasses.replace(BASE.capabilities, placeable_objects=True)
    task_objects = {'object': ('cone', 'flag', 'lamp'), 'collect': ('flag', 'cone')}

    def __init__(self, places, setup):
        super().__init__(places, setup)
        self.objects = no_objects(setup.num_envs, setup.objects)

    def set_objects(self, env_id, placed):
        self.objects.scene[env_id] = -1
        for m, item in enumerate(placed):
            self.objects.scene[env_id, m] = item.model
            self.objects.pose[env_id, m] = item.x, item.y, 0.0, item.yaw


class Flat(corridor.Corridor):
    """Two rooms, one behind the other, on a floor map; the way in between is open."""

    def __init__(self, name, length):
        super().__init__(name, length)
        half = length / 2
        self.rooms = (Room('kitchen', 'kitchen', Rect(0.0, -1.0, half, 1.0)),
                      Room('hall', 'hall', Rect(half, -1.0, length, 1.0)))
        self.goals = (Goal((1.0, 0.0, 0.0, 0.0), 'kitchen'),
                      Goal((length - 1.0, 0.0, 0.0, 0.0), 'hall'))
        self.floor = floor_map(Rect(0.0, -1.0, length, 1.0), np.zeros((0, 4)), 0.18)

    def starts(self):
        return self.floor.centres(), None

    def distance_to(self, goal):
        return FloorDistance(self.floor, *goal.pose[:2])


class Roomy(BASE):
    """A corridor with rooms."""

    capabilities = dataclasses.replace(BASE.capabilities, rooms=True)
    label_names = ('fridge', 'ceiling', 'bench')  # so a floor is of kitchens, and a wall of halls

    @classmethod
    def open(cls, scenes, setup):
        return cls([Flat(str(scene), int(scene.place)) for scene in scenes], setup)


def register(monkeypatch, name, kind):
    """Give a class a name for its scenes."""
    module = types.ModuleType(f'corridor_{name}')
    module.SIMULATOR = kind
    monkeypatch.setitem(sys.modules, module.__name__, module)
    monkeypatch.setitem(simulators.TABLE, name, simulators.Entry(
        module.__name__, 'a corridor of a test', f'{name}:5'))

"""A simulator of our own in one file: a straight corridor with a coloured wall at every metre.

    export PYTHONPATH=.
    vn_nav train --scene examples.corridor:8 --minutes 2 --out runs/corridor
    vn_nav evaluate runs/corridor/checkpoint
    sim_bridge_node --ros-args -p scene:=examples.corridor:8

`examples.corridor:8` is 8 m long. `test/simulators/test_corridor.py` holds it to the contract.
"""

import numpy as np

from vn_nav.scenes import options_of, whole_number
from vn_sim_bridge.simulator import (
    BaseSimulator,
    Capabilities,
    Frames,
    Goal,
    Motion,
    StraightDistance,
)

HALF, HEIGHT = 1.0, 2.4  # m: half the width, and the height
COLOURS = np.random.default_rng(0).integers(40, 256, (64, 3)).astype(np.uint8)


class Corridor:
    """A place along the x axis, from 0 to its length."""

    def __init__(self, name, length):
        self.name, self.length = name, length
        self.goals = tuple(Goal((x, 0.0, side * np.pi / 2, 0.0), f'{x:g} m') for side in (1, -1)
                           for x in np.arange(1.0, length, 2.0).tolist())

    def starts(self):
        grid = np.meshgrid(np.arange(0.5, self.length - 0.4, 0.25), np.linspace(-0.5, 0.5, 5))
        return np.stack(grid, -1).reshape(-1, 2), None

    def distance_to(self, goal):
        return StraightDistance(goal)  # nothing stands in the way

    def plan(self):
        return {'scene': self.name, 'bounds': [0.0, -HALF, self.length, HALF],
                'area': 2 * HALF * self.length, 'rooms_list': [], 'walls': [], 'obstacles': [],
                'outside': [], 'goals': [goal._asdict() for goal in self.goals]}


class CorridorSimulator(BaseSimulator):
    """Robots in corridors: motion up to the walls, and a ray through each pixel."""

    capabilities = Capabilities(continuous=True, depth=True, labels=True, geodesic=True,
                                tilt=False)
    label_names = ('floor', 'ceiling', 'wall')

    @classmethod
    def open(cls, scenes, setup):
        for scene in scenes:
            options_of(scene, ())
        return cls([Corridor(str(scene), whole_number(scene, 'length', scene.place))
                    for scene in scenes], setup)

    def bounds(self, place_index):
        """The corners [K,3] of places [K]: least and greatest x, y, z."""
        length = np.array([place.length for place in self.places], float)[place_index]
        least = np.tile([0.0, -HALF, 0.0], (len(length), 1))
        return least, np.column_stack([length, HALF + 0 * length, HEIGHT + 0 * length])

    def move(self, delta, env_ids=None):
        env_ids = self._all if env_ids is None else env_ids
        x, y, yaw, _ = self.poses[env_ids].T
        heading = yaw + delta[:, 2] / 2
        c, s = np.cos(heading), np.sin(heading)
        way = np.stack([c * delta[:, 0] - s * delta[:, 1], s * delta[:, 0] + c * delta[:, 1]], 1)
        least, most = (part[:, :2] for part in self.bounds(self.place_index[env_ids]))
        room = np.where(way > 0, most - self.robot.footprint_radius - np.stack([x, y], 1),
                        least + self.robot.footprint_radius - np.stack([x, y], 1))
        with np.errstate(divide='ignore', invalid='ignore'):
            share = np.clip(np.where(way != 0, room / way, 1.0).min(axis=1), 0.0, 1.0)
        self.poses[env_ids, :2] += share[:, None] * way
        self.poses[env_ids, 2] = (yaw + delta[:, 2] + np.pi) % (2 * np.pi) - np.pi
        done = delta * [[1.0, 1.0, 1.0, 0.0]]
        done[:, :2] *= share[:, None]
        return Motion(done, share < 1.0)

    def draw(self, place_index, poses):
        cameras, fov = self.cameras(poses)
        size = self.setup.size
        cy, sy, cp, sp = (f(cameras[:, k]) for k in (3, 4) for f in (np.cos, np.sin))
        forward, right = np.stack([cp * cy, cp * sy, -sp], 1), np.stack([sy, -cy, 0 * cy], 1)
        down = np.stack([-sp * cy, -sp * sy, -cp], 1)
        slope = (np.arange(size) + 0.5 - size / 2) / (size / 2 / np.tan(fov[0] / 2))
        ray = (forward[:, None, None] + slope[None, None, :, None] * right[:, None, None]
               + slope[None, :, None, None] * down[:, None, None])  # [K,S,S,3], depth 1
        at = cameras[:, None, None, :3]
        least, most = (part[:, None, None] for part in self.bounds(place_index))
        with np.errstate(divide='ignore', invalid='ignore'):
            gap = np.where(ray > 0, most - at, least - at) / np.where(ray == 0, np.nan, ray)
        axis = np.nanargmin(gap, axis=3)
        depth = np.take_along_axis(gap, axis[..., None], 3)[..., 0]
        metre = np.floor(at[..., 0] + depth * ray[..., 0] + 1e-6).astype(int)
        rises = np.take_along_axis(ray, axis[..., None], 3)[..., 0] > 0
        rgb = COLOURS[np.where(axis == 2, 60 + rises, (2 * metre + rises) % 60)]
        return Frames(np.ascontiguousarray(rgb.transpose(0, 3, 1, 2)), depth.astype(np.float32),
                      np.where(axis < 2, 2, rises).astype(np.uint8),
                      np.zeros(axis.shape, np.uint16))


SIMULATOR = CorridorSimulator

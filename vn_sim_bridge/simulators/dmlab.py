"""DeepMind Lab: `dmlab:arena`, `dmlab:maze?seed=3`, `dmlab:house`, and levels of others.

The engine draws and pays; it runs in processes of its own (`vn_sim_bridge.dmlab`). In levels of
ours robots move among the walls of the text map that the engine's level was built of; in others
along rays through the engine's own walls. Then the engine's player is put there and comes to rest,
so that pictures, depth and what it touches are the engine's.
"""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from vn_nav.errors import UserError
from vn_nav.scenes import SceneName, options_of, whole_number
from vn_sim_bridge.dmlab import maps
from vn_sim_bridge.dmlab.engines import FOLDER, Engines
from vn_sim_bridge.dmlab.install import MAPS, cache_folder, interpreter
from vn_sim_bridge.dmlab.maps import UNITS, LevelPlace, TextPlace, wrapped
from vn_sim_bridge.floor.contacts import World
from vn_sim_bridge.floor.places import walled
from vn_sim_bridge.simulator import BaseSimulator, Capabilities, Frames, Motion, Setup

FLOOR = 1.0  # units: of a text map's floor
VIEW_HEIGHT = 26.0  # units of the engine's eye above its player's origin
STANDING = 24.125  # units of the origin above the floor, where the engine put its player
NEAREST = 4.0  # units: the near plane of its depth
CEILING = 1.1  # m that a camera may stand above the floor
SPAWNS = 8  # episodes of a level that say where it lets its player begin
# Metres of each value d of the depth picture, the upper 8 bits of a z-buffer: with its far plane
# at infinity, d = 255 (1 - NEAREST / z), rounded down. The engine puts the far plane just behind
# what it draws, which adds 255 NEAREST / far: 1.5 in our levels, within one. 255: nothing at all.
BEHIND = 0.5 + 1.5
DEPTH = np.zeros(256, np.float32)
DEPTH[:255] = NEAREST * 255 / (255 + BEHIND - np.arange(255)) / UNITS
TEXT = Capabilities(continuous=True, depth=True, labels=False, geodesic=True, tilt=False,
                    walls=True)
NATIVE = Capabilities(continuous=True, depth=True, labels=False, geodesic=False, tilt=False)


class LabSimulator(BaseSimulator):
    """N robots, each in an engine of its own (see `Simulator`).

    Args:
        levels: of the scenes: what the engine is told, and the place or None (ask the engine).
        setup: robots, camera, pictures.
    """

    capabilities = TEXT
    version = 'dmlab-1'  # of the engine's pictures and of our levels
    splits = {'train': tuple(f'dmlab:maze?seed={k}' for k in range(1000, 1064)),
              'validation': tuple(f'dmlab:maze?seed={k}' for k in range(100, 116)),
              'test': tuple(f'dmlab:maze?seed={k}' for k in range(200, 216))}

    @classmethod
    def open(cls, scenes: Sequence[SceneName], setup: Setup) -> LabSimulator:
        """See `BaseSimulator.open`.

        Raises:
            UserError: no engine, a scene that there is not, a camera that the engine has not.
        """
        check_robot(setup)
        return cls([level_of(scene, setup) for scene in scenes], setup)

    def __init__(self, levels: Sequence[tuple[dict, TextPlace | None, bool, str]], setup: Setup):
        paid = {pays for _, _, pays, _ in levels}
        own = {place is not None for _, place, _, _ in levels}
        if len(paid) > 1 or len(own) > 1 or (True in paid and len(levels) > setup.num_envs):
            raise UserError('scenes of one training all pay or none does, all are ours or none '
                            'is; those that pay are no more than environments',
                            ', '.join(name for *_, name in levels), 'choose others')
        self._pays, ours = paid.pop(), own.pop()
        self._settings = [settings for settings, *_ in levels]
        n = setup.num_envs
        self._width = -(-setup.size // 4) * 4
        self._entered = np.arange(n) % len(levels)  # the level that each engine has open
        self._seeds = np.zeros(n, np.int64)  # of the engines' episodes
        self.engines = Engines(interpreter(), n, 2 * n, self._width, self._opening)
        self._height = setup.robot.camera_height * UNITS - VIEW_HEIGHT
        try:
            places, floors = self._open_all(levels, n)
        except BaseException:
            self.engines.close()
            raise
        super().__init__(places, setup)
        self._z = np.array(floors) + self._height
        self.capabilities = Capabilities(**{
            **vars(TEXT if ours else NATIVE), 'rewards': self._pays, 'teleport': not self._pays})
        self.world: World | None = None
        if ours:
            self.world = World([walled(place) for place in self.places], self.place_index,
                               setup.robot.footprint_radius)
            # One array each, in the world and here: a move changes both.
            self.poses, self.place_index = self.world.poses, self.world.place_index
        self.engines.broken[:] = False  # no episode has begun
        self._drawn = np.full((n, 4), np.nan)  # poses of the pictures in the memory

    def _opening(self, n: int) -> list[dict]:
        """What opens the level of engine n and begins its episode."""
        level = int(self._entered[n])
        settings = self._settings[level]
        first = int(settings.get('seed', self._seeds[n]))
        requests = [
            {'do': 'open', 'level': 'vn_nav', 'folder': str(FOLDER / 'levels'),
             'cache': str(cache_folder()), 'width': self._width,
             'settings': {key: str(value) for key, value in settings.items()}},
            {'do': 'reset', 'seed': first}]
        if first != self._seeds[n]:
            requests.append({'do': 'reset', 'seed': int(self._seeds[n])})
        return requests

    def _open_all(self, levels, n: int):
        """Places and floors [units]; each map is compiled once, then all engines take it."""
        first = range(min(n, len(levels)))
        self.engines.start(first)
        self.engines.start(range(len(first), n))
        places, floors = [], []
        for index, (_, place, _, name) in enumerate(levels):
            if place is None:
                engine = index % n
                self._switch(engine, index)
                found = [self.engines.ask({engine: {'do': 'reset', 'seed': seed}})[engine]['pose']
                         for seed in range(SPAWNS)]
                spawns = np.unique(np.round(np.array(found), 2), axis=0)
                floors.append(float(spawns[:, 2].min()) - STANDING)
                places.append(LevelPlace(name, np.column_stack([
                    spawns[:, :2] / UNITS, wrapped(np.radians(spawns[:, 3]))])))
            else:
                floors.append(FLOOR)
                places.append(place)
        return places, floors

    def _switch(self, engine: int, level: int) -> None:
        """Let an engine play a level."""
        if self._entered[engine] != level:
            self._entered[engine] = level
            self.engines.start([engine])

    def enter(self, env_ids: np.ndarray, places: np.ndarray) -> None:
        """See `Simulator`."""
        super().enter(env_ids, places)
        self._drawn[env_ids] = np.nan

    def place(self, env_ids: np.ndarray, poses: np.ndarray) -> None:
        """See `Simulator`; the engine is told when it draws."""
        self.poses[env_ids] = poses

    def spawn(self, env_ids: np.ndarray, keys: np.ndarray) -> None:
        """Begin episodes of levels that pay: the seed says where fruit lies and robots begin."""
        self._seeds[env_ids] = (np.asarray(keys) % np.uint64(2**31 - 1)).astype(np.int64)
        for n in env_ids:
            self._switch(int(n), int(self.place_index[n]))
        found = self.engines.ask({int(n): {'do': 'reset', 'seed': int(self._seeds[n])}
                                  for n in env_ids})
        for n, key in zip(env_ids, keys, strict=True):
            place = self.places[self.place_index[n]]
            if isinstance(place, TextPlace):
                cells, _ = place.starts()
                part = int(key) // (2**31)
                self.poses[n] = (*cells[part % len(cells)],
                                 wrapped((part // len(cells)) % 4096 * 2 * math.pi / 4096), 0.0)
            else:
                x, y, _, yaw = found[int(n)]['pose']
                self.poses[n] = x / UNITS, y / UNITS, wrapped(math.radians(yaw)), 0.0
        self._drawn[env_ids] = np.nan

    def move(self, delta: np.ndarray, env_ids: np.ndarray | None = None) -> Motion:
        """Displace robots by [K,4] in their own frames, up to the first contact."""
        env_ids = self._all if env_ids is None else np.asarray(env_ids)
        if self.world is not None:
            done, touched = self.world.move(np.asarray(delta, float) * [[1, 1, 1, 0]], env_ids)
        else:
            done, touched = self._along_rays(np.asarray(delta, float), env_ids)
        if not self._pays:
            return Motion(done, touched)
        found = self._go(env_ids, act=True)
        return Motion(done, touched,
                      np.array([found[int(n)]['reward'] for n in env_ids], np.float32),
                      np.array([found[int(n)]['ended'] for n in env_ids], bool))

    def _along_rays(self, delta: np.ndarray, env_ids: np.ndarray
                    ) -> tuple[np.ndarray, np.ndarray]:
        length = np.hypot(delta[:, 0], delta[:, 1])
        yaw = self.poses[env_ids, 2]
        heading = yaw + delta[:, 2] / 2 + np.arctan2(delta[:, 1], delta[:, 0])
        share, going = np.ones(len(env_ids)), np.nonzero(length > 0)[0]
        free = self._free(env_ids[going], heading[going, None], length[going])
        if len(going):
            share[going] = np.minimum(free[:, 0] / length[going], 1.0)
        travelled = share * length
        self.poses[env_ids, 0] += travelled * np.cos(heading)
        self.poses[env_ids, 1] += travelled * np.sin(heading)
        self.poses[env_ids, 2] = wrapped(yaw + delta[:, 2])
        done = delta * np.column_stack([share, share, np.ones_like(share), 0 * share])
        return done, share < 1.0

    def _free(self, env_ids: np.ndarray, headings: np.ndarray, lengths: np.ndarray
              ) -> np.ndarray:
        """How far robots [K] get along headings [K,H] rad, up to lengths [K] m; [K,H] m."""
        requests = {}
        for n, ways, length in zip(env_ids, headings, lengths, strict=True):
            self._ready(int(n))
            x, y = self.poses[n, :2] * UNITS
            z = self._z[self.place_index[n]] - self._height + STANDING
            requests[int(n)] = {'do': 'free', 'ways': [
                [float(x), float(y), float(z), math.degrees(wrapped(way)), float(length) * UNITS]
                for way in ways]}
        found = self.engines.ask(requests)
        free = [found[int(n)]['free'] for n in env_ids]
        return np.array(free, float).reshape(headings.shape) / UNITS

    def reach(self, env_id: int, headings: np.ndarray, length: float) -> np.ndarray:
        """Where a translation of `length` [m] along each heading [rad] would end, [K,2] m."""
        if self.world is not None:
            return self.world.reach(env_id, headings, length)
        free = np.minimum(self._free(np.array([env_id]), np.asarray(headings)[None],
                                     np.array([length]))[0], length)
        return self.poses[env_id, :2] + free[:, None] * np.stack(
            [np.cos(headings), np.sin(headings)], 1)

    def _ready(self, n: int) -> None:
        """Engine n plays the level of the place that its robot is in."""
        self._switch(n, int(self.place_index[n]))

    def _pose(self, pose: np.ndarray, place: int) -> list[float]:
        """A pose [4] as the engine takes it."""
        return [float(pose[0]) * UNITS, float(pose[1]) * UNITS, float(self._z[place]),
                math.degrees(wrapped(float(pose[2])))]

    def _go(self, env_ids: np.ndarray, act: bool = False) -> dict[int, dict]:
        """Put the engines' players where the robots are, and draw."""
        requests = {}
        for n in map(int, env_ids):
            self._ready(n)
            requests[n] = {'do': 'go', 'poses': [self._pose(self.poses[n], self.place_index[n])],
                           'rows': [n], 'act': act}
        found = self.engines.ask(requests)
        self._drawn[env_ids] = self.poses[env_ids]
        return found

    def observe(self, env_ids: np.ndarray | None = None, keys: np.ndarray | None = None) -> Frames:
        """See `Simulator`."""
        env_ids = self._all if env_ids is None else np.asarray(env_ids)
        stale = env_ids[(self._drawn[env_ids] != self.poses[env_ids]).any(axis=1)]
        if len(stale):
            self._go(stale)
        return self._frames(self.engines.pictures[env_ids])

    def view(self, place_index: np.ndarray, poses: np.ndarray, out=None, appearance=None,
             keys=None, placed=None) -> Frames:
        """See `Simulator`; all engines that play the places share the work."""
        place_index, n = np.asarray(place_index), self.num_envs
        pictures = np.empty((len(poses), self._width, self._width, 4), np.uint8)
        for place in np.unique(place_index):
            of_place = np.nonzero(place_index == place)[0]
            engines = np.nonzero(self._entered == place)[0]
            if not len(engines):
                self._switch(int(place) % n, int(place))
                engines = np.array([int(place) % n])
            for begin in range(0, len(of_place), len(engines)):
                rows = of_place[begin:begin + len(engines)]
                self.engines.ask({int(engine): {
                    'do': 'go', 'poses': [self._pose(poses[k], int(place))],
                    'rows': [n + int(engine)]} for engine, k in zip(engines, rows, strict=False)})
                pictures[rows] = self.engines.pictures[n + engines[:len(rows)]]
        return self._frames(pictures)

    def _frames(self, pictures: np.ndarray) -> Frames:
        """Pictures [K,W,W,4] of the engine as frames of the size that was asked for."""
        size = self.setup.size
        if size != self._width:
            import cv2
            half = (np.arange(size) + 0.5) * self._width / size
            rgb = np.stack([cv2.resize(picture[..., :3], (size, size),
                                       interpolation=cv2.INTER_AREA) for picture in pictures])
            nearest = half.astype(int)  # depth of two surfaces has no mean
            depth = pictures[:, nearest][:, :, nearest, 3]
        else:
            rgb, depth = pictures[..., :3], pictures[..., 3]
        blank = np.zeros((len(pictures), size, size), np.uint8)
        return Frames(np.ascontiguousarray(rgb.transpose(0, 3, 1, 2)), DEPTH[depth], blank,
                      blank.astype(np.uint16))

    def broken_off(self) -> np.ndarray:
        """See `Simulator`: engines that crashed or hung, and were started again."""
        broken, self.engines.broken = self.engines.broken, np.zeros(self.num_envs, bool)
        return broken

    def close(self) -> None:
        """End the engines; a second time it does nothing."""
        self.engines.close()


def check_robot(setup: Setup) -> None:
    """Whether the engine has such a camera.

    Raises:
        UserError: it has not.
    """
    robot = setup.robot
    for kept, rule, received in (
            (robot.camera_pitch == 0, 'the camera in DeepMind Lab is level (camera_pitch 0)',
             robot.camera_pitch),
            (0.2 <= robot.camera_height <= CEILING, 'the camera in DeepMind Lab stands 0.2 to '
             f'{CEILING} m above the floor', robot.camera_height),
            (abs(robot.camera_fov - math.pi / 2) < 1e-6, 'the camera in DeepMind Lab has a field '
             'of view of 90 degrees', math.degrees(robot.camera_fov)),
            (not setup.models, 'DeepMind Lab has the objects of its levels', setup.models)):
        if not kept:
            raise UserError(rule, received, 'choose another robot or simulator')


def level_of(scene: SceneName, setup: Setup) -> tuple[dict, TextPlace | None, bool, str]:
    """What the engine is told, the place (None: of the engine's), whether it pays, its name.

    Raises:
        UserError: a scene that there is not.
    """
    radius = setup.robot.footprint_radius
    common = {'radius': radius * UNITS}
    if scene.place == 'arena':
        given = options_of(scene, ('apples', 'lemons', 'decisions'))
        rules = {name: whole_number(scene, name, given.get(name, str(default)))
                 for name, default in (('apples', 8), ('lemons', 8), ('decisions', 300))}
        level, name = maps.arena(), 'vn_arena'
        return ({**common, **rules, **_map(level, name)},
                TextPlace(str(scene), level, radius), True, str(scene))
    if scene.place in ('maze', 'house'):
        given = options_of(scene, ('seed', 'size') if scene.place == 'maze' else ())
        seed = whole_number(scene, 'seed', given.get('seed', '0'))
        size = whole_number(scene, 'size', given.get('size', '7'))
        if size % 2 == 0 or not 5 <= size <= 25:
            raise UserError('the size of a maze is an odd number from 5 to 25', size,
                            'name it as in dmlab:maze?seed=3&size=9')
        level = maps.house() if scene.place == 'house' else maps.maze(seed, size)
        name = 'vn_house' if scene.place == 'house' else f'vn_maze_{size}_{seed}'
        return ({**common, **_map(level, name)}, TextPlace(str(scene), level, radius), False,
                str(scene))
    if '/' in scene.place:
        seed = whole_number(scene, 'seed', options_of(scene, ('seed',)).get('seed', '0'))
        return ({**common, 'inner': scene.place, 'same_map_episodes': -1, 'seed': seed}, None,
                False, str(scene))
    options_of(scene, ())
    return {**common, 'bsp': scene.place, 'bsp_file': user_map(scene)}, None, True, str(scene)


def user_map(scene: SceneName) -> str:
    """The file of a map that the user has.

    Raises:
        UserError: it is not there.
    """
    folder = os.environ.get(MAPS)
    file = Path(folder or '.').absolute() / f'{scene.place}.bsp'
    if not folder or not file.is_file():
        raise UserError(
            'a level of DeepMind Lab is arena, maze, house, a level of the engine such as '
            f'custom/house, or a map NAME.bsp in the folder {MAPS}',
            f'no {scene.place}.bsp in {folder or "no folder"}',
            f'copy it from assets/maps/built of a DeepMind Lab checkout and set {MAPS}')
    return str(file)


def _map(level: maps.Level, name: str) -> dict:
    return {'map': level.map, 'looks': level.looks, 'cell': level.cell, 'name': name}


SIMULATOR = LabSimulator

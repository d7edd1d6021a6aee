"""A user's own House3D behind our protocol: `house3d:HOUSE_ID?labels=coarse`.

Its renderer draws and its grid of 1,000 cells says where the agent can be. Nothing of House3D is
installed by this package, and it is unmaintained: see docs/simulators/suncg.md. Only these of its
names are used:

- `House3D.objrender.RenderAPI(w, h, device)`, `House3D.core.Environment(api, house_id, config)`;
- of an environment: `reset(x, y, yaw)`, `move_forward(front, right)`, `rotate(degrees)`,
  `render(mode)`, `info` (`loc`, `yaw`); of its house: `connectedCoors`, `to_coor`, `all_rooms`.

A move that House3D refuses is halved until it fits: the robot stops at the contact, to 1 cm. It
knows no driving distances that our tasks could use, so arrival is judged by the straight line.
"""

from __future__ import annotations

import importlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from vn_nav.errors import UserError
from vn_nav.scenes import SceneName, options_of, whole_number
from vn_sim_bridge.simulator import (
    BaseSimulator,
    Capabilities,
    Distance,
    Frames,
    Goal,
    Motion,
    Setup,
)
from vn_sim_bridge.simulators.suncg import DEPTH_SCALE, categories_file, data_folder
from vn_sim_bridge.suncg.axes import box_to_map, yaw_to_map, yaw_to_suncg
from vn_sim_bridge.suncg.labels import NOTHING, read_colours
from vn_sim_bridge.suncg.place import room_kind

PRECISION = 0.01  # m, to which a contact is located


class House3dPlace:
    """A house as House3D knows it.

    Args:
        name: of the scene.
        env: a `House3D.core.Environment`.
    """

    def __init__(self, name: str, env: Any):
        self.name = name
        house = env.house
        cells = [house.to_coor(x, y, True) for x, y in house.connectedCoors]
        self._cells = np.array([(x, -z) for x, z in cells], float)  # of our frame
        goals = []
        for node in house.all_rooms:
            kinds = room_kind(node['roomTypes'])
            low, high = box_to_map(node['bbox']['min'], node['bbox']['max'])
            inside = ((self._cells >= low[:2]) & (self._cells <= high[:2])).all(axis=1)
            if not kinds or not inside.any():
                continue
            own = self._cells[inside]
            x, y = own[np.hypot(*(own - own.mean(axis=0)).T).argmin()]
            goals.append(Goal((float(x), float(y), 0.0, 0.0), kinds[0].replace('_', ' ')))
        self.goals = tuple(goals)
        if not self.goals:
            raise UserError('a house of House3D has a room of a known type', name,
                            'choose another house')

    def starts(self) -> tuple[np.ndarray, None]:
        """Where House3D says that the agent can be."""
        return self._cells, None

    def distance_to(self, goal: Goal) -> Distance | None:
        """Nobody knows the ways."""
        return None

    def plan(self) -> None:
        """There is no map."""


class House3dSimulator(BaseSimulator):
    """Agents of House3D, one environment of its own for each robot."""

    capabilities = Capabilities(continuous=True, depth=True, labels=True, geodesic=False,
                                tilt=False)
    places: list[House3dPlace]

    @classmethod
    def open(cls, scenes: Sequence[SceneName], setup: Setup) -> House3dSimulator:
        """See `BaseSimulator.open`."""
        core, objrender, common = (_module(name) for name in ('core', 'objrender', 'common'))
        options = [options_of(scene, ('data', 'labels', 'device')) for scene in scenes]
        if any(other != options[0] for other in options):
            raise UserError('scenes that are opened together have the same options',
                            ', '.join(map(str, scenes)), 'give the same to all')
        colormap = options[0].get('labels', 'coarse')
        if colormap not in ('coarse', 'fine'):
            raise UserError('labels of House3D are coarse or fine', colormap, 'choose one')
        folder = data_folder(options[0].get('data', ''))
        for scene in scenes:
            path = folder / 'house' / scene.place / 'house.obj'
            if not path.is_file():
                raise UserError('a scene of house3d is a house that was converted for it',
                                f'{scene}: no {path}', 'run the conversion that its '
                                'INSTRUCTION.md describes')
        config = common.create_default_config(str(folder / 'house'), colormap)
        config['modelCategoryFile'] = str(categories_file(folder))
        device = whole_number(scenes[0], 'device', options[0].get('device', '0'))
        envs = [core.Environment(objrender.RenderAPI(setup.size, setup.size, device=device),
                                 scenes[n % len(scenes)].place, config)
                for n in range(setup.num_envs)]
        spare = [envs[k] if k < len(envs) else core.Environment(
            objrender.RenderAPI(setup.size, setup.size, device=device), scene.place, config)
            for k, scene in enumerate(scenes)]
        return cls([str(scene) for scene in scenes], envs, spare, Path(config['colorFile']), setup)

    def __init__(self, names: Sequence[str], envs: Sequence[Any], spare: Sequence[Any],
                 colours: Path, setup: Setup):
        """Take environments.

        Args:
            names: of the scenes.
            envs: of each robot.
            spare: of each scene, to look from anywhere.
            colours: the file of its classes' colours.
            setup: robots, camera, pictures.
        """
        super().__init__([House3dPlace(name, env)
                          for name, env in zip(names, spare, strict=True)], setup)
        self._envs, self._spare = list(envs), list(spare)
        table = read_colours(colours)
        self.label_names = (NOTHING, *table)
        codes = np.array([r << 16 | g << 8 | b for r, g, b in table.values()])
        self._order = np.argsort(codes)
        self._codes = codes[self._order]
        for env in (*self._envs, *self._spare):
            env.cam.vertical_fov = float(np.degrees(self.robot.camera_fov))
            env.house.robotHei = self.robot.camera_height

    def enter(self, env_ids: np.ndarray, places: np.ndarray) -> None:
        """See `Simulator`; a robot's environment has its house for good."""
        moved = np.asarray(env_ids)[self.place_index[env_ids] != places]
        if len(moved):
            raise UserError('with house3d every robot stays in its house',
                            f'{len(self.places)} scenes, {self.num_envs} robots',
                            'use no more scenes than environments')

    def place(self, env_ids: np.ndarray, poses: np.ndarray) -> None:
        """See `Simulator`."""
        super().place(env_ids, poses)
        for n, pose in zip(np.asarray(env_ids), np.asarray(poses), strict=True):
            _put(self._envs[n], pose)

    def move(self, delta: np.ndarray, env_ids: np.ndarray | None = None) -> Motion:
        """See `Simulator`: half of the turn, the way, the other half."""
        env_ids = self._all if env_ids is None else np.asarray(env_ids)
        done, touched = np.array(delta, float), np.zeros(len(env_ids), bool)
        done[:, 3] = 0.0
        for k, n in enumerate(env_ids):
            env, (dx, dy, dyaw, _) = self._envs[n], delta[k]
            half = float(np.degrees(-dyaw / 2))
            if dyaw:
                env.rotate(half)
            share = _drive(env, float(dx), float(dy))
            if dyaw:
                env.rotate(half)
            done[k, :2] *= share
            touched[k] = share < 1.0
            x, z = env.info['loc']
            self.poses[n] = x, -z, (yaw_to_map(env.info['yaw']) + np.pi) % (2 * np.pi) - np.pi, 0.0
        return Motion(done, touched)

    def observe(self, env_ids: np.ndarray | None = None, keys: np.ndarray | None = None) -> Frames:
        """See `Simulator`."""
        env_ids = self._all if env_ids is None else env_ids
        return self._frames([self._envs[n] for n in env_ids])

    def draw(self, place_index: np.ndarray, poses: np.ndarray) -> Frames:
        """See `BaseSimulator`."""
        found = []
        for index, pose in zip(place_index, poses, strict=True):
            env = self._spare[index]
            before = env.info['loc'], env.info['yaw']
            _put(env, pose)
            found.append(self._frames([env]))
            (x, z), yaw = before  # it may be a robot's
            env.reset(x=x, y=z, yaw=yaw)
        return Frames(*(np.concatenate(parts) for parts in zip(*found, strict=True)))

    def _frames(self, envs: Sequence[Any]) -> Frames:
        rgb, depth, labels = [], [], []
        for env in envs:
            rgb.append(np.array(env.render('rgb'))[..., :3].transpose(2, 0, 1))
            grey = np.array(env.render('depth'))  # second channel: 255 where nothing is seen
            depth.append(np.where(grey[..., 1] > 0, 0.0, grey[..., 0] * (DEPTH_SCALE / 255)))
            colour = np.array(env.render('semantic'))[..., :3].astype(np.int64)
            code = colour[..., 0] << 16 | colour[..., 1] << 8 | colour[..., 2]
            at = np.minimum(np.searchsorted(self._codes, code), len(self._codes) - 1)
            labels.append(np.where(self._codes[at] == code, self._order[at] + 1, 0))
        shape = (len(envs), *depth[0].shape)
        return Frames(np.stack(rgb).astype(np.uint8), np.stack(depth).astype(np.float32),
                      np.stack(labels).astype(np.uint8), np.zeros(shape, np.uint16))

    def close(self) -> None:
        """Let go of its renderers."""
        self._envs, self._spare = [], []


def _module(name: str) -> Any:
    try:
        return importlib.import_module(f'House3D.{name}')
    except ImportError as error:
        raise UserError('the simulator house3d needs a House3D that Python finds', str(error),
                        'build it and put its folder on PYTHONPATH, or use suncg:HOUSE_ID, '
                        'which needs no House3D') from error


def _put(env: Any, pose: np.ndarray) -> None:
    env.reset(x=float(pose[0]), y=float(-pose[1]), yaw=float(yaw_to_suncg(pose[2])))


def _drive(env: Any, dx: float, dy: float) -> float:
    """Move forward and to the left [m] as far as House3D lets; the share of it that was driven."""
    length = float(np.hypot(dx, dy))
    if length == 0 or env.move_forward(dx, -dy):
        return 1.0
    (x, z), yaw = env.info['loc'], env.info['yaw']
    low, high = 0.0, 1.0
    while (high - low) * length > PRECISION:
        middle = (low + high) / 2
        if env.move_forward(dx * middle, -dy * middle):
            low = middle
            env.reset(x=x, y=z, yaw=yaw)  # shares are of the whole way
        else:
            high = middle
    if low:
        env.move_forward(dx * low, -dy * low)
    return low


SIMULATOR = House3dSimulator

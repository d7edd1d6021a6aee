"""AI2-THOR with the thesis's continuous motion: `thor:FloorPlan227`, `thor:procthor?file=...`.

Every robot has a Unity process of its own; those of several robots work at once. See
docs/simulators/thor.md.
"""

from __future__ import annotations

import importlib.metadata
import math
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from vn_nav.errors import UserError
from vn_nav.scenes import SceneName, options_of
from vn_nav.structured_file import read_json
from vn_sim_bridge.counter_random import Stream, key
from vn_sim_bridge.simulator import (
    BaseSimulator,
    Capabilities,
    Frames,
    Motion,
    Placed,
    Setup,
)
from vn_sim_bridge.thor.agent import Agent, Scene
from vn_sim_bridge.thor.frame import point_to_ours
from vn_sim_bridge.thor.names import LABEL_NAMES, SPLITS, class_of, scene_names
from vn_sim_bridge.thor.place import ThorPlace

PROCTHOR = 'procthor'
OURS = 2  # of our side; 1 (not written then) had motion noise on rotations, too
MOVES, OBJECTS = ('bisect', 'arm'), ('still', 'random')  # the first is the default

T = TypeVar('T')


def _client() -> str:
    """Version of the installed client, without importing it."""
    try:
        return importlib.metadata.version('ai2thor')
    except importlib.metadata.PackageNotFoundError:
        return 'missing'


class ThorSimulator(BaseSimulator):
    """N robots in scenes of AI2-THOR (see `Simulator`).

    Args:
        names, scenes: of the places, ours and AI2-THOR's.
        setup: robots, camera, pictures.
        arm: see `Agent`.
        shuffle: in every episode the movable objects lie elsewhere.
    """

    capabilities = Capabilities(continuous=True, depth=True, labels=True, geodesic=True,
                                tilt=True, own_objects=True)
    version = f'ai2thor-{_client()}-{OURS}'
    label_names = LABEL_NAMES
    exact_turns = True  # thesis, 5.6: noise along the motion alone
    # Which objects those are, each room says itself: `ThorPlace.object_goals`.
    task_objects = {'object': ('movable object of the room',)}
    splits = SPLITS
    places: list[ThorPlace]

    @classmethod
    def open(cls, scenes: Sequence[SceneName], setup: Setup) -> ThorSimulator:
        """See `BaseSimulator.open`."""
        options = [_options(scene) for scene in scenes]
        if len({(part['moves'], part['objects']) for part in options}) > 1:
            raise UserError('all scenes of AI2-THOR have the same moves and objects',
                            ', '.join(map(str, scenes)), 'name them with the same options')
        found = [_scene(scene, part) for scene, part in zip(scenes, options, strict=True)]
        return cls(list(map(str, scenes)), found, setup, arm=options[0]['moves'] == 'arm',
                   shuffle=options[0]['objects'] == 'random')

    def __init__(self, names: Sequence[str], scenes: Sequence[Scene], setup: Setup, *,
                 arm: bool = False, shuffle: bool = False):
        self.shuffle = shuffle or bool(setup.models)  # a task that looks for objects
        robot, count = setup.robot, setup.num_envs
        self._lost = np.zeros(count, bool)  # since `broken_off` was last asked
        self.agents = [Agent(setup.size, robot.camera_fov, robot.camera_pitch, arm=arm)
                       for _ in range(count)]
        self._pool = ThreadPoolExecutor(count, 'thor')
        portraits = bool(setup.models)
        try:
            # One alone: what cannot start, or has to be fetched first, says so once.
            first = self._place(0, names[0], scenes[0], portraits)
            rest = self._by_agent(range(1, len(names)), lambda index: self._place(
                index % count, names[index], scenes[index], portraits), lambda k: k % count)
            super().__init__([first, *rest], setup)
            self._each(self._all, self._return)
        except BaseException:
            self._end()
            raise

    def _place(self, agent: int, name: str, scene: Scene, portraits: bool) -> ThorPlace:
        self.agents[agent].load(scene)
        return ThorPlace(name, scene, self.agents[agent], portraits=portraits)

    def _return(self, env: int) -> None:
        self.agents[env].load(self.places[self.place_index[env]].scene)
        self.poses[env] = self.agents[env].pose

    # Robots work side by side; Unity does the work, in processes of its own.

    def _each(self, env_ids: Iterable[int], task: Callable[[int], T]) -> list[T]:
        """A task for each of some robots, at once."""
        return list(self._pool.map(task, map(int, env_ids)))

    def _by_agent(self, items: Iterable[int], task: Callable[[int], T],
                  agent: Callable[[int], int]) -> list[T]:
        """A task for each item; those of one agent one after another."""
        items = list(items)
        queues: dict[int, list[int]] = {}
        for k, item in enumerate(items):
            queues.setdefault(agent(item), []).append(k)
        done: dict[int, T] = {}

        def work(queue: list[int]) -> None:
            for k in queue:
                done[k] = task(items[k])
        list(self._pool.map(work, queues.values()))
        return [done[k] for k in range(len(items))]

    def enter(self, env_ids: np.ndarray, places: np.ndarray) -> None:
        """See `Simulator`."""
        super().enter(env_ids, places)
        moved = [n for n in env_ids if self.agents[n].scene != self.places[
            self.place_index[n]].scene]
        self._each(moved, self._return)

    def place(self, env_ids: np.ndarray, poses: np.ndarray) -> None:
        """See `Simulator`."""
        wanted = dict(zip(map(int, env_ids), np.asarray(poses, float), strict=True))
        self._each(wanted, lambda n: self.agents[n].put(wanted[n]))
        self.poses[env_ids] = poses

    def move(self, delta: np.ndarray, env_ids: np.ndarray | None = None) -> Motion:
        """See `Simulator`. A robot whose engine was lost stands where it stood."""
        env_ids = self._all if env_ids is None else np.asarray(env_ids)
        rows = dict(zip(map(int, env_ids), delta, strict=True))
        moves = self._each(rows, lambda n: self.agents[n].move(rows[n]))
        self.poses[env_ids] = [self.agents[n].pose for n in env_ids]
        self._lost[env_ids] |= [move.lost for move in moves]
        return Motion(np.array([move.delta for move in moves]).reshape(-1, 4),
                      np.array([move.collided for move in moves], bool))

    def broken_off(self) -> np.ndarray:
        """See `Simulator`: the engine was lost in a move, and replaced."""
        lost, self._lost = self._lost, np.zeros(self.num_envs, bool)
        return lost

    def observe(self, env_ids: np.ndarray | None = None, keys: np.ndarray | None = None) -> Frames:
        """See `Simulator`."""
        env_ids = self._all if env_ids is None else env_ids
        return _stack(self._each(env_ids, lambda n: picture(self.agents[n].event)))

    def view(self, place_index: np.ndarray, poses: np.ndarray, out: Frames | None = None,
             appearance: Any = None, keys: np.ndarray | None = None,
             placed: Sequence[Sequence[Placed]] | None = None) -> Frames:
        """See `Simulator`; scenes look as they do at first, whatever an episode has moved.

        Robots take the pictures and go back. Those that are in a place take those of it, if their
        objects lie as at first; others have to load it.
        """
        place_index = np.asarray(place_index)
        before = [(agent.scene, agent.key, agent.pose.copy()) for agent in self.agents]
        at_hand: dict[int, list[int]] = {}
        for n, agent in enumerate(self.agents):
            if agent.key is None:
                at_hand.setdefault(int(self.place_index[n]), []).append(n)
        takes = [at_hand.get(int(p), [int(p) % self.num_envs]) for p in place_index]
        by = [group[k % len(group)] for k, group in enumerate(takes)]

        def take(k: int):
            agent = self.agents[by[k]]
            agent.load(self.places[place_index[k]].scene)
            agent.put(poses[k])
            return picture(agent.event)
        # Pictures of one place one after another: it is loaded once.
        order = np.argsort(place_index, kind='stable')
        found = self._by_agent(order, take, lambda k: by[k])

        def back(n: int):
            scene, key_then, pose = before[n]
            assert scene is not None
            agent = self.agents[n]
            if key_then is None:
                agent.load(scene)
            else:
                agent.scatter_in(scene, key_then)
            agent.put(pose)
        self._each(sorted(set(by)), back)
        return _stack([found[k] for k in np.argsort(order, kind='stable')])

    def apply_appearance(self, env_ids: np.ndarray, seed: int | np.ndarray, stream: Stream,
                         env: Any, episode: Any) -> None:
        """See `Simulator`: the episode's objects lie elsewhere (`objects=random`)."""
        if self.shuffle:
            keys = np.broadcast_to(key(seed, Stream.OBJECT_PLACE, env, episode),
                                   np.shape(env_ids))
            rows = dict(zip(map(int, env_ids), map(int, keys), strict=True))
            self._each(rows, lambda n: self.agents[n].scatter(rows[n]))

    def scatter(self, env_id: int, number: int) -> dict[str, tuple[float, float]]:
        """See `Simulator`."""
        agent = self.agents[env_id]
        agent.scatter(number)
        return {item['objectId']: point_to_ours(item['position'])[:2] for item in agent.objects}

    def cameras(self, poses: np.ndarray | None = None, appearance: Any = None
                ) -> tuple[np.ndarray, np.ndarray]:
        """See `Simulator`; the camera is as high as AI2-THOR's agent holds it."""
        cameras, fov = super().cameras(poses, appearance)
        cameras[:, 2] = self.agents[0].camera_height
        return cameras, fov

    def close(self) -> None:
        """See `Simulator`: ends all engines."""
        self._end()

    def _end(self) -> None:
        for agent in self.agents:
            agent.close()
        self._pool.shutdown()


def picture(event: Any) -> tuple[np.ndarray, ...]:
    """What one event shows, as rows of `Frames`."""
    ids = event.instance_masks.instance_segmentation_frame_uint32
    colours = np.array([row['color'] for row in event.metadata['colors']], np.uint8).reshape(-1, 3)
    # As Unity's picture has them: red first, alpha 255.
    codes = np.concatenate([colours, np.full((len(colours), 1), 255, np.uint8)], axis=1)
    codes = np.ascontiguousarray(codes).view(np.uint32)[:, 0]
    classes = np.array([class_of(row['name']) for row in event.metadata['colors']], np.uint8)
    order = np.argsort(codes, kind='stable')
    at = np.minimum(np.searchsorted(codes[order], ids), len(codes) - 1)
    known = codes[order][at] == ids
    return (np.ascontiguousarray(event.frame.transpose(2, 0, 1)),
            np.asarray(event.depth_frame, np.float32),
            np.where(known, classes[order][at], 0).astype(np.uint8),
            np.where(known, order[at] + 1, 0).astype(np.uint16))


def _stack(pictures: Sequence[tuple[np.ndarray, ...]]) -> Frames:
    return Frames(*(np.stack(part) for part in zip(*pictures, strict=True)))


def _options(scene: SceneName) -> dict[str, str]:
    """The options of a scene, with their defaults.

    Raises:
        UserError: one that there is not.
    """
    known = ('moves', 'objects', 'file') if scene.place == PROCTHOR else ('moves', 'objects')
    given = {'moves': MOVES[0], 'objects': OBJECTS[0]} | options_of(scene, known)
    for name, values in (('moves', MOVES), ('objects', OBJECTS)):
        if given[name] not in values:
            raise UserError(f'{name} of a scene of AI2-THOR is one of: {", ".join(values)}',
                            str(scene), 'choose one, or leave it out')
    return given


def _scene(scene: SceneName, options: dict[str, str]) -> Scene:
    """What AI2-THOR loads for a scene.

    Raises:
        UserError: there is none.
    """
    if scene.place == PROCTHOR:
        if 'file' not in options:
            raise UserError('a ProcTHOR house is a file', str(scene),
                            'name it as in thor:procthor?file=house.json')
        path = Path(options['file'])
        house = read_json(path, 'a ProcTHOR house', 'see docs/simulators/thor.md')
        try:
            start = house['metadata']['agent']
            assert all(math.isfinite(start['position'][axis]) for axis in 'xyz')
            assert {'rotation', 'horizon'} <= start.keys() and house['rooms']
        except (AssertionError, KeyError, TypeError) as error:
            raise UserError('a ProcTHOR house has rooms and metadata.agent with position, '
                            'rotation and horizon', str(path),
                            'use a house of the data set procthor-10k') from error
        return Scene(PROCTHOR, house)
    if scene.place not in scene_names():
        raise UserError('a scene of AI2-THOR is FloorPlan1 to 30, 201 to 230, 301 to 330, 401 to '
                        '430, FloorPlan_Train1_1 to 12_5, FloorPlan_Val1_1 to 3_5, or procthor',
                        str(scene), 'correct it')
    return Scene(scene.place)


SIMULATOR = ThorSimulator

"""One robot in AI2-THOR: an engine, and what has to be done again when it is lost."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import numpy as np

from vn_nav.arrival import wrap_angle
from vn_nav.errors import UserError
from vn_sim_bridge.floor.floor_map import CELL
from vn_sim_bridge.thor.client import Engine, EngineLost
from vn_sim_bridge.thor.frame import HORIZON, point_to_ours, pose_to_ours, pose_to_thor

HALVINGS = 6  # a blocked move of the default agent is found to 1/64 of its length
TRIES = 3  # engines in a row that may be lost at one task
CENTRE = 0.9  # m, of the agent's origin above the floor: the middle of its body
MISPLACED = 0.02  # m or rad that a robot may stand beside where it was put

T = TypeVar('T')


class Scene(NamedTuple):
    """What an engine loads."""

    name: str  # of AI2-THOR
    house: dict | None = None  # ProcTHOR's, in place of a scene of the build

    @property
    def what(self) -> str | dict:
        """As the client takes it."""
        return self.name if self.house is None else self.house


class Move(NamedTuple):
    """What came of a move of one robot."""

    delta: np.ndarray  # [4], as in `Motion`
    collided: bool
    lost: bool = False  # the engine was, and the robot stands where it stood before


class Agent:
    """A robot with a Unity process of its own.

    Everything that an engine was told can be told to another one: scene, objects, pose. A lost
    engine is replaced at once; only what a move has done is not known then.

    Args:
        size: side of the square pictures [pixels].
        fov: field of view [rad]; camera_pitch: at which the camera is mounted [rad].
        arm: drive with the arm agent, whose moves end at a contact by themselves; else bisect
            those of the default agent.
    """

    def __init__(self, size: int, fov: float, camera_pitch: float, *, arm: bool):
        self.size, self.camera_pitch, self.arm = size, camera_pitch, arm
        self._parameters = {
            'gridSize': CELL, 'snapToGrid': False, 'fieldOfView': math.degrees(fov),
            'renderDepthImage': True, 'renderInstanceSegmentation': True,
            'agentMode': 'arm' if arm else 'default'}
        self._engine: Engine | None = None
        self._closed = False
        self.scene: Scene | None = None
        self.floor_height = 0.0  # m, in Unity's frame
        self.pose = np.zeros(4)  # x, y [m], yaw, pitch [rad]
        self.restarts = 0
        self._key: int | None = None  # of the objects' places; None: where the scene has them
        self._objects: list[dict] = []  # as the scene has them
        self._home = self.pose

    @property
    def engine(self) -> Engine | None:
        """The one that runs."""
        return self._engine

    @property
    def key(self) -> int | None:
        """By which the objects lie where they do; None: as the scene has them."""
        return self._key

    def close(self) -> None:
        """End the engine; a second time it does nothing."""
        self._closed = True
        self._drop()

    def _drop(self) -> None:
        if self._engine is not None:
            self._engine.close()
            self._engine = None

    # What the simulator asks for. `event` is what is seen and known after it.

    def load(self, scene: Scene) -> None:
        """Be in a scene, where its objects are at first."""
        if scene != self.scene or self._key is not None or self._engine is None:
            self.scene, self._key = scene, None
            self._again(self._load)

    def scatter(self, key: int) -> None:
        """Put the scene's objects elsewhere, by a random number; the robot stays."""
        if key != self._key:
            self._key = key
            pose = self.pose
            self._again(self._scatter)
            self.put(pose)

    def scatter_in(self, scene: Scene, key: int) -> None:
        """Be in a scene with its objects put elsewhere."""
        if scene != self.scene:
            self.load(scene)
        self.scatter(key)

    def put(self, pose: np.ndarray) -> None:
        """Stand at a pose [4]."""
        self.pose = np.array(pose, float)
        self._again(self._put)

    def move(self, delta: np.ndarray) -> Move:
        """Displace the robot by [4] in its own frame, up to the first contact."""
        before = self.pose
        try:
            done, free = self._move(delta)
        except EngineLost:
            self.pose = before
            self._restart()
            return Move(np.zeros(4), False, lost=True)
        return Move(done, not free)

    def reachable(self) -> np.ndarray:
        """[K,2] m where the robot can stand, in squares of the floor map."""
        found = self._again(lambda: self._act('GetReachablePositions')).metadata['actionReturn']
        if not found:
            assert self.scene is not None
            raise UserError('a robot can stand somewhere in a scene', self.scene.name,
                            'choose another scene')
        return np.array([point_to_ours(position)[:2] for position in found])

    @property
    def event(self) -> Any:
        """What the client saw last."""
        return self._event

    @property
    def objects(self) -> list[dict]:
        """Metadata of the scene's objects, now."""
        return self._event.metadata['objects']

    @property
    def camera_height(self) -> float:
        """[m] above the floor."""
        metadata = self._event.metadata
        eye = metadata.get('cameraPosition')
        return eye['y'] - self.floor_height if eye else 1.5

    # What an engine is told.

    def _again(self, task: Callable[[], T]) -> T:
        """Do something that may be done twice; with another engine if this one is lost."""
        for _ in range(TRIES):
            try:
                return task()
            except EngineLost as error:
                lost = error
                self._restart()
        raise UserError('an engine of AI2-THOR lives through what it is asked for',
                        f'{lost}, {TRIES} times in a row', 'see ~/.ai2thor/log/unity.log')

    def _restart(self) -> None:
        """Another engine that is told the same."""
        for _ in range(TRIES):
            self._drop()
            self.restarts += 1
            pose = self.pose
            try:
                self._load()
                self.pose = pose
                if self._key is not None:
                    self._scatter()
                    self.pose = pose
                self._put()
                return
            except EngineLost as error:
                lost = error
        raise UserError('another engine of AI2-THOR takes the place of a lost one', str(lost),
                        'see ~/.ai2thor/log/unity.log')

    def _load(self) -> None:
        assert self.scene is not None and not self._closed
        if self._engine is None:
            self._engine = Engine(self.scene.what, self.size, **self._parameters)
            self._event = self._engine.event
        else:
            self._event = self._engine.reset(self.scene.what)
        if self.scene.house is not None:  # a robot begins outside of such a house
            start = self.scene.house['metadata']['agent']
            self._act('TeleportFull', **start['position'], rotation=start['rotation'],
                      horizon=start['horizon'], standing=True, forceAction=True)
        agent = self._event.metadata['agent']
        self._height = agent['position']['y']
        self.floor_height = self._height - CENTRE
        self.pose = self._home = pose_to_ours(agent, self.camera_pitch)
        self._objects = [{'objectName': item['name'], 'position': item['position'],
                          'rotation': item['rotation']}
                         for item in self._event.metadata['objects']
                         if item.get('pickupable') or item.get('moveable')]

    def _scatter(self) -> None:
        # From where the scene has them, and with the robot at one place: then the key alone says
        # where they come to lie.
        assert self._key is not None
        self.pose = self._home
        self._put()
        self._act('SetObjectPoses', objectPoses=self._objects, placeStationary=True)
        self._act('InitialRandomSpawn', randomSeed=self._key % (2**31 - 1), forceVisible=True,
                  numPlacementAttempts=5, placeStationary=True)

    def _put(self) -> None:
        wanted = self.pose
        event = self._act('TeleportFull', **pose_to_thor(wanted, self._height, self.camera_pitch),
                          standing=True, forceAction=True)
        now = pose_to_ours(event.metadata['agent'], self.camera_pitch)
        beside = max(np.hypot(*(now - wanted)[:2]), abs(wrap_angle(now[2] - wanted[2])))
        if not event.metadata['lastActionSuccess'] or beside > MISPLACED:
            raise UserError('a robot in AI2-THOR stands where it is put',
                            event.metadata['errorMessage'] or f'{beside:.2f} beside it',
                            'choose starts and goals among its reachable positions')
        self.pose = wanted

    def _move(self, delta: np.ndarray) -> tuple[np.ndarray, bool]:
        dx, dy, dyaw, dpitch = map(float, delta)
        before, free = self.pose, True
        way = bool(dx or dy)
        if dpitch:
            self._tilt(dpitch)
        if dyaw:  # a way that bends leads along its mean heading
            free &= self._turn(dyaw / 2 if way else dyaw)
        if dx:
            free &= self._drive('MoveAhead' if dx > 0 else 'MoveBack', abs(dx))
        if dy:
            free &= self._drive('MoveLeft' if dy > 0 else 'MoveRight', abs(dy))
        if dyaw and way:
            free &= self._turn(dyaw / 2)
        if not (way or dyaw or dpitch):
            return np.zeros(4), True
        now = pose_to_ours(self._event.metadata['agent'], self.camera_pitch)
        done = now - before
        done[2] = wrap_angle(done[2])
        heading = before[2] + done[2] / 2
        c, s = math.cos(heading), math.sin(heading)
        done[:2] = c * done[0] + s * done[1], c * done[1] - s * done[0]
        self.pose = now
        return done, free

    def _tilt(self, dpitch: float) -> None:
        """Look up or down, as far as the agent can."""
        horizon = math.degrees(self.pose[3] + self.camera_pitch)
        degrees = min(max(horizon + math.degrees(dpitch), HORIZON[0]), HORIZON[1]) - horizon
        if abs(degrees) > 1e-6:
            self._act('LookDown' if degrees > 0 else 'LookUp', degrees=abs(degrees))

    def _turn(self, dyaw: float) -> bool:
        return self._done('RotateLeft' if dyaw > 0 else 'RotateRight',
                          degrees=abs(math.degrees(dyaw)))

    def _drive(self, action: str, length: float) -> bool:
        """Move up to the first contact; whether there was none."""
        if self._done(action, moveMagnitude=length):
            return True
        if not self.arm:  # a blocked move has left it in place
            for _ in range(HALVINGS):
                length /= 2
                self._done(action, moveMagnitude=length)
        return False

    def _done(self, action: str, **arguments: Any) -> bool:
        if self.arm:
            arguments['returnToStart'] = False
        return bool(self._act(action, **arguments).metadata['lastActionSuccess'])

    def _act(self, action: str, **arguments: Any) -> Any:
        if self._engine is None:
            raise EngineLost('there is none')
        self._event = self._engine.act(action, **arguments)
        return self._event

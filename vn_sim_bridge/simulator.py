"""What every simulator behind vn_nav offers: places, motion and pixels, batched; no task.

A new simulator is a class on `BaseSimulator` in one file: its scenes, its motion, its pictures.
Everything else has an answer there that says "nothing". `simulators/__init__.py` finds it by name,
`test/simulators/conformance.py` says whether it keeps this contract, and
`examples/corridor.py` is a small one to copy.

Poses are [K,4] float64: x, y [m], yaw (left), pitch (down) [rad] in the map frame of the place.
"""

from __future__ import annotations

import abc
import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, Protocol, runtime_checkable

import numpy as np

from vn_nav.errors import UserError
from vn_nav.robot import RobotSpec
from vn_nav.scenes import SceneName

if TYPE_CHECKING:
    from vn_sim_bridge.counter_random import Stream
    from vn_sim_bridge.render.randomisation import Randomisation


class Goal(NamedTuple):
    """Where a goal picture is taken."""

    pose: tuple[float, float, float, float]  # x, y [m], yaw, pitch [rad] in the map frame
    room: str  # its name, for people


class Placed(NamedTuple):
    """A movable object on the floor: index of its model, position [m] and yaw [rad]."""

    model: int
    x: float
    y: float
    yaw: float


class Distance(Protocol):
    """How far it is to one goal, for a robot that has to drive there."""

    @property
    def maximum(self) -> float:
        """The largest distance of the place [m, or steps with `capabilities.steps`]."""

    def at(self, poses: np.ndarray) -> np.ndarray:
        """Of poses [K,>=2] to the goal, [K] m or steps; inf where there is no way."""


class StraightDistance:
    """The straight line to a goal: nothing stands in the way, or nobody knows the ways."""

    maximum = math.inf

    def __init__(self, goal: Goal):
        self._at = np.array(goal.pose[:2])

    def at(self, poses: np.ndarray) -> np.ndarray:
        """Of poses [K,>=2] to the goal, [K] m."""
        return np.hypot(*(poses[:, :2] - self._at).T)


class Place(Protocol):
    """Somewhere a robot can be: a house, a recorded drive, a level of a game.

    With `capabilities.walls` a place is also a `WalledPlace`, with `capabilities.rooms` a
    `RoomPlace` (see `floor.places`). A `House` is all of it.
    """

    @property
    def name(self) -> str:
        """Of its scene: 'house:7', 'bag:my_drive'."""

    @property
    def goals(self) -> Sequence[Goal]:
        """Where goal pictures are taken."""

    def starts(self) -> tuple[np.ndarray, np.ndarray | None]:
        """Where episodes may begin: positions [K,2] m, headings [K] rad; None: any heading."""

    def distance_to(self, goal: Goal) -> Distance | None:
        """How far it is to a goal; None: nobody knows the ways (`capabilities.geodesic`)."""

    def plan(self) -> dict | None:
        """What a map needs, see `House.plan`; None: there is no map."""


@dataclasses.dataclass(frozen=True)
class Capabilities:
    """What a simulator can do. A task that needs more refuses before its first step."""

    continuous: bool  # any displacement; False: whole actions, on a grid: no noise, no slip
    depth: bool  # `Frames.depth` is what the camera sees; False: zeros
    labels: bool  # `Frames.labels` are classes of `label_names`; False: zeros
    geodesic: bool  # places know driving distances
    tilt: bool  # the camera can look up and down
    teleport: bool = True  # `place` puts a robot anywhere; False: `spawn` begins an episode
    rooms: bool = False  # places know their rooms
    walls: bool = False  # places know floor and obstacles: scans, exploration
    placeable_objects: bool = False  # `set_objects` works, and `view` shows objects
    appearance: bool = False  # `Setup.randomisation`: light and camera vary
    other_goals: bool = False  # `Setup.goals_per_room` and `Setup.goal_seed`
    own_objects: bool = False  # places have movable objects of their own: `scatter`
    rewards: bool = False  # it pays and ends episodes itself: `Motion.reward`, `Motion.ended`
    steps: bool = False  # distances count decisions, of which a move and a turn are one each
    own_actions: bool = False  # it has actions of its own, which are no motions: `act`


class Motion(NamedTuple):
    """What really happened in a move of K robots."""

    # [K,4] float64: dx, dy [m], dyaw, dpitch [rad]; dx is along the mean of first and last heading
    delta: np.ndarray
    collided: np.ndarray  # [K] bool: it ended at a contact
    reward: np.ndarray | None = None  # [K] float32, of a simulator that pays itself
    ended: np.ndarray | None = None  # [K] bool: and has ended the episode


class Frames(NamedTuple):
    """What K square cameras see."""

    rgb: np.ndarray  # [K,3,S,S] uint8
    depth: np.ndarray  # [K,S,S] float32 m along the optical axis; 0: unknown
    # [K,S,S] class ids, names in `Simulator.label_names`; uint8, or uint16 of more than
    # 256 classes: `vn_nav.labels.label_dtype`.
    labels: np.ndarray
    instances: np.ndarray  # [K,S,S] uint16


class Objects(NamedTuple):
    """Up to M movable objects in each of N robots' places."""

    scene: np.ndarray  # [N,M] int64: index of the object's scene; -1: absent
    pose: np.ndarray  # [N,M,4] float64: x, y, z [m], yaw [rad] in the map frame
    room: np.ndarray  # [N,M] int64: whose lamp shines on it


def no_objects(count: int, most: int = 0) -> Objects:
    """Nothing that moves: room for `most` objects a robot, all absent."""
    return Objects(np.full((count, most), -1, np.int64), np.zeros((count, most, 4)),
                   np.zeros((count, most), np.int64))


class Planner(Protocol):
    """Shortest ways for robots that may not face everywhere."""

    def actions(self, poses: np.ndarray, goal_poses: np.ndarray) -> np.ndarray:
        """Index of the action [N] to take at poses [N,4] towards goals [N,4]."""

    def regrets(self, poses: np.ndarray, goal_poses: np.ndarray) -> np.ndarray:
        """[N,A] what each action costs more than the best one."""


@dataclasses.dataclass(frozen=True)
class Setup:
    """What a simulator is opened with, beside the names of its scenes."""

    num_envs: int  # robots, N; robot i stands in place i modulo their number
    robot: RobotSpec
    size: int = 84  # side of the square pictures [pixels]
    threads: int = 1  # that draw
    randomisation: Randomisation | None = None  # of light and camera; None: nothing varies
    goal_randomisation: Randomisation | None = None  # of goal pictures; None: the same
    models: tuple[str, ...] = ()  # names of the objects that `set_objects` places
    objects: int = 0  # most of them at a time
    goals_per_room: int = 1
    goal_seed: int = 0  # 0: the places' own goals, else other ones, by the same rule


@runtime_checkable
class Simulator(Protocol):
    """N robots. What is meant where a method says nothing else: rows [K] are robots `env_ids`."""

    num_envs: int
    version: str  # of pixels, places and motion; figures of another version mean nothing here
    capabilities: Capabilities
    objects: Objects
    planner: Planner | None  # None: a robot can turn anywhere, so distances will do
    room_objects: Mapping[str, Sequence[str]] | None  # see `BaseSimulator`
    exact_turns: bool  # motion noise is along translations alone

    @property
    def label_names(self) -> Sequence[str]:
        """Behind the class ids; none where there are no labels."""

    @property
    def places(self) -> Sequence[Place]:
        """Of its scenes."""

    @property
    def poses(self) -> np.ndarray:
        """[N,4] x, y [m], yaw, pitch [rad]; read alone."""

    @property
    def place_index(self) -> np.ndarray:
        """[N] the place of each robot."""

    @property
    def seen_from(self) -> np.ndarray:
        """[N,4] poses that the last pictures were taken from."""

    def enter(self, env_ids: np.ndarray, places: np.ndarray) -> None:
        """Put robots [K] into places [K]; their poses are still to be set."""

    def place(self, env_ids: np.ndarray, poses: np.ndarray) -> None:
        """Put robots [K] at poses [K,4] (`capabilities.teleport`)."""

    def spawn(self, env_ids: np.ndarray, keys: np.ndarray) -> None:
        """Begin episodes where the simulator puts its robots, by random numbers [K] uint64."""

    def move(self, delta: np.ndarray, env_ids: np.ndarray | None = None) -> Motion:
        """Displace robots by [K,4] in their own frames, up to the first contact."""

    def act(self, actions: np.ndarray, env_ids: np.ndarray) -> Motion:
        """In place of `move`: actions [K] of its own, by number (`capabilities.own_actions`)."""

    @property
    def feature_size(self) -> int:
        """F, how many frozen features `features` knows of a picture; 0: none."""

    def features(self, place_index: np.ndarray, poses: np.ndarray) -> np.ndarray:
        """Frozen features [K,F] float32 of the pictures that `view` has, computed long ago."""

    def observe(self, env_ids: np.ndarray | None = None, keys: np.ndarray | None = None) -> Frames:
        """Pictures of the robots' cameras.

        Of all robots (`env_ids` None) they lie in one buffer, and are valid until the next call.
        `keys` [K] uint64 are random numbers, of a sensor's noise for instance; None: always the
        same.
        """

    def view(self, place_index: np.ndarray, poses: np.ndarray, out: Frames | None = None,
             appearance: Any = None, keys: np.ndarray | None = None,
             placed: Sequence[Sequence[Placed]] | None = None) -> Frames:
        """Pictures from any poses [K,4] in places [K], goals for instance; no robot moves.

        `out` are buffers to fill, `appearance` light and camera of each picture, `placed` the
        objects in each.
        """

    def reach(self, env_id: int, headings: np.ndarray, length: float) -> np.ndarray:
        """Where a translation of `length` [m] along each heading [rad] would end, [K,2] m."""

    def appearance(self, seed: int, stream: Stream, env: Any, episode: Any) -> Any:
        """Light and camera of some episodes, or of some goal pictures."""

    def apply_appearance(self, env_ids: np.ndarray, seed: int | np.ndarray, stream: Stream,
                         env: Any, episode: Any) -> None:
        """Draw light and camera of robots [K] anew, by the counters [K] of their episodes."""

    def set_objects(self, env_id: int, placed: Sequence[Placed]) -> None:
        """Put these objects, and no others, about one robot (`capabilities.placeable_objects`)."""

    def scatter(self, env_id: int, number: int) -> Mapping[str, tuple[float, float]]:
        """Put one robot's place's own objects elsewhere (`capabilities.own_objects`).

        The random number alone says where; the robot stays. Positions [m] by the objects' names.
        """

    def object_models(self) -> np.ndarray:
        """[N,M] int64: which model each object is; -1: absent."""

    def cameras(self, poses: np.ndarray | None = None, appearance: Any = None
                ) -> tuple[np.ndarray, np.ndarray]:
        """Cameras [K,5] and fov [K] of poses, or of the last pictures: `co_visibility.lift`."""

    def co_visibility(self, goal_poses: np.ndarray) -> np.ndarray:
        """What poses alone say of what robots and goals both show, [N]; -1: nothing.

        Asked only where there is no depth.
        """

    def broken_off(self) -> np.ndarray:
        """[N] bool: whose episode broke off since the last call: a crash, a limit of its own.

        Such a robot can go on, but not in that episode: it is truncated.
        """

    def close(self) -> None:
        """Let go of processes, files and memory; a second time it does nothing."""


class BaseSimulator(abc.ABC):
    """A `Simulator` without light, objects and planner: a new one says only what it has.

    To write: `version`, `capabilities`, `open`, `move` and `draw`; and `place_names` where the
    names of its places can be listed. `reach` and `observe` may be written faster than here.

    Args:
        places: of its scenes.
        setup: robots, camera, pictures.
    """

    version: str = '1'
    feature_size: int = 0
    capabilities: Capabilities
    label_names: Sequence[str] = ()
    # Names of movable objects, by task: `object` goes to one of them, in `collect` the first is
    # worth 1 and the second -1. Of simulators with `placeable_objects`; `Setup.models` has them.
    task_objects: ClassVar[Mapping[str, tuple[str, ...]]] = {}
    # Classes that tell a room's type, by type; None: those of `tasks.ROOM_OBJECTS`.
    room_objects: Mapping[str, Sequence[str]] | None = None
    splits: ClassVar[Mapping[str, Sequence[str]]] = {}  # names of scenes by the split's name
    planner: Planner | None = None
    exact_turns: bool = False  # else 2 deg of motion noise on rotations, `floor.contacts`
    places: Sequence[Place]

    @classmethod
    @abc.abstractmethod
    def open(cls, scenes: Sequence[SceneName], setup: Setup) -> Simulator:
        """The simulator of some scenes, all of them its own.

        Raises:
            UserError: a scene that there is not.
        """

    def __init__(self, places: Sequence[Place], setup: Setup):
        self.places, self.setup, self.robot = list(places), setup, setup.robot
        self.num_envs = setup.num_envs
        self.place_index = np.arange(setup.num_envs) % len(self.places)
        self.poses = np.zeros((setup.num_envs, 4))
        self.objects = no_objects(setup.num_envs)
        self._all = np.arange(setup.num_envs)

    def draw(self, place_index: np.ndarray, poses: np.ndarray) -> Frames:
        """Pictures from poses [K,4] in places [K]."""
        raise UserError('a simulator draws pictures from any pose', type(self).__name__,
                        'write its `draw`, or `observe` and `view`')

    @classmethod
    def own_robot(cls, scenes: Sequence[SceneName], robot: RobotSpec) -> RobotSpec:
        """The robot that drives in some scenes unless another one is named; `robot`: standard."""
        return robot

    def act(self, actions: np.ndarray, env_ids: np.ndarray) -> Motion:
        """See `Simulator`."""
        raise UserError('a simulator with actions of its own does them', type(self).__name__,
                        'write its `act`')

    def features(self, place_index: np.ndarray, poses: np.ndarray) -> np.ndarray:
        """See `Simulator`: nobody knows any."""
        return np.zeros((len(poses), 0), np.float32)

    @property
    def seen_from(self) -> np.ndarray:
        """[N,4]: pictures are drawn from where the robots are."""
        return self.poses

    def enter(self, env_ids: np.ndarray, places: np.ndarray) -> None:
        """See `Simulator`."""
        self.place_index[env_ids] = places

    def place(self, env_ids: np.ndarray, poses: np.ndarray) -> None:
        """See `Simulator`."""
        self.poses[env_ids] = poses

    def spawn(self, env_ids: np.ndarray, keys: np.ndarray) -> None:
        """See `Simulator`."""
        raise UserError('a simulator that cannot put robots anywhere spawns them',
                        type(self).__name__, 'write its `spawn`')

    @abc.abstractmethod
    def move(self, delta: np.ndarray, env_ids: np.ndarray | None = None) -> Motion:
        """See `Simulator`."""

    def observe(self, env_ids: np.ndarray | None = None, keys: np.ndarray | None = None) -> Frames:
        """See `Simulator`."""
        env_ids = self._all if env_ids is None else env_ids
        return self.draw(self.place_index[env_ids], self.poses[env_ids])

    def view(self, place_index: np.ndarray, poses: np.ndarray, out: Frames | None = None,
             appearance: Any = None, keys: np.ndarray | None = None,
             placed: Sequence[Sequence[Placed]] | None = None) -> Frames:
        """See `Simulator`."""
        return self.draw(np.asarray(place_index), poses)

    def reach(self, env_id: int, headings: np.ndarray, length: float) -> np.ndarray:
        """See `Simulator`; the robot tries each and is put back."""
        row, before = np.array([env_id]), self.poses[[env_id]].copy()
        ends = np.empty((len(headings), 2))
        for k, heading in enumerate(headings):
            start = before.copy()
            start[0, 2] = heading
            self.place(row, start)
            self.move(np.array([[length, 0.0, 0.0, 0.0]]), row)
            ends[k] = self.poses[env_id, :2]
        self.place(row, before)
        return ends

    def appearance(self, seed: int, stream: Stream, env: Any, episode: Any) -> Any:
        """See `Simulator`: nothing varies."""

    def apply_appearance(self, env_ids: np.ndarray, seed: int | np.ndarray, stream: Stream,
                         env: Any, episode: Any) -> None:
        """See `Simulator`: nothing varies."""

    def set_objects(self, env_id: int, placed: Sequence[Placed]) -> None:
        """See `Simulator`: there are none."""

    def scatter(self, env_id: int, number: int) -> Mapping[str, tuple[float, float]]:
        """See `Simulator`: there are none."""
        return {}

    def object_models(self) -> np.ndarray:
        """[N,0]: none."""
        return self.objects.scene

    def cameras(self, poses: np.ndarray | None = None, appearance: Any = None
                ) -> tuple[np.ndarray, np.ndarray]:
        """See `Simulator`: that of the robot, nothing varies."""
        return cameras_at(self.poses if poses is None else poses, self.robot)

    def co_visibility(self, goal_poses: np.ndarray) -> np.ndarray:
        """See `Simulator`: poses say nothing."""
        return np.full(self.num_envs, -1.0, np.float32)

    def broken_off(self) -> np.ndarray:
        """See `Simulator`: nothing breaks off."""
        return np.zeros(self.num_envs, bool)

    def close(self) -> None:
        """See `Simulator`: there is nothing to let go of."""


def cameras_at(poses: np.ndarray, robot: RobotSpec) -> tuple[np.ndarray, np.ndarray]:
    """The cameras [K,5] and fov [K] of robots at poses [K,>=3], see `overlap.lift`."""
    count = len(poses)
    pitch = poses[:, 3] if poses.shape[1] > 3 else 0.0
    return (np.column_stack([poses[:, :2], np.full(count, robot.camera_height), poses[:, 2],
                             robot.camera_pitch + pitch + np.zeros(count)]),
            np.full(count, robot.camera_fov))

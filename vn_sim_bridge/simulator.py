"""What every simulator behind vn_nav offers: motion and pixels, batched; no task."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

import numpy as np

if TYPE_CHECKING:
    from vn_sim_bridge.houses.house import DistanceField, FloorMap, Goal


@dataclasses.dataclass(frozen=True)
class Capabilities:
    """What a backend can do; whoever needs more says so before the first step."""

    continuous: bool  # any displacement; False: only the actions of a grid
    depth: bool
    labels: bool
    geodesic: bool  # knows driving distances
    tilt: bool  # the camera can look up and down
    scene: bool = False  # knows rooms, walls and movable objects, not only a floor


class Motion(NamedTuple):
    """What really happened in a move."""

    delta: np.ndarray  # [K,4] float64: dx, dy [m], dyaw, dpitch [rad] in the body frame at start
    collided: np.ndarray  # [K] bool


class Frames(NamedTuple):
    """What the cameras see."""

    rgb: np.ndarray  # [K,3,H,W] uint8
    depth: np.ndarray  # [K,H,W] float32 m along the optical axis
    labels: np.ndarray  # [K,H,W] uint8 class ids
    instances: np.ndarray  # [K,H,W] uint16


class Backend(Protocol):
    """A batch of N robots in one simulator."""

    num_envs: int
    capabilities: Capabilities
    world_version: str
    poses: np.ndarray  # [N,4] float64: x, y [m], yaw, pitch [rad] in the map frame

    def place(self, env_ids: np.ndarray, poses: np.ndarray) -> None:
        """Put robots [K] at poses [K,4]."""

    def move(self, delta: np.ndarray, env_ids: np.ndarray | None = None) -> Motion:
        """Displace robots by [K,4] in their own frames, up to the first contact."""

    def observe(self, env_ids: np.ndarray | None = None) -> Frames:
        """Pictures of the robots' cameras; valid until the next call."""


class Place(Protocol):
    """What a task needs of a place with goal pictures; a `House` is one."""

    seed: int  # its number, for people and figures
    floor: FloorMap
    goals: Sequence[Goal]

    def geodesic(self, x: float, y: float) -> DistanceField:
        """Shortest driving distance from anywhere to (x, y)."""

    def starts(self) -> tuple[np.ndarray, np.ndarray | None]:
        """Where episodes may begin: positions [K,2] m, headings [K] rad; None: any heading."""

    def floor_plan(self) -> dict:
        """What a map needs of the place, see `House.floor_plan`."""


class Routes(Protocol):
    """Shortest ways for robots that may not face everywhere."""

    def actions(self, poses: np.ndarray, goal_poses: np.ndarray) -> np.ndarray:
        """Index of the action [N] to take at poses [N,4] towards goals [N,4]."""


class Simulator(Backend, Protocol):
    """A backend that `NavigationEnv` stands on. Light, objects and routes may be nothing."""

    houses: Sequence[Place]
    house_index: np.ndarray  # [N] the place of each robot
    seen_from: np.ndarray  # [N,4] poses that the last pictures were taken from
    objects: Any  # NamedTuple of arrays [N,...], as `render.pack.Objects`
    routes: Routes | None  # None: a robot can turn anywhere, so the floor's distances will do

    def enter(self, env_ids: np.ndarray, houses: np.ndarray) -> None:
        """Put robots [K] into places [K]; their poses are still to be set."""

    def reach(self, env_id: int, headings: np.ndarray, length: float) -> np.ndarray:
        """Where a translation of `length` [m] along each heading [rad] would end, [K,2] m."""

    def appearance(self, seed: int, stream, env, episode) -> Any:
        """Light and camera of some episodes, or of some goal pictures."""

    def dress(self, env_ids: np.ndarray, seed: int | np.ndarray, stream, env, episode) -> None:
        """Draw light and camera of robots [K] anew."""

    def set_objects(self, env_id: int, placed: Sequence) -> None:
        """Put these objects, and no others, about one robot."""

    def object_models(self) -> np.ndarray:
        """[N,M] int64: which model each object is; -1: absent."""

    def view(self, house_index: np.ndarray, poses: np.ndarray, out: Frames | None = None,
             appearance: Any = None, keys: np.ndarray | None = None,
             placed: Sequence[Sequence] | None = None) -> Frames:
        """Pictures from any poses [K,4]."""

    def cameras(self, poses: np.ndarray | None = None, appearance: Any = None
                ) -> tuple[np.ndarray, np.ndarray]:
        """Cameras [K,5] and fov [K] of poses, or of the last pictures: `co_visibility.lift`."""

    def overlap(self, goal_poses: np.ndarray) -> np.ndarray:
        """For backends without depth: what poses alone say of the overlap, [N]; -1: nothing."""

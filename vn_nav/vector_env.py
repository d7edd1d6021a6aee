"""What trainer and evaluator use of an environment; three keep it.

`NavigationEnv` (any simulator, on the CPU), `WarpNavigationEnv` (houses, on a device: its rows are
tensors) and `RosEnv` (robots behind topics). N environments step together, with Gymnasium's
NEXT_STEP autoreset: the step after an episode's end ignores its action and returns the first
observation of the next episode; `info['reset']` marks these rows, which are no frames.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol, runtime_checkable

from vn_nav.robot import RobotSpec


@runtime_checkable
class NavigationVectorEnv(Protocol):
    """What a training needs.

    Observations: `image` [N,3,S,S] uint8, `goal_index` [N] int64 into `goals`, `last_action` [N]
    int64 (-1 at an episode's start), `last_reward` [N] float32 (the sparse reward alone); where
    the robots have it, `odometry` [N,3] float64: x, y [m], yaw [rad] in a frame of the episode.
    `info` has at least `reset`, `success`, `collided` and `arrived`, each [N] bool, and the
    privileged outputs that were asked for.
    """

    num_envs: int  # N
    robot: RobotSpec
    goals: Any  # [G,3,S,S] uint8, array or tensor
    restorable: bool  # `get_state` and `set_state` are there and work

    @property
    def action_names(self) -> Sequence[str]:
        """Of the actions, in order."""

    @property
    def world_version(self) -> str:
        """Of the simulator."""

    @property
    def simulator_name(self) -> str:
        """As scenes name the simulator."""

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[dict, dict]:
        """Begin new episodes: observations and info."""

    def step(self, actions: Any) -> tuple[dict, Any, Any, Any, dict]:
        """One decision each: observations, rewards, terminated, truncated [N], info."""

    def set_difficulty(self, tau: float) -> None:
        """Start later episodes within tau of the largest distance from their goals."""

    def close(self) -> None:
        """Let go of everything; a second time it does nothing."""


# What some environments offer in addition, asked of them with isinstance.


@runtime_checkable
class RestorableEnv(Protocol):
    """Of an environment that is `restorable`."""

    def get_state(self) -> dict[str, Any]:
        """Everything that changes from step to step, as arrays."""

    def set_state(self, state: dict[str, Any]) -> None:
        """Stand where `get_state` was taken."""


@runtime_checkable
class RecallingEnv(Protocol):
    """Does not know its goals before it has seen them, as `RosEnv`."""

    @property
    def shown_goals(self) -> Any:
        """The goal pictures seen so far [G,3,S,S] uint8."""

    def recall_goals(self, pictures: Any) -> None:
        """Number goals as an earlier environment did; before `reset`."""


@runtime_checkable
class PlacedEnv(Protocol):
    """Knows which place each robot is in."""

    @property
    def place_index(self) -> Any:
        """[N], array or tensor."""


@runtime_checkable
class GoalLabelsEnv(Protocol):
    """Knows what its goal pictures show."""

    goal_segmentation: Any  # [G,S,S] uint8 or uint16, array or tensor


@runtime_checkable
class LabelledEnv(Protocol):
    """Knows the names of the classes that segmentations show."""

    @property
    def label_names(self) -> Sequence[str]:
        """Behind the ids; none: there are no labels, or nobody says."""


@runtime_checkable
class MeasuredVectorEnv(NavigationVectorEnv, Protocol):
    """What an evaluation needs in addition.

    `info` then also has `distance`, `heading_error`, `start_distance` (NaN: nobody knows the
    ways), `path_length`, `decisions`, `goal` and `pose`, by environment.
    """

    config: Any  # `task`, `stop` and `odometry`, as of `EnvConfig`
    task: Any  # with `ranges`: first view and number of goals, by place
    places: Sequence[Any]  # with `name` and `plan()`
    place_index: Any  # [N] the place of each robot
    goal_poses: Any  # [G,4] x, y [m], yaw, pitch [rad]
    goal_rooms: Sequence[str]  # names of the goals
    # Of `distance`, `start_distance` and `path_length`: 'm' or 'steps'; '': there are none.
    distance_unit: str
    declare_action: int | None  # the action that says "I have arrived"; None: there is none
    single_action_space: Any

    def set_shown_goal(self, mode: str) -> None:
        """Which picture later episodes show: 'right', 'wrong', 'absent' or 'blank'."""

    def oracle_actions(self) -> Any:
        """[N] the next actions on shortest paths."""


@runtime_checkable
class ExploringEnv(Protocol):
    """Has a robot that explores, knowing all that it has seen, to compare others with.

    `info` then also has `shown_other` [N] bool, where another picture than the goal's is shown,
    and `at_shown` [N] bool, where the robot stands at that picture's place.
    """

    explores: bool  # whether it does here

    def explorer_actions(self) -> Any:
        """[N] the next actions of it; to be asked at every observation."""

"""What a `NavigationEnv` simulates."""

from __future__ import annotations

import dataclasses
from collections.abc import Collection
from typing import Any

from vn_nav.errors import UserError
from vn_nav.robot import DRIVE_ACTIONS, NamedAction, RobotSpec
from vn_nav.scenes import HOUSE, one_simulator
from vn_sim_bridge.floor.places import have_floors
from vn_sim_bridge.navigation.episodes import MIN_START_DISTANCE
from vn_sim_bridge.render.randomisation import Randomisation
from vn_sim_bridge.simulator import BaseSimulator, Setup, Simulator
from vn_sim_bridge.simulators import simulator_class

TASKS = ('image', 'object', 'room', 'collect')
PRIVILEGED = ('depth', 'segmentation', 'goal_segmentation', 'oracle_action', 'goal_pose',
              'overlap', 'explorer_action', 'oracle_regret')
# What not every simulator can do, and what it lacks then.
OPTIONAL = {'progress_reward': 'the simulator knows no driving distances, or pays itself',
            'exploration_reward': 'the simulator has no floor map',
            'randomisation': 'light and camera do not vary in this simulator'}
STOPS = ('arrival', 'declared')
ODOMETRIES = ('none', 'true', 'drift', 'commanded')  # see `episode_odometry.EpisodeOdometry`
RANGES = ('picture', 'scan', 'depth')  # see `episode_ranges.EpisodeRanges`


@dataclasses.dataclass(frozen=True)
class EnvConfig:
    """What a `NavigationEnv` simulates.

    Environment i lives in scene i modulo their number. With more scenes than environments it draws
    one of the scenes i, i + N, i + 2 N, ... for every episode.
    """

    scenes: tuple[str, ...] = ('house:0',)  # names, see `vn_nav.scenes`; all of one simulator
    num_envs: int = 64
    size: int = 84  # pixels
    actions: tuple[str, ...] = DRIVE_ACTIONS
    max_decisions: int = 300
    noise: float = 1.0  # of motion, times its standard deviations; 0: none
    turn_noise: bool = True  # of turns as well; the thesis has none in its 5.6
    progress_reward: float = 0.0  # per metre of geodesic progress
    collision_reward: float = 0.0  # per decision that touched something; a penalty is negative
    step_reward: float = 0.0  # per decision that does not reach the goal; a penalty is negative
    goal_bonus: float = 0.0  # at the goal, beside the sparse reward
    min_start_distance: float = MIN_START_DISTANCE  # m, geodesic
    one_goal_per_env: bool = False  # environment i keeps pair i; else drawn each episode
    seed: int = 0
    goals_per_room: int = 1
    task: str = 'image'  # of TASKS
    objects: int = 1  # in a place at a time (object, collect)
    room_must_see: bool = False  # the room rule of House3D's code, see tasks.RoomGoal
    randomisation: Randomisation = Randomisation()
    goal_randomisation: Randomisation | None = None  # of goal pictures; None: the same
    privileged: tuple[str, ...] = ()  # of PRIVILEGED
    stop: str = 'arrival'  # of STOPS: an episode ends on arrival, or when the robot says so
    goal_variants: int | None = None  # pictures of each goal; default: the randomisation's
    goal_seed: int = 0  # 0: the scenes' own goals, else other ones in the same scenes
    exploration_reward: float = 0.0  # per square of floor that is new to the episode, see SQUARE
    odometry: str = 'none'  # of ODOMETRIES: what the robots observe of their own motion
    drift: float = 1.0  # of odometry that drifts, as of `odometry.drift_errors`
    ranges: str = 'picture'  # of RANGES: what a policy's map is given; 'picture': nothing

    def __post_init__(self):
        one_simulator(self.scenes)
        rules = (
            (self.num_envs >= 1, 'there is at least one environment', self.num_envs),
            (self.max_decisions >= 1, 'an episode has at least one decision', self.max_decisions),
            (8 <= self.size <= 2048, 'pictures have 8 to 2048 pixels a side', self.size),
            (self.task in TASKS, f'the task is one of {", ".join(TASKS)}', self.task),
            (1 <= self.objects <= 16, 'there are 1 to 16 objects', self.objects),
            (set(self.privileged) <= set(PRIVILEGED),
             f'privileged outputs are some of {", ".join(PRIVILEGED)}', self.privileged),
            (self.stop in STOPS, f'the stop is one of {", ".join(STOPS)}', self.stop),
            (self.stop == 'arrival' or self.task == 'image',
             'only the image task ends when the robot declares that it has arrived', self.task),
            (self.goal_variants is None or 1 <= self.goal_variants <= 256,
             'a goal has 1 to 256 pictures', self.goal_variants),
            (self.goal_seed >= 0, 'the seed of goals is not negative', self.goal_seed),
            (self.odometry in ODOMETRIES, f'the odometry is one of {", ".join(ODOMETRIES)}',
             self.odometry),
            (0 <= self.noise <= 100, 'motion noise is 0 to 100 times the usual', self.noise),
            (0 <= self.drift <= 100, 'drift is 0 to 100 times the usual', self.drift),
            (self.ranges in RANGES, f'the ranges are one of {", ".join(RANGES)}', self.ranges),
        )
        for kept, rule, received in rules:
            if not kept:
                raise UserError(rule, received, 'correct the environment configuration')

    @property
    def pictures_per_goal(self) -> int:
        """Differently lit pictures kept of each goal."""
        return self.goal_variants or self.of_goals.pictures_per_goal

    @property
    def of_goals(self) -> Randomisation:
        """The randomisation of goal pictures."""
        return self.goal_randomisation or self.randomisation


def with_own_actions(config: EnvConfig, robot: RobotSpec) -> EnvConfig:
    """The configuration with a robot's actions, where it has none of the usual ones.

    A simulator with actions of its own (`Capabilities.own_actions`) is asked for all of them,
    unless some are named.
    """
    own = all(isinstance(action, NamedAction) for action in robot.actions)
    if own and config.actions == DRIVE_ACTIONS:
        return dataclasses.replace(config, actions=robot.action_names)
    return config


def setup_for(config: EnvConfig, robot: RobotSpec, threads: int = 1) -> Setup:
    """What the simulator of an environment is opened with."""
    name, _ = one_simulator(config.scenes)
    models = simulator_class(name).task_objects.get(config.task, ())
    return Setup(
        num_envs=config.num_envs, robot=robot, size=config.size, threads=threads,
        randomisation=config.randomisation, goal_randomisation=config.goal_randomisation,
        models=models,
        objects=config.objects if models else 0, goals_per_room=config.goals_per_room,
        goal_seed=config.goal_seed)


def objects_of(simulator: Simulator, task: str) -> tuple[str, ...]:
    """Names of the objects that a task places."""
    return getattr(simulator, 'task_objects', {}).get(task, ())


def tells(simulator: Simulator) -> set[str]:
    """What of `PRIVILEGED` a simulator knows."""
    can = simulator.capabilities
    # Poses alone may say what two pictures share; `BaseSimulator` does not know how.
    shared = can.depth or type(simulator).co_visibility is not BaseSimulator.co_visibility
    known = {
        'depth': can.depth, 'segmentation': can.labels, 'goal_segmentation': can.labels,
        'oracle_action': can.geodesic or simulator.planner is not None,
        'oracle_regret': simulator.planner is not None, 'explorer_action': can.walls and shared,
        'goal_pose': shared, 'overlap': shared}
    if can.rewards:  # its task is its own: no goal of ours, and no way to one
        known = {name: known[name] for name in ('depth', 'segmentation')}
    return {name for name in PRIVILEGED if known.get(name)}


def _varies_pictures(config: EnvConfig) -> bool:
    return config.randomisation.varies_pictures or config.of_goals.varies_pictures


def without_the_unknown(config: EnvConfig, simulator: Simulator, optional: Collection[str]
                        ) -> tuple[EnvConfig, list[str]]:
    """A configuration that asks a simulator for nothing that it does not know.

    Args:
        config: what is wished for. Its `privileged` become those that the simulator `tells`.
        simulator: where.
        optional: of `OPTIONAL`, what may be left out.

    Returns:
        The configuration, and what of `optional` is left out, in words.
    """
    known = tells(simulator)
    can = simulator.capabilities
    without: dict[str, Any] = {
        'progress_reward': 0.0, 'exploration_reward': 0.0,
        'randomisation': config.randomisation.of_the_base()}
    asked = {'progress_reward': config.progress_reward and (can.rewards or not can.geodesic),
             'exploration_reward': (config.exploration_reward
                                    and not have_floors(simulator.places)),
             'randomisation': _varies_pictures(config) and not can.appearance}
    lost = [name for name in optional if asked[name]]
    words = [f'{name} is left out: {OPTIONAL[name]}' for name in lost]
    if 'randomisation' in lost:
        config = dataclasses.replace(config, goal_randomisation=None)
    return dataclasses.replace(
        config, privileged=tuple(name for name in config.privileged if name in known),
        **{name: without[name] for name in lost}), words


def check_simulator(simulator: Simulator, config: EnvConfig, robot: RobotSpec, *,
                    given: bool = False) -> None:
    """Whether a simulator can do what a configuration asks for.

    Args:
        given: the simulator was made elsewhere, with goals and light of its own.

    Raises:
        UserError: what it cannot do.
    """
    can, told = simulator.capabilities, set(config.privileged)
    varies = _varies_pictures(config)
    own_goals = (config.goals_per_room, config.goal_seed) == (1, 0)
    image = config.task == 'image'
    rules = (
        (simulator.num_envs == config.num_envs, 'a simulator has as many robots as the '
         f'configuration: {config.num_envs}', simulator.num_envs),
        (can.rooms or config.task != 'room', 'task room needs a simulator that knows rooms',
         config.task),
        (can.placeable_objects or (can.own_objects and config.task == 'object')
         or config.task not in ('object', 'collect'),
         'this task needs a simulator that places objects', config.task),
        (config.task not in ('object', 'collect') or objects_of(simulator, config.task),
         'a simulator that places objects names those of the task (task_objects)', config.task),
        (can.labels or not config.room_must_see, 'room_must_see needs labels', 'none'),
        (image or not can.rewards, 'a simulator that pays itself has the task image',
         config.task),
        (config.stop == 'arrival' or not can.rewards,
         'a simulator that pays itself ends its episodes', config.stop),
        (can.own_actions == all(isinstance(action, NamedAction) for action in robot.actions),
         'a simulator with actions of its own takes those, and no other takes such ones',
         robot.action_names),
        (config.odometry == 'none' or not can.own_actions,
         'odometry needs robots that move in metres; there it is none', config.odometry),
        (config.ranges == 'picture' or not can.own_actions,
         'ranges are measured by robots that move in metres', config.ranges),
        (config.ranges != 'scan' or can.walls, 'a scan needs a simulator that knows walls',
         'none'),
        (config.ranges != 'depth' or can.depth, 'ranges by depth need a simulator that has depth '
         'pictures', 'none'),
        (can.geodesic or not config.progress_reward,
         'progress_reward needs a simulator that knows ways', config.progress_reward),
        (not can.rewards or not config.progress_reward,
         'a simulator that pays itself takes no progress_reward', config.progress_reward),
        (can.geodesic or simulator.planner or 'oracle_action' not in told,
         'oracle_action needs a simulator that knows ways', 'oracle_action'),
        (can.walls or 'explorer_action' not in told, 'the explorer needs a simulator that knows '
         'walls', 'explorer_action'),
        (have_floors(simulator.places) or not config.exploration_reward,
         'exploration_reward needs places with a floor map', config.exploration_reward),
        (simulator.planner is not None or 'oracle_regret' not in told,
         'the simulator knows what each action costs on the ways there (as a recorded drive does)',
         'oracle_regret'),
        (can.depth or 'depth' not in told, 'the simulator has depth pictures', 'none'),
        (can.labels or not told & {'segmentation', 'goal_segmentation'},
         'the simulator has labels', 'none'),
        (can.tilt or not any(action.dpitch for action in robot.actions),
         'the camera of the simulator is fixed', robot.action_names),
        (can.other_goals or own_goals or given,
         'goals_per_room and goal_seed need a simulator that makes goals', (
             config.goals_per_room, config.goal_seed)),
        (can.appearance or not varies or given,
         'light and camera vary in simulators that draw them', 'a randomisation'),
    )
    for kept, rule, received in rules:
        if not kept:
            raise UserError(rule, received, 'correct the environment configuration, or choose '
                            'another simulator (vn_nav simulators)')


def not_on_device(config: EnvConfig) -> UserError | None:
    """What of a configuration `WarpNavigationEnv` cannot do, in words; None: it does all of it."""
    simulator, _ = one_simulator(config.scenes)
    teachers = sorted(set(config.privileged) & {'explorer_action', 'oracle_action'})
    rules = (
        (config.task == 'image' and not config.one_goal_per_env,
         'the device runs the image task with goals drawn each episode', config.task,
         'use --device cpu'),
        (config.stop == 'arrival' and not config.exploration_reward,
         'on the device episodes end on arrival, and new floor pays nothing',
         (config.stop, config.exploration_reward), 'use --device cpu'),
        (not config.noise or config.turn_noise,
         'on the device turns are as noisy as moves, or nothing is', 'turn_noise=False',
         'use --device cpu'),
        (config.odometry == 'none', 'robots on the device have no odometry', config.odometry,
         'use --device cpu, or odometry none'),
        (config.ranges == 'picture', 'robots on the device measure no ranges', config.ranges,
         'use --device cpu, or ranges picture'),
        (not teachers, 'teachers plan on the CPU (none with --set imitation=0 --set '
         'teacher_share=0)', ', '.join(teachers), 'use --device cpu'),
        (not config.randomisation.late_picture, 'pictures are never late on the device',
         config.randomisation.late_picture, 'use --device cpu'),
        (simulator == HOUSE, 'the device draws embedded houses', simulator, 'use --device cpu'))
    return next((UserError(*words) for holds, *words in rules if not holds), None)

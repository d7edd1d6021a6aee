"""The last stage of teach_and_drive.py: episodes to pictures out of the bag."""

from __future__ import annotations

import json
import shutil
import time
from pathlib import Path
from typing import Any

import numpy as np
from record_drive import (
    CAMERA_RATE_HZ,
    RecordedDrive,
    bridge_parameters,
    read_drive,
    write_figures,
)

from vn_nav.arrival import arrived, wrap_angle
from vn_nav.bags.roles import Topics
from vn_nav.cli.world import machine
from vn_nav.errors import UserError
from vn_nav.evaluation.bag_episodes import drives_from_bag
from vn_nav.evaluation.evaluator import ARRIVAL, DECLARED, STOP_THRESHOLD
from vn_nav.evaluation.metrics import Episode, summarise
from vn_nav.nodes.isolation import stay_on_this_host
from vn_nav.nodes.processes import Processes, ProcessFailure
from vn_nav.observation import preprocess
from vn_nav.policy.checkpoint import load_checkpoint
from vn_nav.policy.runtime import PolicyRuntime
from vn_nav.report.tables import print_rows
from vn_nav.robot import DRIVE_ACTIONS, load_robot
from vn_nav.routes.follower import RouteFollower
from vn_nav.routes.from_bag import pictures_along
from vn_nav.routes.recognition import RouteEyes, Sighting
from vn_nav.scenes import house_scene
from vn_sim_bridge.houses.procedural import generate_house
from vn_sim_bridge.houses.viewpoints import VIEW, interest
from vn_sim_bridge.render.randomisation import load_randomisation
from vn_sim_bridge.robot.goal_pictures import GoalPicture, load_goal_pictures, save_goal_pictures
from vn_sim_bridge.robot.simulated_robot import TICK, TRUNCATED, SimulatedRobot
from vn_sim_bridge.simulators.house import HouseSimulator

BEFORE, ROUTE, AFTER, WRONG, RANDOM = ROWS = (
    'before', 'along the route', 'after', 'wrong picture', 'random actions')
DRIVEN = ['odom', 'ground_truth/odom', 'cmd_vel', 'action', 'action_names', 'arrived', 'collision',
          'reward', 'episode_end', 'episode', 'episode_result', 'scene', '/diagnostics']
RIGHT, OTHER = 'right', 'other'  # folders of goal pictures
MET = ('odom', 'episode', 'action_names')  # of those: what both nodes say at the beginning
MAX_SILENCE_S = 180.0  # without a finished episode
DRIVE_SEED = 2026
CHOICE = 8  # pictures of the bag; the one that shows most becomes a goal


def drive(options) -> dict[str, list[Episode]]:
    """Episodes to pictures out of the bag, a row each."""
    out = options.out
    folders = {RIGHT: out / 'goals', OTHER: out / 'other_goals'}
    goals = choose_goals(options, read_drive(out / 'bag'))
    save_goal_pictures(folders[RIGHT], goals)
    # Each pose with the picture of another place.
    save_goal_pictures(folders[OTHER], wrong_pictures(goals))
    episodes = {}
    for row in options.rows:
        shown = folders[OTHER if row == WRONG else RIGHT]
        untaught = row in (BEFORE, ROUTE)
        checkpoint = options.checkpoint if untaught else out / 'taught' / 'checkpoint'
        if row == RANDOM:
            episodes[row] = without_ros(options, None, [])
        elif options.without_ros or row == ROUTE:
            policy = PolicyRuntime(checkpoint, seed=options.seed,
                                   stop_threshold=_threshold(options, checkpoint),
                                   keep_map=row == ROUTE)
            along = AlongRoute(policy, out / 'bag', goals) if row == ROUTE else None
            episodes[row] = without_ros(options, policy, load_goal_pictures(shown), along)
        else:
            episodes[row] = over_ros(options, row, checkpoint, shown)
        print_rows({options.stop: {row: summarise(episodes[row])}}, f'house {options.house}')
    figures = {row: summarise(own) for row, own in episodes.items()}
    parts = {name: json.loads(path.read_text()) for name in ('record', 'teach')
             if (path := out / f'{name}.json').is_file()}
    write_figures(out / 'result.json', {'stop': options.stop, 'rows': figures, **parts,
                                        'checkpoint': str(options.checkpoint),
                                        'machine': machine()})
    print_rows({options.stop: figures}, f'house {options.house}, pictures out of the bag')
    return episodes


def choose_goals(options, shown: RecordedDrive) -> list[GoalPicture]:
    """Pictures of the bag, each the most interesting of a few that were drawn at random."""
    rng = np.random.default_rng(DRIVE_SEED)
    house = generate_house(options.house, rooms=options.rooms)
    backend = HouseSimulator([house], [0], robot=load_robot(options.out / 'robot.yaml'), size=VIEW)
    drawn = rng.permutation(len(shown.pictures))[:CHOICE * options.goals]
    if len(drawn) < CHOICE * options.goals:
        raise UserError(f'a bag holds {CHOICE} pictures for every goal',
                        f'{len(shown.pictures)} for {options.goals} goals', 'lower --goals')
    poses = np.column_stack([shown.pictured[drawn], np.zeros(len(drawn))])
    frames = backend.view(np.zeros(len(drawn), np.int64), poses)
    best = interest(frames.depth, frames.instances).reshape(options.goals, CHOICE).argmax(1)
    chosen = drawn.reshape(options.goals, CHOICE)[np.arange(options.goals), best]
    return [GoalPicture(shown.pictures[k], tuple(shown.pictured[k])) for k in chosen]


def wrong_pictures(goals: list[GoalPicture]) -> list[GoalPicture]:
    """The same poses, each with the picture that was taken farthest from there."""
    places = np.array([goal.pose[:2] for goal in goals])
    gaps = np.hypot(*(places[:, None] - places).transpose(2, 0, 1))
    return [GoalPicture(goals[int(far)].picture, goal.pose)
            for goal, far in zip(goals, gaps.argmax(axis=1), strict=True)]


def over_ros(options, row: str, checkpoint: Path, goals: Path) -> list[Episode]:
    """Episodes of a policy: bridge, policy and recorder as processes, counted from the bag."""
    name, robot = row.replace(' ', '_'), str(options.out / 'robot.yaml')
    bag = options.out / f'drive_{name}'
    shutil.rmtree(bag, ignore_errors=True)
    stay_on_this_host()
    from vn_nav.nodes.demo_watch import DemoWatch  # imports ROS
    processes = Processes(options.out / 'logs')
    bridge, policy = f'bridge_{name}', f'policy_{name}'
    try:
        processes.start('recorder', 'vn_nav.nodes.recorder_node',
                        {'output': str(bag), 'topics': DRIVEN})
        with DemoWatch(processes, policy, bridge, MET) as watch:
            processes.start(bridge, 'vn_sim_bridge.bridge_node', {
                **bridge_parameters(options), 'goals': str(goals), 'seed': options.seed,
                'stop': options.stop, 'episodes': options.episodes, 'exit_when_done': True},
                (f'__node:={bridge}',))
            processes.start(policy, 'vn_nav.nodes.policy_node', {
                'checkpoint': str(checkpoint), 'robot': robot, 'time': 'lock_step',
                'seed': options.seed, 'stop_threshold': _threshold(options, checkpoint)},
                (f'__node:={policy}',))
            watch.enable()
            _wait(processes, bridge, watch, options.episodes)
    finally:
        processes.stop_all()
    (drive,) = drives_from_bag(bag)
    if len(drive.episodes) != options.episodes:
        raise SystemExit(f'{bag} holds {len(drive.episodes)} episodes of {options.episodes}')
    return [recorded.episode for recorded in drive.episodes]


def _threshold(options, checkpoint: Path) -> float:
    """Of `arrival`, from which on the policy stops by itself; 1: never."""
    own = load_checkpoint(checkpoint).info['stop_threshold']
    return 1.0 if options.stop == ARRIVAL else STOP_THRESHOLD if own is None else own


def _wait(processes: Processes, bridge: str, watch: Any, count: int) -> None:
    """Until the bridge has run its episodes."""
    done, progress = 0, time.monotonic()
    while processes.running[bridge].poll() is None:
        watch.spin(0.2)
        if (now := len(watch.episodes)) > done:
            done, progress = now, time.monotonic()
            if done % 10 == 0:
                print(f'{bridge}: {done} episodes of {count}', flush=True)
        if time.monotonic() - progress > MAX_SILENCE_S:
            raise ProcessFailure(f'no episode ended for {MAX_SILENCE_S:.0f} s')
    processes.check(bridge)


class AlongRoute:
    """What `route_node` does, without ROS.

    Args:
        policy: that drives; bag: out of which the route is taken.
        goals: each is named as the picture of the route that was taken nearest to it.
    """

    def __init__(self, policy: PolicyRuntime, bag: Path, goals: list[GoalPicture]):
        assert policy.search is not None  # it searches
        self._policy = policy
        along = list(pictures_along(bag, Topics()))
        self._pictures = [preprocess(own.picture, policy.size) for own in along]
        self._eyes = RouteEyes(policy.search.eyes, np.stack(self._pictures))
        taken = read_drive(bag).pictured[[round(own.time * CAMERA_RATE_HZ) for own in along]]
        self._targets = [int((np.hypot(*(taken[:, :2] - goal.pose[:2]).T)
                              + np.abs(wrap_angle(taken[:, 2] - goal.pose[2]))).argmin())
                         for goal in goals]

    def set_out(self, number: int, goal: np.ndarray) -> None:
        """Towards a goal, by its number, and its picture [3,S,S]."""
        self._target, self._goal = self._targets[number], goal
        self._follower = RouteFollower(len(self._pictures), self._target)
        self._begins, self._decisions = True, 0
        self._policy.reset()  # the robot is elsewhere
        self._policy.set_goal(goal)

    def act(self, picture: np.ndarray, odometry: np.ndarray) -> int:
        """The next action; the policy has `arrived` only where it is at the goal itself."""
        def look(rows: np.ndarray) -> Sighting:
            return self._eyes.look(picture, rows)

        found = self._follower.begin(look) if self._begins else None
        self._begins = False
        while True:
            if found is not None:
                self._show(found)
            action = self._policy.act(picture, odometry)
            self._decisions += 1
            estimate = self._policy.goal_estimate
            distance = None if estimate is None else float(np.hypot(*estimate[:2]))
            if self._policy.arrived:
                if self._follower.shown == self._target:
                    return action
                found = self._follower.arrived(look)
            else:
                found = self._follower.decided(self._decisions, distance, look)
            if found is None:
                return action

    def _show(self, number: int) -> None:
        self._decisions = 0
        self._policy.set_goal(self._goal if number == self._target else self._pictures[number])


def without_ros(options, policy: PolicyRuntime | None, pictures: list[GoalPicture],
                along: AlongRoute | None = None) -> list[Episode]:
    """The same starts and goals in the same robot, without ROS.

    Args:
        policy: None: random actions.
        pictures: shown, one for each goal.
        along: drives the policy along a route.
    """
    spec = load_robot(options.out / 'robot.yaml').with_actions(DRIVE_ACTIONS)
    goals = load_goal_pictures(options.out / 'goals')
    robot = SimulatedRobot(
        house_scene(options.house, options.rooms), robot=spec, size=options.size,
        seed=options.seed, stop=options.stop,
        randomisation=load_randomisation(options.randomisation),
        goal_poses=[goal.pose for goal in goals])
    rng, deltas = np.random.default_rng(options.seed), np.column_stack([
        np.array(spec.moves), np.zeros(len(spec.actions))])
    declares = options.stop == DECLARED

    def choose() -> int:
        if policy is None:
            return int(rng.integers(len(deltas) + declares))
        picture = np.ascontiguousarray(robot.observe().rgb[0].transpose(1, 2, 0))
        action = (policy if along is None else along).act(preprocess(picture, policy.size),
                                                         robot.odometry)
        return len(deltas) if declares and policy.arrived else action
    found = []
    for index in range(options.episodes):
        episode, seconds, reached = robot.begin_episode(index), 0.0, False
        if policy is not None:
            shown = preprocess(pictures[episode.goal].picture, policy.size)
            policy.set_goal(shown) if along is None else along.set_out(episode.goal, shown)
        while True:
            action = choose()
            if action == len(deltas):
                decision = robot.declare()
            else:
                seconds += spec.nominal_duration(action)
                robot.tick(deltas[action] / TICK)
                decision = robot.tick(np.zeros(4))
            reached |= bool(arrived(decision.distance, decision.heading_error))
            if decision.end:
                break
        found.append(Episode(
            success=decision.success, start_distance=episode.start_distance,
            path_length=episode.path_length, decisions=episode.decisions,
            collisions=episode.collisions, seconds=seconds, stop_distance=decision.distance,
            stop_heading=decision.heading_error, reward=float(decision.success),
            declared=None if options.stop == ARRIVAL else decision.end != TRUNCATED,
            reached=reached))
    return found

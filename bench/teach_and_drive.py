"""Teach and drive: a house that no model has seen, ten minutes with a joystick, then pictures.

    python bench/teach_and_drive.py --out teach_and_drive                  # all three stages
    python bench/teach_and_drive.py --out teach_and_drive --stage record   # or one at a time
    python bench/teach_and_drive.py --out teach_and_drive --stage teach --minutes 30
    python bench/teach_and_drive.py --out teach_and_drive --stage drive --rows before after
    python bench/teach_and_drive.py --out teach_and_drive --stage drive --without-ros --seed 7

- **record**: `sim_bridge_node` with a house of the split "unseen look", a camera at another height
  than the policy's and drifting odometry; a joystick (`vn_sim_bridge.robot.joystick`) that
  publishes Twist; `recorder_node`. Writes `bag`, `robot.yaml`, `record.json`, a map (`record.png`)
  and views out of the bag (`views.png`); `vn_nav bag doctor` has to find no error.
- **teach**: `vn_nav teach` on that bag alone, for so many minutes. Writes `taught`.
- **drive**: episodes over ROS from random starts to pictures out of the bag, of which
  `ground_truth/odom` says where they were taken: `goals`. Rows: the policy before and after, the
  policy after with the pictures of other places, and random actions in the same robot without ROS,
  all from the same starts. Counted from the bags. Writes `result.json`, prints a table.

The joystick's robot has no motion noise: in the simulator no odometry sees that noise (2 deg a
turn of 30 deg: 44 deg in ten minutes of turning around). `--drift` stands in its place, as a base
with encoders and a gyro has it.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import math
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

import cv2
import numpy as np
import yaml

from vn_msgs_py.images import decode_rgb
from vn_msgs_py.motion import fill_twist, odometry_to_array
from vn_nav.arrival import ARRIVAL_HEADING, ARRIVAL_RADIUS, arrived, wrap_angle
from vn_nav.bags.storage.reader import read_bag
from vn_nav.cli.demo import LINE
from vn_nav.cli.world import machine
from vn_nav.errors import UserError
from vn_nav.evaluation.bag_episodes import drives_from_bag
from vn_nav.evaluation.evaluator import ARRIVAL, DECLARED, STOP_THRESHOLD
from vn_nav.evaluation.metrics import Episode, summarise
from vn_nav.nodes.processes import Processes, ProcessFailure
from vn_nav.observation import preprocess
from vn_nav.policy.checkpoint import load_checkpoint
from vn_nav.policy.runtime import PolicyRuntime
from vn_nav.report.tables import print_rows
from vn_nav.resources import share_file
from vn_nav.robot import DRIVE_ACTIONS, load_robot
from vn_nav.scenes import house_scene
from vn_sim_bridge.houses.procedural import generate_house
from vn_sim_bridge.houses.viewpoints import VIEW, interest
from vn_sim_bridge.navigation.env_config import STOPS
from vn_sim_bridge.render.randomisation import load_randomisation
from vn_sim_bridge.robot.goal_pictures import GoalPicture, load_goal_pictures, save_goal_pictures
from vn_sim_bridge.robot.joystick import Joystick
from vn_sim_bridge.robot.simulated_robot import TICK, TRUNCATED, SimulatedRobot
from vn_sim_bridge.simulators.house import HouseSimulator
from vn_sim_bridge.tools.contact_sheet import MARGIN, SCALE, plan_map

STAGES = ('record', 'teach', 'drive')
BEFORE, AFTER, WRONG, RANDOM = ROWS = ('before', 'after', 'wrong picture', 'random actions')
SHOWN = ['image_raw', 'camera_info', 'odom', 'cmd_vel', 'collision', 'ground_truth/odom']
DRIVEN = ['odom', 'ground_truth/odom', 'cmd_vel', 'action', 'action_names', 'arrived', 'collision',
          'reward', 'episode_end', 'episode', 'episode_result', 'scene', '/diagnostics']
RIGHT, OTHER = 'right', 'other'  # folders of goal pictures
CAMERA_RATE = 5.0  # Hz, in the bag that is learned from
PATIENCE, STALL = 60.0, 180.0  # s without a message, without a finished episode
LOOKED_AT = 8  # pictures of the bag of which a person takes the one that shows most, as a goal
RECORD_SEED, DRIVE_SEED = 1, 2026


# Record.


def record(options) -> None:
    """Drive around a house with the joystick, and look at what the bag holds."""
    out, house = options.out, generate_house(options.house, rooms=options.rooms)
    _write_robot(options)
    shutil.rmtree(out / 'bag', ignore_errors=True)
    processes = Processes(out / 'logs')
    begun = time.monotonic()
    try:
        processes.start('recorder', 'vn_nav.nodes.recorder_node',
                        {'output': str(out / 'bag'), 'topics': SHOWN})
        processes.start('bridge', 'vn_sim_bridge.bridge_node', {
            **_bridge(options), 'noise': False, 'seed': RECORD_SEED, 'mode': 'continuous',
            'camera_rate': CAMERA_RATE,
            # One long drive: nothing may put the robot elsewhere.
            'stop': DECLARED, 'max_decisions': 10**9})
        places = _with_joystick(processes, house, options)
    finally:
        processes.stop_all()
    if processes.killed:
        raise SystemExit(f'{processes.killed} did not end within 10 s of SIGINT')
    figures = _look_at(options, house) | places | {
        'wall_seconds': round(time.monotonic() - begun, 1), 'house': options.house,
        'rooms': options.rooms, 'camera_height': options.camera_height, 'drift': options.drift,
        'randomisation': options.randomisation, 'spacing': options.spacing,
        'turns': options.turns}
    _write(out / 'record.json', figures)
    print(json.dumps(figures, indent=1), flush=True)
    _command('bag', 'doctor', str(out / 'bag'), '--robot', str(out / 'robot.yaml'))


def _with_joystick(processes: Processes, house, options) -> dict:
    """Answer every true pose with a Twist, for some simulated time."""
    os.environ.update(processes.environment)  # before rclpy reads them
    import rclpy
    from geometry_msgs.msg import Twist
    from nav_msgs.msg import Odometry
    from rclpy.executors import SingleThreadedExecutor

    from vn_nav.nodes.qos import qos
    rclpy.init()
    node = rclpy.create_node('joystick')
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    heard: list[np.ndarray] = []
    node.create_subscription(Odometry, 'ground_truth/odom',
                             lambda message: heard.append(odometry_to_array(message)),
                             qos('ground_truth/odom', depth=10))
    command = node.create_publisher(Twist, 'cmd_vel', qos('cmd_vel'))

    def pose() -> np.ndarray:
        """The newest one, once there is one; x, y, yaw, velocities, stamp."""
        until = time.monotonic() + PATIENCE
        while not heard:
            executor.spin_once(timeout_sec=0.5)
            for name in ('recorder', 'bridge'):
                processes.check(name)
            if time.monotonic() > until:
                raise ProcessFailure(f'no odometry for {PATIENCE:.0f} s')
        newest = heard[-1]
        heard.clear()
        return newest

    try:
        now = pose()
        joystick = Joystick(house, *now[:2], spacing=options.spacing, turns=options.turns)
        until = time.monotonic() + PATIENCE
        while command.get_subscription_count() < 2:  # the bridge, and the recorder
            executor.spin_once(timeout_sec=0.1)
            if time.monotonic() > until:
                raise ProcessFailure('bridge or recorder do not listen to cmd_vel')
        now = pose()
        end, said = now[6] + 60 * options.simulated_minutes, now[6]
        while now[6] < end or now[3:6].any():
            command.publish(fill_twist(Twist(), joystick.velocity(now) if now[6] < end
                                       else np.zeros(4)))
            now = pose()
            if now[6] >= said + 60:
                said = now[6]
                print(f'{end - now[6]:.0f} simulated s to go, {joystick.visited} places visited '
                      f'of {len(joystick.places)}', flush=True)
        return {'places': len(joystick.places), 'visited': joystick.visited}
    finally:
        node.destroy_node()
        rclpy.shutdown()


def _write_robot(options) -> None:
    """The quick base of the demo, with the camera at another height."""
    robot = yaml.safe_load(share_file('config/robots/demo_base.yaml').read_text())
    robot |= {'name': 'teach_and_drive', 'camera_height': options.camera_height}
    options.out.mkdir(parents=True, exist_ok=True)
    (options.out / 'robot.yaml').write_text(yaml.safe_dump(robot, sort_keys=False))


def _bridge(options) -> dict:
    """Parameters of the bridge in both drives."""
    return {'scene': house_scene(options.house, options.rooms), 'size': options.size,
            'robot': str(options.out / 'robot.yaml'), 'randomisation': options.randomisation,
            'odometry_drift': options.drift, 'time': 'lock_step'}


@dataclasses.dataclass
class Shown:
    """What a bag shows."""

    stamps: np.ndarray  # [K] of true poses and odometry [s]
    truth: np.ndarray  # [K,3] x, y [m], yaw [rad] in the map
    odometry: np.ndarray  # [K,3] in its own frame
    pictures: list[np.ndarray]  # [H,W,3] uint8 RGB
    pictured: np.ndarray  # [P,3] true poses of the pictures
    contacts: int  # pictures since the one before which something was touched


def read(bag: Path) -> Shown:
    """All of a bag, pictures with the true poses that carry their stamps."""
    rows = {name: [] for name in SHOWN}
    for message in read_bag(bag, ('image_raw', 'odom', 'ground_truth/odom', 'collision')):
        rows[message.topic].append(message.message)
    truth, odometry = (np.array([odometry_to_array(m) for m in rows[name]])
                       for name in ('ground_truth/odom', 'odom'))
    _, first, second = np.intersect1d(truth[:, 6], odometry[:, 6], return_indices=True)
    truth, odometry = truth[first], odometry[second]
    at = {round(values[6] / TICK): values[:3] for values in truth}
    seen = [(decode_rgb(m), at[tick]) for m in rows['image_raw']
            if (tick := round((m.header.stamp.sec + 1e-9 * m.header.stamp.nanosec) / TICK)) in at]
    return Shown(truth[:, 6], truth[:, :3], odometry[:, :3], [image for image, _ in seen],
                 np.array([pose for _, pose in seen]), sum(m.data for m in rows['collision']))


def _look_at(options, house) -> dict:
    """Figures of the recorded drive; a map and some pictures for people."""
    shown = read(options.out / 'bag')
    _draw_map(options.out / 'record.png', house, shown)
    some = np.linspace(0, len(shown.pictures) - 1, 40).astype(int)
    tiles = np.array([shown.pictures[k] for k in some])
    sheet = np.concatenate([np.concatenate(list(tiles[k:k + 10]), 1) for k in range(0, 40, 10)])
    cv2.imwrite(str(options.out / 'views.png'), cv2.cvtColor(sheet, cv2.COLOR_RGB2BGR))
    ways = np.hypot(*np.diff(shown.truth[:, :2], axis=0).T)
    turns = wrap_angle(np.diff(shown.truth[:, 2]))
    aligned = _in_the_map(shown)
    errors = np.hypot(*(aligned[:, :2] - shown.truth[:, :2]).T)
    headings = np.degrees(wrap_angle(aligned[:, 2] - shown.truth[:, 2]))
    floor, poses = covered(house, shown.pictured)
    return {
        'simulated_seconds': round(float(shown.stamps[-1] - shown.stamps[0]), 1),
        'pictures': len(shown.pictures), 'metres': round(float(ways.sum()), 1),
        'full_turns': round(float(np.abs(turns).sum() / 2 / math.pi), 1),
        'fastest': [round(float(ways.max() / TICK), 2),
                    round(float(np.abs(turns).max() / TICK), 2)],
        'pictures_after_a_contact': int(shown.contacts),
        'odometry_error_m': {'end': round(float(errors[-1]), 2),
                             'worst': round(float(errors.max()), 2)},
        'odometry_error_deg': {'end': round(float(headings[-1]), 1),
                               'worst': round(float(np.abs(headings).max()), 1)},
        'floor_near_a_picture': round(floor, 3), 'poses_at_a_picture': round(poses, 3)}


def _in_the_map(shown: Shown) -> np.ndarray:
    """Odometry [K,3], put into the map where the drive begins."""
    turn = shown.truth[0, 2] - shown.odometry[0, 2]
    c, s = math.cos(turn), math.sin(turn)
    x, y = (shown.odometry[:, :2] - shown.odometry[0, :2]).T
    return np.column_stack([shown.truth[0, 0] + c * x - s * y, shown.truth[0, 1] + s * x + c * y,
                            shown.odometry[:, 2] + turn])


def covered(house, poses: np.ndarray) -> tuple[float, float]:
    """Of the floor, and of all poses on it, the share with a picture from within arrival's limits.

    Args:
        poses: [P,3] of the pictures.
    """
    cells, headings = house.floor.centres(), np.arange(-math.pi, math.pi, math.pi / 6)
    near = np.zeros((len(cells), len(headings)), bool)
    somewhere = np.zeros(len(cells), bool)
    for x, y, yaw in poses:
        here = np.hypot(*(cells - (x, y)).T) <= ARRIVAL_RADIUS
        somewhere |= here
        near[np.ix_(here, np.abs(wrap_angle(headings - yaw)) <= ARRIVAL_HEADING)] = True
    return float(somewhere.mean()), float(near.mean())


def _draw_map(path: Path, house, shown: Shown) -> None:
    """The way in red, what odometry says of it in grey."""
    plan = plan_map(house.plan())

    def line(poses, colour, width):
        points = np.column_stack([(poses[:, 0] - house.outline.x0 + MARGIN) * SCALE,
                                  len(plan) - (poses[:, 1] - house.outline.y0 + MARGIN) * SCALE])
        cv2.polylines(plan, [points.round().astype(np.int32)], False, colour, width, cv2.LINE_AA)
    line(_in_the_map(shown), (150, 150, 150), 1)
    line(shown.truth, (200, 60, 40), 2)
    cv2.imwrite(str(path), cv2.cvtColor(plan, cv2.COLOR_RGB2BGR))


# Teach.


def teach(options) -> None:
    """`vn_nav teach` on the bag alone."""
    shutil.rmtree(options.out / 'taught', ignore_errors=True)
    begun = time.monotonic()
    words = ['teach', str(options.out / 'bag'), '--checkpoint', str(options.checkpoint),
             '--robot', str(options.out / 'robot.yaml'), '--out', str(options.out / 'taught'),
             '--minutes', str(options.minutes)]
    _command(*words)
    _write(options.out / 'teach.json', {
        'wall_minutes': round((time.monotonic() - begun) / 60, 2),
        'minutes': options.minutes, 'machine': machine(), 'command': ' '.join(['vn_nav', *words])})


def _command(*words: str) -> None:
    """A command of the project; its failure is this program's."""
    print('$ vn_nav', *words, flush=True)
    done = subprocess.run([sys.executable, '-m', 'vn_nav.cli', *words])
    if done.returncode:
        raise SystemExit(f'vn_nav {words[0]} ended with code {done.returncode}')


# Drive.


def drive(options) -> None:
    """Episodes to pictures out of the bag, a row each."""
    out = options.out
    folders = {RIGHT: out / 'goals', OTHER: out / 'other_goals'}
    goals = choose_goals(options, read(out / 'bag'))
    save_goal_pictures(folders[RIGHT], goals)
    # Each pose with the picture of another place.
    save_goal_pictures(folders[OTHER], wrong_pictures(goals))
    episodes = {}
    for row in options.rows:
        shown = folders[OTHER if row == WRONG else RIGHT]
        checkpoint = options.checkpoint if row == BEFORE else out / 'taught' / 'checkpoint'
        if row == RANDOM:
            episodes[row] = without_ros(options, None, [])
        elif options.without_ros:
            policy = PolicyRuntime(checkpoint, seed=options.seed,
                                   stop_threshold=_threshold(options, checkpoint))
            episodes[row] = without_ros(options, policy, load_goal_pictures(shown))
        else:
            episodes[row] = over_ros(options, row, checkpoint, shown)
        print_rows({options.stop: {row: summarise(episodes[row])}}, f'house {options.house}')
    figures = {row: summarise(own) for row, own in episodes.items()}
    parts = {name: json.loads(path.read_text()) for name in ('record', 'teach')
             if (path := out / f'{name}.json').is_file()}
    _write(out / 'result.json', {'stop': options.stop, 'rows': figures, **parts,
                                 'checkpoint': str(options.checkpoint), 'machine': machine()})
    print_rows({options.stop: figures}, f'house {options.house}, pictures out of the bag')


def choose_goals(options, shown: Shown) -> list[GoalPicture]:
    """Pictures of the bag, each the most interesting of a few that were drawn at random."""
    rng = np.random.default_rng(DRIVE_SEED)
    house = generate_house(options.house, rooms=options.rooms)
    backend = HouseSimulator([house], [0], robot=load_robot(options.out / 'robot.yaml'), size=VIEW)
    drawn = rng.permutation(len(shown.pictures))[:LOOKED_AT * options.goals]
    if len(drawn) < LOOKED_AT * options.goals:
        raise UserError(f'a bag holds {LOOKED_AT} pictures for every goal',
                        f'{len(shown.pictures)} for {options.goals} goals', 'lower --goals')
    poses = np.column_stack([shown.pictured[drawn], np.zeros(len(drawn))])
    frames = backend.view(np.zeros(len(drawn), np.int64), poses)
    best = interest(frames.depth, frames.instances).reshape(options.goals, LOOKED_AT).argmax(1)
    chosen = drawn.reshape(options.goals, LOOKED_AT)[np.arange(options.goals), best]
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
    processes = Processes(options.out / 'logs')
    bridge, policy = f'bridge_{name}', f'policy_{name}'
    try:
        processes.start('recorder', 'vn_nav.nodes.recorder_node',
                        {'output': str(bag), 'topics': DRIVEN})
        processes.start(bridge, 'vn_sim_bridge.bridge_node', {
            **_bridge(options), 'goals': str(goals), 'seed': options.seed, 'stop': options.stop,
            'episodes': options.episodes, 'exit_when_done': True})
        processes.start(policy, 'vn_nav.nodes.policy_node', {
            'checkpoint': str(checkpoint), 'robot': robot, 'time': 'lock_step',
            'auto_enable': True, 'seed': options.seed,
            'stop_threshold': _threshold(options, checkpoint)})
        _wait(processes, bridge, policy, options.episodes)
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


def _wait(processes: Processes, bridge: str, policy: str, count: int) -> None:
    """Until the bridge has run its episodes."""
    done, progress = 0, time.monotonic()
    while processes.running[bridge].poll() is None:
        for name in ('recorder', bridge, policy):
            processes.check(name)
        if (now := len(LINE.findall(processes.log(bridge)))) > done:
            done, progress = now, time.monotonic()
            if done % 10 == 0:
                print(f'{bridge}: {done} episodes of {count}', flush=True)
        if time.monotonic() - progress > STALL:
            raise ProcessFailure(f'no episode ended for {STALL:.0f} s')
        time.sleep(0.2)
    processes.check(bridge)


def without_ros(options, policy: PolicyRuntime | None, pictures: list[GoalPicture]
                ) -> list[Episode]:
    """The same starts and goals in the same robot, without ROS.

    Args:
        policy: None: random actions.
        pictures: shown, one for each goal.
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
        action = policy.act(preprocess(picture, policy.size))
        return len(deltas) if declares and policy.arrived else action
    found = []
    for index in range(options.episodes):
        episode, seconds, reached = robot.begin_episode(index), 0.0, False
        if policy is not None:
            policy.set_goal(preprocess(pictures[episode.goal].picture, policy.size))
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


def _write(path: Path, figures: dict) -> None:
    path.write_text(json.dumps(figures, indent=2) + '\n')


def main() -> int:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__.split('\n')[0])
    parser.add_argument('--out', type=Path, required=True, help='folder for everything')
    parser.add_argument('--stage', choices=STAGES, help='only this one')
    parser.add_argument('--checkpoint', type=Path, default=share_file('models/anywhere'))
    parser.add_argument('--house', type=int, default=12_000, help='12000 on: unseen look')
    parser.add_argument('--rooms', type=int, default=5)
    parser.add_argument('--camera-height', type=float, default=0.6, help='m')
    parser.add_argument('--randomisation', default='standard')
    parser.add_argument('--drift', type=float, default=1.0, help='odometry_drift of the bridge')
    parser.add_argument('--size', type=int, default=144, help='side of the pictures [pixels]')
    parser.add_argument('--simulated-minutes', type=float, default=10.0, help='of joystick')
    parser.add_argument('--spacing', type=float, default=1.0, help='of the places visited [m]')
    parser.add_argument('--no-turns', dest='turns', action='store_false',
                        help='do not turn around at the places')
    parser.add_argument('--minutes', type=float, default=30.0, help='of teaching')
    parser.add_argument('--episodes', type=int, default=50)
    parser.add_argument('--goals', type=int, default=50, help='pictures of the bag')
    parser.add_argument('--without-ros', action='store_true', help='drive in the same robot '
                        'without ROS: five times as fast')
    parser.add_argument('--seed', type=int, default=DRIVE_SEED, help='of starts and goals')
    parser.add_argument('--stop', choices=STOPS, default=ARRIVAL, help='what ends an episode')
    parser.add_argument('--rows', nargs='+', choices=ROWS, default=ROWS)
    options = parser.parse_args()
    try:
        for stage in STAGES:
            if options.stage in (None, stage):
                {'record': record, 'teach': teach, 'drive': drive}[stage](options)
    except (UserError, ProcessFailure) as error:
        print(f'{error}; logs are in {options.out / "logs"}', file=sys.stderr)
        return 1
    return 0


if __name__ == '__main__':
    sys.exit(main())

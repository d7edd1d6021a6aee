"""`vn_nav drive-trial`: the same episodes over ROS 2 on an ideal base and on a harsh one."""

from __future__ import annotations

import argparse
import concurrent.futures
import dataclasses
import datetime
import json
import os
import queue
import shutil
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vn_nav.cli import demo
from vn_nav.cli.interruption import ended_as_by_ctrl_c
from vn_nav.errors import UserError
from vn_nav.resources import share_file

if TYPE_CHECKING:
    from vn_nav.policy.checkpoint import LoadedCheckpoint

SEED = 2027  # of the first scene's starts, goals and light; the next one's is the next
ROBOT = 'config/robots/harsh_base.yaml'
PAGE, RESULT = 'page.html', 'result.json'
# s without a finished episode after which a leg gives up: of its own, and of each decision.
STALL, SLOWEST = 60.0, 5.0
RECORDED = [name for name in demo.RECORDED if name != 'image_raw']  # 18 MB a second
MET = ('camera_info', 'odom', 'goal_image', 'episode', 'action_names')


@dataclasses.dataclass(frozen=True)
class Base:
    """A simulated robot of the trial: what the bridge is told, and what the policy."""

    about: str  # a sentence for the page
    bridge: dict[str, Any]
    policy: dict[str, Any]


BASES = {
    'ideal': Base(
        'follows every command at once, in lock-step: time waits for the policy. Odometry is what '
        'the wheels did; motion noise of 0.02 m and 2 degrees. A square picture as in training, '
        'at 10 Hz, without delay.',
        {'time': 'lock_step'}, {'time': 'lock_step'}),
    'harsh': Base(
        'runs in real time. Commands arrive 0.05 to 0.15 s late and the motors lag by as much '
        'again; wheels are worn (0.85 to 1.1 of each metre) and slip in a tenth of the decisions; '
        'odometry drifts twice as fast as that of a good indoor robot; a command holds for 0.5 s, '
        'then the driver brakes. The camera gives 640 x 480 pixels at 20 Hz, noisy, blurred, '
        '0.05 to 0.15 s late, and mounted up to 4 degrees and 8 cm off.',
        {'time': 'real_time', 'randomisation': 'harsh', 'odometry_drift': 2.0, 'size': 480,
         'aspect': 4 / 3, 'camera_rate': 20.0},
        # Its pictures are 0.2 s old where they arrive: a node whose limit is 0.25 drops them all
        # where the computer has anything else to do.
        {'time': 'real_time', 'max_frame_age': 0.5}),
}


@dataclasses.dataclass(frozen=True)
class Leg:
    """Episodes of one base in one scene."""

    base: str
    scene: str
    seed: int
    episodes: int

    @property
    def name(self) -> str:
        """Of its files."""
        return f'{self.base}-{self.seed}'


def add_options(parser: argparse.ArgumentParser) -> None:
    """Options of `vn_nav drive-trial`."""
    parser.add_argument('--out', type=Path, required=True, metavar='FOLDER', help='for page, '
                        'figures and a bag of each scene; what is there is not driven again')
    parser.add_argument('--checkpoint', type=Path, help='instead of the shipped policy for any '
                        'house')
    parser.add_argument('--episodes', type=int, default=100, help='of each base (default 100)')
    parser.add_argument('--scenes', type=int, default=10, metavar='N', help='the first N scenes '
                        'of the split test, an equal share of the episodes each (default 10)')
    parser.add_argument('--scene', action='append', metavar='NAME', help='these instead; may be '
                        'given several times')
    parser.add_argument('--bases', nargs='+', choices=BASES, default=list(BASES))
    parser.add_argument('--robot', default=ROBOT, metavar='YAML',
                        help='limits of both bases (default %(default)s)')
    parser.add_argument('--max-decisions', type=int, default=300)
    parser.add_argument('--set', action='append', default=[], metavar='NAME=VALUE', help='a '
                        'parameter of policy_node on the harsh base, such as settle_time=0.4; may '
                        'be given several times')
    parser.add_argument('--keep', type=Path, metavar='JSON', help='write what the page of the '
                        'demo shows of it, as models/search/trial.json')
    parser.add_argument('--jobs', type=int, default=1, help='scenes side by side, two cores each '
                        'where they are there (default 1)')


def run(args: argparse.Namespace) -> int:
    """`vn_nav drive-trial`.

    Raises:
        UserError: bad options; a node that died, or a base that stalled.
    """
    from vn_nav.cli.world import load_for_scenes, machine
    from vn_nav.evaluation.kept import planner
    from vn_nav.files import write_file
    from vn_nav.nodes.isolation import stay_on_this_host
    from vn_nav.report.terminal import print_table
    from vn_nav.report.trial_page import kept, trial_page
    if args.keep and 'harsh' not in args.bases:
        raise UserError('--keep keeps the ways of the harsh base', args.bases,
                        'leave out --bases, or --keep')
    for name, value in (('--episodes', args.episodes), ('--jobs', args.jobs),
                        ('--scenes', args.scenes), ('--max-decisions', args.max_decisions)):
        if value < 1:
            raise UserError(f'{name} is at least 1', value, f'correct {name}')
    stay_on_this_host()
    folder = args.checkpoint or share_file(demo.ANY_HOUSE)
    checkpoint = load_for_scenes(folder)[0]
    scenes = _scenes(args, checkpoint)
    robot = Path(args.robot)
    if not robot.exists():
        if args.robot != ROBOT:
            raise UserError('--robot names a YAML file', args.robot, 'correct it')
        robot = share_file(ROBOT)
    wanted = {'sha256': checkpoint.info['sha256'], 'planner': planner(),
              'robot': robot.read_text(), 'max_decisions': args.max_decisions}
    extra = _parameters(args.set)
    args.out.mkdir(parents=True, exist_ok=True)
    legs = _legs(args.bases, scenes, args.episodes)
    driver = _Driver(args.out, Path(folder), checkpoint, robot, wanted, extra)
    with ended_as_by_ctrl_c():
        driver.drive(legs, args.jobs)
    result = driver.figures(legs) | {
        'checkpoint': str(args.checkpoint or demo.ANY_HOUSE), 'robot': robot.name,
        'max_decisions': args.max_decisions, 'parameters': extra, 'machine': machine(),
        'date': datetime.date.today().isoformat()}
    write_file(args.out / RESULT, (json.dumps(result, indent=2) + '\n').encode())
    about = {base: BASES[base].about for base in args.bases}
    drives = {base: driver.drives(legs, base) for base in args.bases}
    write_file(args.out / PAGE, trial_page(result, about, drives).encode())
    if args.keep:
        write_file(args.keep, (json.dumps(kept(result, about, drives)) + '\n').encode())
    print_table(f'{args.episodes} episodes of each base, over ROS 2', *_cells(result))
    print(args.out / PAGE)
    return 0


def _scenes(args: argparse.Namespace, checkpoint: LoadedCheckpoint) -> list[str]:
    from vn_nav.cli.scenes import split_scenes
    from vn_nav.scenes import rooms_of, scene_name
    info = checkpoint.info
    if info['task'] != 'image':
        raise UserError('the trial drives to the places of pictures: a checkpoint of task image',
                        info['task'], 'use vn_nav evaluate')
    if args.scene:
        return [scene_name(scene) for scene in args.scene]
    return split_scenes(info['simulator'], 'test', min(args.scenes, args.episodes),
                        rooms_of(info['scenes'][0]) if info['scenes'] else None)


def _parameters(pairs: Sequence[str]) -> dict[str, Any]:
    """Of policy_node, from NAME=VALUE.

    Raises:
        UserError: no such parameter, or no value of it.
    """
    from vn_nav.nodes import policy_parameters
    found: dict[str, Any] = {}
    for pair in pairs:
        name, equals, text = pair.partition('=')
        if not equals or name not in policy_parameters.PARAMETERS:
            raise UserError('--set is NAME=VALUE, a parameter of policy_node', pair,
                            'see ros2 run vn_nav policy_node --help')
        usual = policy_parameters.PARAMETERS[name][0]
        try:
            found[name] = json.loads(text) if not isinstance(usual, str) else text
        except ValueError as error:
            raise UserError(f'{name} is of the kind of {usual!r}', text,
                            'correct --set') from error
        if isinstance(usual, float) and type(found[name]) is int:
            found[name] = float(found[name])
        policy_parameters.check(name, found[name])
    return found


def _legs(bases: Sequence[str], scenes: Sequence[str], episodes: int) -> list[Leg]:
    """A scene's episodes on every base; of an interrupted trial the first scenes compare."""
    shares = [episodes // len(scenes) + (k < episodes % len(scenes)) for k in range(len(scenes))]
    return [Leg(base, scene, SEED + k, count)
            for k, (scene, count) in enumerate(zip(scenes, shares, strict=True)) if count
            for base in bases]


class _Driver:
    """Drives legs, each between a bridge, a policy and a recorder of its own.

    Args:
        out: folder of bags and logs.
        folder, checkpoint: the policy.
        robot: YAML file of the limits.
        conditions: what is kept with the figures of every leg.
        extra: parameters of policy_node on the harsh base.
    """

    def __init__(self, out: Path, folder: Path, checkpoint: LoadedCheckpoint, robot: Path,
                 conditions: dict, extra: dict):
        self._out, self._folder, self._robot = out, folder, robot
        self._info, self._conditions, self._extra = checkpoint.info, conditions, extra
        self._say = threading.Lock()

    def drive(self, legs: Sequence[Leg], jobs: int) -> None:
        """Drive those that have no bag under these conditions.

        Raises:
            UserError: a node died, or a base stalled.
        """
        from vn_nav.evaluation.kept import finished
        left = [leg for leg in legs
                if finished(self._out / f'{leg.name}.json', self._wanted(leg)) is None]
        ended = threading.Event()
        domains = [40 + (os.getpid() + job) % 60 for job in range(jobs)]
        # One queue: a leg in real time takes many times as long as one in lock-step. Those first:
        # they take all of a core, and beside them pictures in real time come too late.
        waiting = queue.SimpleQueue[Leg]()
        for leg in sorted(left, key=lambda leg: BASES[leg.base].bridge['time'] != 'lock_step'):
            waiting.put(leg)
        with concurrent.futures.ThreadPoolExecutor(jobs) as pool:
            running = [pool.submit(self._drive_several, waiting, domain, ended)
                       for domain in domains]
            try:
                concurrent.futures.wait(
                    running, return_when=concurrent.futures.FIRST_EXCEPTION)
            finally:
                ended.set()
        for one in running:
            one.result()

    def _wanted(self, leg: Leg) -> dict:
        from vn_sim_bridge.render.randomisation import load_randomisation
        parameters = self._extra if leg.base == 'harsh' else {}
        base = BASES[leg.base]
        varied = base.bridge.get('randomisation', self._info['randomisation'])
        return self._conditions | dataclasses.asdict(leg) | {
            'bridge': base.bridge, 'policy': base.policy | parameters,
            'randomisation': dataclasses.asdict(load_randomisation(varied))}

    def _drive_several(self, waiting: queue.SimpleQueue[Leg], domain: int,
                       ended: threading.Event) -> None:
        while not ended.is_set():
            try:
                leg = waiting.get_nowait()
            except queue.Empty:
                return
            self._drive_one(leg, domain, ended)

    def _drive_one(self, leg: Leg, domain: int, ended: threading.Event) -> None:
        from vn_nav.evaluation.kept import keep
        from vn_nav.nodes.demo_watch import DemoWatch
        from vn_nav.nodes.processes import Processes, ProcessFailure
        base, begun = BASES[leg.base], time.monotonic()
        shutil.rmtree(self._bag(leg), ignore_errors=True)
        logs = self._out / 'logs' / leg.name
        processes = Processes(logs)
        processes.environment['ROS_DOMAIN_ID'] = str(domain)
        wanted = self._wanted(leg)
        try:
            processes.start('recorder', 'vn_nav.nodes.recorder_node',
                            {'output': str(self._bag(leg)), 'topics': RECORDED})
            with DemoWatch(processes, 'policy_node', 'sim_bridge_node', MET) as watch:
                processes.start('policy_node', 'vn_nav.nodes.policy_node', {
                    'checkpoint': str(self._folder), 'robot': str(self._robot),
                    'seed': leg.seed} | wanted['policy'])
                # Before `base.bridge`, which may know better: pictures as in training.
                processes.start('sim_bridge_node', 'vn_sim_bridge.bridge_node', {
                    'randomisation': self._info['randomisation'], 'scene': leg.scene,
                    'seed': leg.seed, 'stop': demo.stop_of(self._info), 'robot': str(self._robot),
                    'episodes': leg.episodes, 'max_decisions': self._conditions['max_decisions'],
                    'exit_when_done': True} | base.bridge)
                watch.enable()
                seen, interventions, progress = 0, 0, time.monotonic()
                patience = STALL + SLOWEST * self._conditions['max_decisions']
                while processes.running['sim_bridge_node'].poll() is None:
                    if ended.is_set():
                        return
                    watch.spin(0.2)
                    for one in watch.episodes[seen:]:
                        self._tell(leg, f'{one.number + 1}/{leg.episodes}: {one.outcome} after '
                                   f'{one.decisions} decisions, {one.metres:.1f} m')
                        seen, progress = seen + 1, time.monotonic()
                    if watch.stopped and seen < leg.episodes:
                        interventions += 1
                        self._tell(leg, f'policy_node {watch.said}: resumed')
                        watch.resume()
                    if time.monotonic() - progress > patience:
                        raise ProcessFailure(f'no episode ended for {patience:.0f} s; the policy '
                                             f'says: {watch.said}')
        except ProcessFailure as error:
            raise UserError('bridge, policy and recorder drive to the end', f'{leg.name}: {error}',
                            f'see {logs}; what has ended is kept') from error
        finally:
            processes.stop_all()
        keep(self._out / f'{leg.name}.json', {
            'conditions': wanted, 'interventions': interventions,
            'seconds': round(time.monotonic() - begun, 1)})

    def _tell(self, leg: Leg, words: str) -> None:
        with self._say:
            print(f'{leg.base} {leg.scene} {words}', flush=True)

    def _bag(self, leg: Leg) -> Path:
        return self._out / 'bags' / leg.name

    def drives(self, legs: Sequence[Leg], base: str) -> list:
        """What the bags of a base hold, a `Drive` a scene."""
        from vn_nav.evaluation.bag_episodes import drives_from_bag
        return [drives_from_bag(self._bag(leg))[0] for leg in legs if leg.base == base]

    def figures(self, legs: Sequence[Leg]) -> dict:
        """Figures of every base; of two, also the differences on the same starts.

        Raises:
            UserError: a bag with other episodes than were driven.
        """
        from vn_nav.evaluation.metrics import bootstrap_interval, summarise
        episodes: dict[str, list] = {}
        for leg in legs:
            for drive in self.drives([leg], leg.base):
                if len(drive.episodes) != leg.episodes:
                    raise UserError(f'a bag of {leg.episodes} episodes', f'{self._bag(leg)}: '
                                    f'{len(drive.episodes)}', 'remove its .json and drive again')
                episodes.setdefault(leg.base, []).extend(one.episode for one in drive.episodes)
        found: dict[str, Any] = {'bases': {
            base: summarise(own) | _stops(own) | {'interventions': sum(
                json.loads((self._out / f'{leg.name}.json').read_text())['interventions']
                for leg in legs if leg.base == base)} for base, own in episodes.items()}}
        if len(episodes) == 2:
            one, two = episodes['harsh'], episodes['ideal']
            for name in ('success', 'decisions'):
                differences = [float(getattr(a, name)) - float(getattr(b, name))
                               for a, b in zip(one, two, strict=True)]
                found[f'{name}_difference'] = [sum(differences) / len(differences),
                                               *bootstrap_interval(differences)]
        return found


def _stops(episodes: Sequence) -> dict:
    """Where the successful ones stopped: medians, and what nine of ten keep within."""
    import numpy as np
    good = [(e.stop_distance, e.stop_heading) for e in episodes if e.success]
    if not good:
        return {'good_stop_m': None, 'good_stop_deg': None}
    metres, radians = np.array(good).T
    return {'good_stop_m': [float(np.quantile(metres, q)) for q in (0.5, 0.9)],
            'good_stop_deg': [float(np.degrees(np.quantile(radians, q))) for q in (0.5, 0.9)]}


def _cells(result: dict) -> tuple[list[str], list[list[str]]]:
    """Headings and lines of the table."""
    from vn_nav.report.tables import number
    lines = []
    for base, r in result['bases'].items():
        low, high = r['success_interval']
        stop = '-' if r['good_stop_m'] is None else '{:.2f} m {:.0f} deg'.format(
            r['good_stop_m'][0], r['good_stop_deg'][0])
        lines.append([base, f'{r["success"]:.2f} ({low:.2f}-{high:.2f})', number(r['spl'], '.2f'),
                      f'{r["decisions"]:.0f}', f'{r["seconds"]:.0f}', f'{r["collisions"]:.1%}',
                      number(r.get('false_stops'), '.2f'), stop, str(r['interventions'])])
    return ['base', 'success (95 %)', 'SPL', 'decisions', 'seconds', 'collisions', 'false\nstops',
            'median stop', 'inter-\nventions'], lines

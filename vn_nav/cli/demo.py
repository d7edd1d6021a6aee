"""`vn_nav demo`: bridge, policy and recorder as processes on ROS 2, then figures from the bag."""

from __future__ import annotations

import argparse
import dataclasses
import datetime
import json
import shutil
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console
from rich.live import Live
from rich.table import Table

from vn_nav.cli.world import check_version, load_for_scenes, make_env
from vn_nav.errors import UserError
from vn_nav.evaluation.bag_episodes import Drive, RecordedEpisode, drives_from_bag
from vn_nav.evaluation.evaluator import (
    ARRIVAL,
    DECLARED,
    STOP_THRESHOLD,
    PolicyActor,
    random_actor,
    run_episodes,
)
from vn_nav.evaluation.metrics import Episode, bootstrap_interval, summarise
from vn_nav.nodes.isolation import stay_on_this_host
from vn_nav.nodes.processes import Processes, ProcessFailure
from vn_nav.policy.checkpoint import LoadedCheckpoint
from vn_nav.policy.checkpoint_info import TRIAL
from vn_nav.policy.network_config import SEARCH
from vn_nav.report.demo_page import kind_of, write_report
from vn_nav.report.tables import TITLES, number
from vn_nav.report.terminal import print_table
from vn_nav.resources import share_file
from vn_nav.robot import RobotSpec
from vn_nav.scenes import HOUSE, house_scene, parse_scene, rooms_of, scene_name
from vn_sim_bridge.simulators import simulator_class

if TYPE_CHECKING:
    from vn_nav.nodes.demo_watch import EndedEpisode

ONE_HOUSE, ANY_HOUSE = 'models/house', 'models/search'  # the shipped policies
LIMIT, UNSEEN_LIMIT = 300, 100  # decisions an episode; the second for a policy of one house
UNSEEN_HOUSE = 11_000  # seed, of the split test: no shipped policy has seen it
SEED = 2026  # of starts, goals and light
BASE = 'config/robots/demo_base.yaml'
STALL = 60.0  # s without a finished episode after which the demo gives up
RECORDED = ['image_raw', 'camera_info', 'goal_image', 'cmd_vel', 'odom', 'ground_truth/odom',
            'action', 'action_names', 'arrived', 'collision', 'reward', 'episode_end', 'episode',
            'episode_result', 'scene', '/diagnostics']
# Of the node of a policy that searches: `~/map` and `~/hypotheses`.
SEARCH_TOPICS = ('map:nav_msgs/msg/OccupancyGrid', 'hypotheses:geometry_msgs/msg/PoseArray')


@dataclasses.dataclass(frozen=True)
class Stage:
    """Where the demo drives, and who."""

    place: str  # 'trained' or 'unseen'
    scene: str
    count: int  # episodes
    limit: int  # decisions an episode
    folder: Path  # of the checkpoint
    checkpoint: LoadedCheckpoint


def add_options(parser: argparse.ArgumentParser) -> None:
    """Options of `vn_nav demo`."""
    parser.add_argument('--out', type=Path, default=Path('demo'), help='folder for bag and page')
    parser.add_argument('--scene', metavar='NAME', help='drive in this scene alone; default: the '
                        'first one of the training, and of a policy of houses an unseen house')
    parser.add_argument('--episodes', type=int, default=20,
                        help='in the trained scene, or in that of --scene')
    parser.add_argument('--unseen-episodes', type=int, default=20, help='in an unseen house')
    parser.add_argument('--checkpoint', type=Path, help='instead of the shipped policies: of '
                        'one house in that house, of any house elsewhere')


def run(args: argparse.Namespace) -> int:
    """`vn_nav demo`."""
    return demonstrate(args.out, args.checkpoint, episodes=args.episodes,
                       unseen_episodes=args.unseen_episodes, scene=args.scene)


def demonstrate(out: Path, folder: Path | None = None, *, episodes: int = 20,
                unseen_episodes: int = 20, scene: str | None = None) -> int:
    """Drive, record, measure, report.

    A checkpoint with a stop threshold has to declare its stop; for others arriving is enough.

    Args:
        out: folder for bag, page and result.json; what an earlier demo left there is replaced.
        folder: of the checkpoint; None: the shipped ones.
        episodes, unseen_episodes: in the trained scene and in the unseen house.
        scene: to drive in alone; None: these two.

    Returns:
        The exit code.
    """
    if episodes < 1 or unseen_episodes < 1:
        raise UserError('the demo has at least one episode in each scene',
                        (episodes, unseen_episodes), 'raise --episodes, --unseen-episodes')
    console = Console()
    stages = _stages(folder, scene, episodes, unseen_episodes)
    _import_ros()
    out = Path(out)
    out.mkdir(parents=True, exist_ok=True)
    for name in ('bag', 'logs'):
        shutil.rmtree(out / name, ignore_errors=True)
    for name in ('report.html', 'result.json'):
        (out / name).unlink(missing_ok=True)
    begun = time.monotonic()
    console.print('[bold]vn_nav demo[/]: a picture in, a robot that drives there. Simulator and '
                  'policy are two processes that meet on ROS 2 topics alone.')
    processes = Processes(out / 'logs')
    try:
        processes.start('recorder', 'vn_nav.nodes.recorder_node',
                        {'output': str(out / 'bag'), 'topics': RECORDED + [
                            f'/{_policy(stage)}/{topic}' for stage in stages
                            if stage.checkpoint.config.architecture == SEARCH
                            for topic in SEARCH_TOPICS]})
        for index, stage in enumerate(stages):
            _drive(console, processes, stage, start_time=1.0 + 1e5 * index)
    except ProcessFailure as error:
        console.print(f'[red]vn_nav demo: {error}[/]; logs are in {out / "logs"}')
        return 1
    finally:
        processes.stop_all()
    if processes.killed:
        console.print(f'[red]vn_nav demo: {", ".join(processes.killed)} did not end within 10 s '
                      f'of SIGINT and had to be killed[/]; logs are in {out / "logs"}')
        return 1
    drives = drives_from_bag(out / 'bag', pictures=True,
                             policies=[_policy(stage) for stage in stages])
    result = _results(drives, stages)
    result |= {'seconds': round(time.monotonic() - begun, 1), 'bag': 'bag', 'html': 'report.html',
               'date': datetime.date.today().isoformat()}
    trial = share_file(ANY_HOUSE) / TRIAL
    write_report(out / 'report.html', drives, result, json.loads(trial.read_text())
                 if folder is None and scene is None and trial.is_file() else None)
    result['seconds'] = round(time.monotonic() - begun, 1)
    (out / 'result.json').write_text(json.dumps(result, indent=2) + '\n')
    _show(console, result, out)
    return 0


def _import_ros() -> None:
    """Import what needs ROS, where ROS stays on this host."""
    stay_on_this_host()
    try:
        import vn_nav.nodes.demo_watch  # noqa: F401
    except ImportError as error:
        raise UserError('the demo runs the real nodes, on ROS 2 Jazzy', str(error),
                        "pip install 'vn_nav[ros]', or source an installed Jazzy") from error


def _stages(folder: Path | None, scene: str | None, episodes: int, unseen_episodes: int
            ) -> list[Stage]:
    """Where the demo drives, and who.

    Raises:
        UserError: no such scene, of another version than the policy's, nobody names one, or a
            policy whose task has no goal picture.
    """
    if scene is not None:
        scene = scene_name(scene)
        folder = folder or share_file(ANY_HOUSE)
        checkpoint = _load(folder, scene)
        known = scene in checkpoint.info['scenes']
        return [Stage('trained' if known else 'unseen', scene, episodes,
                      LIMIT if known else _limit(checkpoint), folder, checkpoint)]
    shipped, folder = folder is None, folder or share_file(ONE_HOUSE)
    checkpoint = _load(folder)
    if not checkpoint.info['scenes']:
        raise UserError('the demo drives in the scene of the training', 'a checkpoint that names '
                        'none', 'give --scene')
    trained = checkpoint.info['scenes'][0]
    stages = [Stage('trained', trained, episodes, LIMIT, folder, checkpoint)]
    if parse_scene(trained).simulator == HOUSE:  # of which there are always others
        unseen = house_scene(UNSEEN_HOUSE, rooms_of(trained))
        if shipped:
            folder = share_file(ANY_HOUSE)
            checkpoint = _load(folder, unseen)
        stages.append(Stage('unseen', unseen, unseen_episodes, _limit(checkpoint), folder,
                            checkpoint))
    return stages


def _load(folder: Path, scene: str | None = None) -> LoadedCheckpoint:
    """A checkpoint that can drive in a scene; None: in its own."""
    checkpoint = load_for_scenes(folder)[0]
    if checkpoint.info['task'] != 'image':
        raise UserError('the demo drives to the places of pictures: a checkpoint of task image',
                        checkpoint.info['task'], 'use vn_nav evaluate')
    if scene is not None:
        check_version(checkpoint.info, simulator=parse_scene(scene).simulator)
    return checkpoint


def _limit(checkpoint: LoadedCheckpoint) -> int:
    """Decisions that an episode in an unseen scene has at most."""
    return LIMIT if len(checkpoint.info['scenes']) > 1 else UNSEEN_LIMIT


def bridge_parameters(checkpoint: LoadedCheckpoint, scene: str, count: int, limit: int) -> dict:
    """What the sim bridge simulates in one scene. `control_env` simulates the same."""
    info = checkpoint.info
    varies = simulator_class(parse_scene(scene).simulator).capabilities.appearance
    return {'scene': scene, 'size': checkpoint.config.size,
            'randomisation': info['randomisation'] if varies else 'none',
            'seed': SEED, 'stop': stop_of(info),
            'robot': str(share_file(BASE)), 'episodes': count, 'max_decisions': limit}


def control_env(make_env: Callable, checkpoint: LoadedCheckpoint, scene: str, count: int,
                limit: int):
    """The same scene without ROS: environment k, reset with SEED, begins as episode k over ROS.

    Goal, its picture, start, light and base are equal. Not equal are the numbers behind motion
    noise, sensor noise, slip and late pictures, which the bridge draws a tick, not a decision,
    and those behind sampled actions.
    """
    same = bridge_parameters(checkpoint, scene, count, limit)
    # The bridge's odometry: noise is unseen, and its wheels do not drift unless somebody says so.
    odometry = 'commanded' if checkpoint.network.uses_odometry else 'none'
    # The seed of the goal pictures' light is the configuration's, whatever `reset` is given.
    return make_env([same['scene']], same['episodes'], size=same['size'],
                    randomisation=same['randomisation'], seed=same['seed'], stop=same['stop'],
                    robot=Path(same['robot']), max_decisions=same['max_decisions'],
                    actions=checkpoint.config.actions, odometry=odometry)


def _drive(console: Console, processes: Processes, stage: Stage, start_time: float) -> None:
    """All episodes in one scene."""
    from vn_nav.nodes.demo_watch import DemoWatch
    count = stage.count
    bridge, policy = f'bridge_{stage.place}', _policy(stage)
    note = ('' if stage.place == 'trained'
            else f' (never seen; episodes end at {stage.limit} decisions)')
    console.print(f'\n[bold]{stage.place} {kind_of(stage.scene)}[/], {stage.scene}{note}; '
                  f'policy {stage.folder.name}')
    with DemoWatch(processes, policy, bridge) as watch:
        processes.start(policy, 'vn_nav.nodes.policy_node', {
            'checkpoint': str(stage.folder), 'robot': str(share_file(BASE)), 'time': 'lock_step',
            'seed': SEED}, (f'__node:={policy}',))
        processes.start(bridge, 'vn_sim_bridge.bridge_node',
                        bridge_parameters(stage.checkpoint, stage.scene, count,
                                          stage.limit) | {
                            'time': 'lock_step', 'start_time': start_time,
                            'exit_when_done': True}, (f'__node:={bridge}',))
        with Live(_progress([], count), console=console, refresh_per_second=8) as live:
            watch.enable()
            seen, progress = 0, time.monotonic()
            while processes.running[bridge].poll() is None:
                watch.spin(0.1)
                done = watch.episodes
                if len(done) > seen:
                    seen, progress = len(done), time.monotonic()
                live.update(_progress(done, count))
                if time.monotonic() - progress > STALL:
                    raise ProcessFailure(f'no episode ended for {STALL:.0f} s; the policy says: '
                                         f'{watch.said}')
            watch.spin(0.5)  # the last result is on its way
            live.update(_progress(watch.episodes, count))
    processes.stop(policy)
    processes.stop(bridge)


def _policy(stage: Stage) -> str:
    """Name of the policy's node."""
    return f'policy_{stage.place}'


def stop_of(info: dict) -> str:
    """What ends an episode before its limit, by what a checkpoint says of itself."""
    return ARRIVAL if info['stop_threshold'] is None else DECLARED


def _progress(done: list[EndedEpisode], count: int) -> Table:
    """The live view: one row an episode, the newest at the bottom."""
    table = Table(box=None, pad_edge=False)
    for heading in ('episode', 'goal', 'outcome', 'decisions', 'metres'):
        table.add_column(heading, justify='left' if heading in ('goal', 'outcome') else 'right')
    for episode in done[-12:]:
        colour = 'green' if episode.outcome == 'arrived' else 'yellow'
        table.add_row(f'{episode.number + 1}/{count}', episode.goal,
                      f'[{colour}]{episode.outcome}[/]', str(episode.decisions),
                      f'{episode.metres:.1f}')
    if len(done) < count:
        table.add_row(f'{len(done) + 1}/{count}', '...', 'driving' if done else 'starting', '', '')
    return table


def _results(drives: list[Drive], stages: list[Stage]) -> dict:
    """Figures from the bag; on the same starts random actions, and the policy without ROS."""
    result = {}
    for stage, drive in zip(stages, drives, strict=True):
        info, count = stage.checkpoint.info, stage.count
        stop = stop_of(info)
        figures = summarise([recorded.episode for recorded in drive.episodes])
        env = control_env(make_env, stage.checkpoint, stage.scene, count, stage.limit)
        control = run_episodes(env, random_actor(env, SEED), count, seed=SEED, robot=RobotSpec())
        actor = PolicyActor(env, stage.checkpoint.network, info['decoding'], SEED,
                            STOP_THRESHOLD if stop == ARRIVAL else info['stop_threshold'])
        in_process = run_episodes(env, actor, count, seed=SEED, robot=RobotSpec())
        env.close()
        result[stage.place] = figures | {
            'scene': stage.scene, 'checkpoint': stage.folder.name, 'max_decisions': stage.limit,
            'stop': stop, 'odometry': env.config.odometry, 'random': summarise(control),
            'without_ros': summarise(in_process),
            'minus_without_ros': _paired(drive.episodes, in_process)}
    return result


def _paired(recorded: list[RecordedEpisode], in_process: list[Episode]) -> dict:
    """Success and decisions over ROS minus those without it, on the same starts; 95 %."""
    found: dict[str, float | list[float]] = {}
    for name in ('success', 'decisions'):
        differences = [float(getattr(one.episode, name)) - float(getattr(two, name))
                       for one, two in zip(recorded, in_process, strict=True)]
        found[name] = sum(differences) / len(differences)
        found[f'{name}_interval'] = list(bootstrap_interval(differences))
    return found


def _show(console: Console, result: dict, out: Path) -> None:
    for place in (name for name in ('trained', 'unseen') if name in result):
        figures = result[place]
        stop = f', {TITLES[DECLARED].lower()}' if figures['stop'] == DECLARED else ''
        console.print()
        print_table(f'Measured from the bag: {place} {kind_of(figures["scene"])}, '
                    f'{figures["episodes"]} episodes{stop}',
                    *_cells(figures))
    for name, path in (('page', 'report.html'), ('bag', 'bag'), ('figures', 'result.json')):
        console.print(f'{name:7} {out / path}', highlight=False, soft_wrap=True)
    console.print(f'{result["seconds"]:.0f} s in all; in brackets 95 % intervals',
                  highlight=False)


def _cells(figures: dict) -> tuple[list[str], list[list[str]]]:
    """Headings and lines of one scene's table."""
    declared = figures['stop'] == DECLARED
    headings = ['policy', 'success', 'SPL', 'decisions', 'collisions',
                *(('declared', 'false\nstops') if declared else ())]
    lines = []
    for policy, r in (('over ROS 2', figures), ('without ROS', figures['without_ros']),
                      ('random', figures['random'])):
        low, high = r['success_interval']
        lines.append([
            policy, f'{r["success"]:.0%} ({100 * low:.0f}-{100 * high:.0f})',
            number(r['spl'], '.2f'),
            '{:.0f} ({:.0f}-{:.0f})'.format(r['decisions'], *r['decisions_interval']),
            f'{r["collisions"]:.1%}',
            *((f'{r["declared"]:.0%}', f'{r["false_stops"]:.0%}') if declared else ())])
    return headings, lines

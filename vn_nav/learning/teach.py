"""`vn_nav teach`: a policy for the place where a bag was driven, learned in the bag's pictures.

The simulator's half, which makes a place out of pictures with poses, comes from the caller
(`vn_sim_bridge.teach`).
"""

from __future__ import annotations

import argparse
import dataclasses
import datetime
import functools
import json
import math
import shlex
import sys
import time
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch

from vn_nav.bags.recorded_place import add_place_options, check_place_options, read_place
from vn_nav.errors import UserError
from vn_nav.evaluation import evaluator, tables
from vn_nav.evaluation.command import DRIVE_SPLITS
from vn_nav.evaluation.evaluation_page import evaluation_page
from vn_nav.learning.command import CHANGES, train_config
from vn_nav.learning.pairs import PairSource
from vn_nav.learning.places import BANK, Views, fit_places, fit_routes
from vn_nav.learning.presets import ENVIRONMENT, TrainConfig
from vn_nav.learning.trainer import CHECKPOINT, STATE, has_fast_bfloat16, train
from vn_nav.policy.checkpoint import (
    LoadedCheckpoint,
    load_checkpoint,
    save_checkpoint,
    write_file,
)
from vn_nav.policy.network import Policy
from vn_nav.robot import DRIVE_ACTIONS, RobotSpec, load_robot

PRESET = 'fast'
# The place is one to know by heart: there the shortest path is something to imitate.
TEACHER = {'imitation': 1.0, 'imitation_until': 1.0, 'teacher': 'routes', 'teacher_share': 0.5,
           'teacher_until': 0.6, 'start_difficulty': 1.0}
# Without a checkpoint: much is learned from each rollout, and first from picture pairs, for so
# large a share of the minutes.
FROM_NOTHING = {'epochs': 4, 'minibatches': 8, 'learning_rate': 1e-3}
PAIR_SHARE = 0.1
PLACES, FOR_A_SPOT = 64, 4  # spots that the policy tells apart, and pictures for each at least
PLACE_SHARE, ROUTE_SHARE = 0.07, 0.1  # of the minutes, to learn them, and the ways between;
ALONE = (0.4, 0.6)  # and where that is all: a policy that finds pictures anywhere needs no more
# Of the logits: what that policy thinks, and what it is advised.
OWN, ADVISED = 0.75, 0.9
START = 'start'  # folder of the policy that knows the place, but no way there
COLLISION_REWARD = -0.05  # of leaving what the pictures cover
CONTROLS = (evaluator.WRONG, evaluator.RANDOM, evaluator.SHORTEST)
BEFORE = 'before teaching'
EVALUATION_SEED = 10_000


class Place(Protocol):
    """What the simulator's half makes of a drive; `vn_sim_bridge.teach` is one."""

    def build_graph(self, pictures, poses, episode, robot: RobotSpec, **options) -> Any:
        """A place out of pictures with poses."""

    def held_out(self, graph) -> tuple[Any, Any]:
        """The place with the goals to learn, and with those to judge by, or None."""

    def make_env(self, graph, robot: RobotSpec, envs: int, **options) -> Any:
        """A vector environment there."""

    def make_pairs(self, own, others, robot: RobotSpec, seed: int
                   ) -> tuple[PairSource, PairSource]:
        """Picture pairs to learn from, and to judge by."""

    def make_views(self, graph, robot: RobotSpec, seed: int) -> tuple[Views, Views]:
        """Pictures with poses to know the place by, and others to judge by."""

    def regrets(self, graph, poses: np.ndarray) -> np.ndarray:
        """[G,N,A] float16 decisions that actions at poses [N,3] lose on the ways to the goals."""

    def draw_map(self, path: Path, own, others) -> None:
        """A picture of the place."""


def add_teach_options(parser: argparse.ArgumentParser) -> None:
    """Options of `vn_nav teach`."""
    parser.add_argument('bag', type=Path, metavar='BAG', help='rosbag2 folder or MCAP file')
    parser.add_argument('--out', type=Path, required=True, help='folder of the run')
    parser.add_argument('--checkpoint', type=Path, metavar='DIR', help='begin with this policy, '
                        'for example models/anywhere: network, size and actions are its own; '
                        'default: from nothing')
    parser.add_argument('--minutes', type=float, default=10.0, help='of learning')
    parser.add_argument('--robot', type=Path, metavar='YAML',
                        help='that drove, with its camera; default: the standard robot')
    add_place_options(parser)
    parser.add_argument('--places', type=int, default=PLACES, metavar='K', help='spots of the '
                        'place that the policy knows by heart; 0: none')
    parser.add_argument('--episodes', type=int, default=50, help='of each row of the evaluation')
    parser.add_argument('--size', type=int, help='without a checkpoint: side of the pictures '
                        '[pixels]; default 84')
    parser.add_argument('--envs', type=int, default=ENVIRONMENT[PRESET]['envs'],
                        help='robots that learn at a time')
    parser.add_argument('--set', action='append', default=[], metavar='NAME=VALUE',
                        help='any number of vn_nav.learning.presets.TrainConfig')
    parser.add_argument('--resume', action='store_true', help='go on with the run in --out')
    parser.add_argument('--seed', type=int, default=0)
    parser.add_argument('--threads', type=int, default=1, help='of torch')


def teach(args: argparse.Namespace, place: Place) -> int:
    """`vn_nav teach`.

    Raises:
        UserError: options, a bag or a checkpoint that do not fit; a drive too short, or of one
            spot.
    """
    _check(args)
    check_place_options(args)
    given = load_checkpoint(args.checkpoint) if args.checkpoint else None
    config = _config(args, given)
    robot = _robot(args, given)
    size = given.config.size if given else args.size or 84
    graph = read_place(args, place.build_graph, robot, size,
                       args.cache or args.out / 'decoded')
    own, others = place.held_out(graph)
    for line in (*graph.words, 'no goals are held out: there are too few' if others is None else
                 f'{len(own.goals)} goals to learn, {len(others.goals)} held out'):
        print(line, flush=True)
    args.out.mkdir(parents=True, exist_ok=True)
    place.draw_map(args.out / 'map.png', own, others)
    config = dataclasses.replace(config, places=min(config.places, len(graph.poses) // FOR_A_SPOT))
    if args.places and given is not None:
        folder = _learn_places(args, place, own, robot, given, config, ALONE, CHECKPOINT)
    else:
        world = ENVIRONMENT[PRESET] | {'collision_reward': COLLISION_REWARD}
        env = place.make_env(own, robot, args.envs, seed=args.seed, privileged=config.privileged,
                             light=True,
                             **{name: value for name, value in world.items() if name != 'envs'})
        init = args.checkpoint
        if args.places and not (args.resume and (args.out / STATE).is_file()):
            init = _learn_places(args, place, own, robot, given, config,
                                 (PLACE_SHARE, ROUTE_SHARE), START)
        folder = train(env, config, args.out, info=_info(args, robot, graph), resume=args.resume,
                       init=init,
                       pairs=lambda: place.make_pairs(own, others, robot, args.seed))
    _evaluate(args, place, folder, given, robot,
              dict(zip(DRIVE_SPLITS, (own, others), strict=True)))
    print(folder)
    return 0


def _check(args: argparse.Namespace) -> None:
    rules = (
        (args.minutes > 0, 'there is some time to learn', args.minutes, 'raise --minutes'),
        (args.episodes >= 1, 'there is at least one episode', args.episodes, 'raise --episodes'),
        (args.places == 0 or 2 <= args.places <= 1024, 'there are 2 to 1024 spots, or none',
         args.places, 'correct --places'),
        (args.envs >= 1, 'there is at least one robot', args.envs, 'raise --envs'),
        (args.size is None or args.checkpoint is None, 'the size is that of the checkpoint',
         args.size, 'leave out --size'),
        (args.resume or not (args.out / STATE).is_file(), 'a new run has a folder of its own',
         str(args.out), 'go on there with --resume, or choose another folder'),
    )
    for kept, rule, received, remedy in rules:
        if not kept:
            raise UserError(rule, received, remedy)


def _config(args: argparse.Namespace, given: LoadedCheckpoint | None) -> TrainConfig:
    """The preset's numbers, for the network of a checkpoint if there is one."""
    left = args.minutes * (1 - (PLACE_SHARE + ROUTE_SHARE if args.places else 0))
    own = {'frames': 10**9, 'minutes': left, 'places': args.places, **TEACHER}
    if given is None:
        own |= FROM_NOTHING | {'pair_minutes': PAIR_SHARE * args.minutes}
    else:
        network = given.config
        if network.architecture == 'icra2017':
            raise UserError('an encoder that learns is taught', f'{args.checkpoint}, whose '
                            'encoder is frozen', 'choose another --checkpoint')
        own |= {'pair_minutes': 0.0, 'stacked_frames': network.frames,
                'track_goal': bool(network.moves), **{name: getattr(network, name) for name in (
                    'architecture', 'channels', 'blocks', 'features', 'hidden', 'deconvolutions',
                    'pose_to_memory', 'pixel_mean', 'pixel_std')}}
    words = [f'{name}={value!r}' for name, value in own.items()]
    return train_config(argparse.Namespace(**dict.fromkeys(CHANGES) | {
        'preset': PRESET, 'set': [*words, *args.set], 'seed': args.seed, 'no_tensorboard': True,
        'threads': args.threads}))


def _robot(args: argparse.Namespace, given: LoadedCheckpoint | None) -> RobotSpec:
    """The robot with the actions of the policy."""
    robot = load_robot(args.robot) if args.robot else RobotSpec()
    if given is None:
        return robot.with_actions(DRIVE_ACTIONS)
    before = given.info['camera_fov_deg'], given.info['camera_height']
    now = math.degrees(robot.camera_fov), robot.camera_height
    if any(abs(a - b) > 0.01 * b for a, b in zip(now, before, strict=True)):
        print(f'the camera is another one ({now[0]:.0f} deg, {now[1]:g} m high) than the policy '
              f'has learned with ({before[0]:.0f} deg, {before[1]:g} m): it gets used to it',
              flush=True)
    return robot.with_actions(given.config.actions, given.config.moves)


def _learn_places(args: argparse.Namespace, place: Place, graph, robot: RobotSpec,
                  given: LoadedCheckpoint | None, config: TrainConfig,
                  shares: tuple[float, float], name: str) -> Path:
    """Know the place and its ways by its pictures, each for a share of the minutes.

    Returns:
        The folder of the policy, of this name.
    """
    torch.set_num_threads(config.threads)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(args.seed)
        network = Policy(config.network(robot.action_names, graph.pictures.shape[-1],
                                        robot.moves if config.track_goal else ()))
    if given is not None:
        network.load_state_dict(_widened(given.network.state_dict(), network))
    network.compute_dtype = torch.bfloat16 if has_fast_bfloat16() else torch.float32
    say = functools.partial(print, flush=True)
    views, others = place.make_views(graph, robot, args.seed)
    facts = fit_places(network, views, others, graph.poses[:, :2],
                       minutes=shares[0] * args.minutes, say=say)
    until = time.monotonic() + 60 * shares[1] * args.minutes
    pictures, poses = views.draw(BANK)
    facts |= fit_routes(network, pictures, graph.pictures[list(graph.goal_nodes)],
                        place.regrets(graph, poses), until=until, say=say, seed=args.seed)
    if given is not None:
        _blend(network, own=1.0 if given.config.places else OWN)
    save_checkpoint(args.out / name, network, {
        **_info(args, robot, graph), 'frames': 0, 'seed': args.seed,
        'minutes': sum(shares) * args.minutes, 'results': {'places': facts}})
    return args.out / name


@torch.no_grad()
def _blend(network: Policy, own: float) -> None:
    """Weigh what a policy thinks, which one that was taught before has weighed, and the advice."""
    for layer, share in ((network.actor, own), (network.routes.advise, ADVISED)):
        for part in layer.parameters():
            part *= share


def _widened(given: dict[str, torch.Tensor], network: Policy) -> dict[str, torch.Tensor]:
    """Weights of a policy, for one whose memory is told of places as well: not yet listened to."""
    own = network.state_dict()
    for name, tensor in own.items():
        if name not in given or name.startswith(('places.', 'routes.')):  # of another place
            given[name] = tensor
        elif given[name].shape != tensor.shape:  # the inputs of the memory
            wide = torch.zeros_like(tensor)
            wide[:, :given[name].shape[1]] = given[name]
            given[name] = wide
    return {name: given[name] for name in own}


def _info(args: argparse.Namespace, robot: RobotSpec, graph) -> dict:
    return {
        'camera_fov_deg': math.degrees(robot.camera_fov), 'camera_height': robot.camera_height,
        'world_version': graph.world_version, 'preset': PRESET, 'stop_threshold': None,
        'command': 'vn_nav ' + shlex.join(word for word in sys.argv[1:] if word != '--resume'),
        'notes': f'Taught in the pictures of {args.bag.name}: {"; ".join(graph.words)}.'}


def _evaluate(args: argparse.Namespace, place: Place, folder: Path,
              given: LoadedCheckpoint | None, robot: RobotSpec, graphs: dict) -> None:
    """Measure the policy in the place, print, and write figures, page and checkpoint."""
    taught = load_checkpoint(folder)
    threshold = (given.info['stop_threshold'] if given else None) or evaluator.STOP_THRESHOLD
    result = {
        'checkpoint': str(folder), 'bag': args.bag.name,
        'world_version': taught.info['world_version'], 'task': 'image',
        'decoding': 'sample', 'seed': EVALUATION_SEED,
        'max_decisions': ENVIRONMENT[PRESET]['max_decisions'],
        'date': datetime.date.today().isoformat(), 'splits': {}}
    measured, plans = {}, {}
    for name, graph in graphs.items():
        if graph is None:
            continue
        measured[name] = _measure(args, place, graph, robot, taught.network, CONTROLS, threshold)
        if given is not None:
            for stop, rows in _measure(args, place, graph, robot, given.network, (),
                                       threshold).items():
                measured[name][stop][BEFORE], = rows.values()
        plans[name] = {graph.seed: graph.floor_plan()}
        result['splits'][name] = {
            'houses': [graph.seed], 'rows': evaluator.figures(measured[name]),
            'scenes': {str(graph.seed): evaluator.figures(measured[name])}}
        tables.print_rows(result['splits'][name]['rows'], f'{args.out}, {tables.SPLITS[name]}')
    info = {key: value for key, value in taught.info.items() if key != 'sha256'}
    info['results'] = {
        f'{name}: {stop}, {row}': figures for name, split in result['splits'].items()
        for stop, own in split['rows'].items() for row, figures in own.items()}
    if 'arrival' in taught.config.heads:
        info['stop_threshold'] = threshold
    save_checkpoint(folder, taught.network, info)
    write_file(args.out / 'evaluation.json', json.dumps(result, indent=2).encode())
    write_file(args.out / 'evaluation.html', evaluation_page(result, measured, plans).encode())


def _measure(args: argparse.Namespace, place: Place, graph, robot: RobotSpec, network: Policy,
             controls, threshold: float) -> evaluator.Rows:
    def make(_, envs: int, stop: str):
        return place.make_env(graph, robot, envs, stop=stop, light=True,
                              max_decisions=ENVIRONMENT[PRESET]['max_decisions'])
    return evaluator.measure(make, network, [graph.seed], decoding='sample',
                             episodes=args.episodes, controls=controls, threshold=threshold,
                             seed=EVALUATION_SEED, robot=robot)

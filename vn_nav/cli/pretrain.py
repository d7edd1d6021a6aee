"""`vn_nav pretrain`: its options, and how bags and a network come together."""

from __future__ import annotations

import argparse
import dataclasses
import math
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path

import torch

from vn_nav.bags.dataset import DriveSet, Wanted, load_drives
from vn_nav.bags.drive import RECORDED
from vn_nav.bags.mapping.recorded_place import scene_of
from vn_nav.bags.roles import Topics, load_topics
from vn_nav.cli.train import CHANGES, train_config
from vn_nav.errors import UserError
from vn_nav.learning.hindsight import Drives, Split, rows_of, split
from vn_nav.learning.presets import PRESETS, TrainConfig
from vn_nav.learning.pretrain import PretrainConfig, choose_parts, pretrain
from vn_nav.learning.supervised import PARTS
from vn_nav.learning.trainer import has_fast_bfloat16
from vn_nav.policy.checkpoint import LoadedCheckpoint, load_checkpoint
from vn_nav.policy.network import NetworkConfig, Policy
from vn_nav.robot import DRIVE_ACTIONS, RobotSpec, load_robot

RANDOM_POSES = 'random'  # the entry `poses` of the topic scene in bags of `vn_nav collect`


def add_pretrain_options(parser: argparse.ArgumentParser) -> None:
    """Options of `vn_nav pretrain`."""
    numbers = PretrainConfig()
    parser.add_argument('bags', type=Path, nargs='+', metavar='BAG',
                        help='rosbag2 folders or MCAP files')
    parser.add_argument('--out', type=Path, required=True, help='folder of the run')
    parser.add_argument('--resume', action='store_true', help='go on with the run in --out')
    parser.add_argument('--init', type=Path, metavar='CHECKPOINT',
                        help='begin with its weights; network, size and actions are its own')
    parser.add_argument('--preset', choices=tuple(PRESETS),
                        help='whose network; default: of --init, or fast')
    parser.add_argument('--size', type=int, help='side of the pictures [pixels]; default 84')
    parser.add_argument('--actions', help="names from the robot's table, with commas between; "
                        f'default {",".join(DRIVE_ACTIONS)}')
    parser.add_argument('--set', action='append', default=[], metavar='NAME=VALUE',
                        help='any other number of vn_nav.learning.presets.TrainConfig that makes '
                        'the network, such as hidden=128: give the same to vn_nav train')
    parser.add_argument('--epochs', type=int, default=numbers.epochs, help='passes over the bags')
    parser.add_argument('--batch', type=int, default=numbers.batch, help='pictures in a step')
    parser.add_argument('--learning-rate', type=float, default=numbers.learning_rate,
                        help='of Adam, at the start; falls to a twentieth')
    parser.add_argument('--heads', default='auto', metavar='NAMES', help='auto (what the bags '
                        'have the keys for, and what the preset has of the others), none, or '
                        f'some of {", ".join(name for name in PARTS if name != "cloning")}')
    parser.add_argument('--cloning', action=argparse.BooleanOptionalAction,
                        help='imitate the actions driven, towards pictures taken later; default: '
                        'if the bags have some')
    parser.add_argument('--topics', type=Path, metavar='YAML', help='names of the topics')
    parser.add_argument('--robot', type=Path, metavar='YAML',
                        help='that drove; default: the standard robot')
    parser.add_argument('--cache', type=Path, metavar='DIR',
                        help='of decoded bags; default: OUT/decoded')
    parser.add_argument('--seed', type=int, default=0)
    parser.add_argument('--threads', type=int, default=1, help='of torch')
    parser.add_argument('--device', default='cpu', help='cpu, or a GPU such as cuda:0')


def run_pretrain(args: argparse.Namespace) -> int:
    """`vn_nav pretrain`.

    Raises:
        UserError: options, bags or a checkpoint that do not fit.
    """
    numbers = PretrainConfig(epochs=args.epochs, batch=args.batch, seed=args.seed,
                             learning_rate=args.learning_rate)
    given = load_checkpoint(args.init) if args.init else None
    train = _train_config(args, given)
    robot, network = _robot_and_network(args, given, train)
    topics = load_topics(args.topics) if args.topics else Topics()
    asked = None if args.heads == 'auto' else tuple(
        name for name in args.heads.split(',') if name != 'none')
    drives, worlds = load_bags(args.bags, robot, network.size, topics,
                               args.cache or args.out / 'decoded')
    parts, words = choose_parts(drives, asked, network.heads, args.cloning)
    told = split(drives, numbers.validation_share, numbers.seed)
    for line in (*words, told.words, f'learns {", ".join(parts).replace("_", " ")}'):
        print(line, flush=True)
    torch.set_num_threads(train.threads)
    policy = _policy(network, parts, given, args.seed).to(train.device)
    policy.compute_dtype = (torch.bfloat16 if has_fast_bfloat16() or train.device != 'cpu'
                            else torch.float32)
    info = {
        'world_version': worlds.pop() if len(worlds) == 1 else RECORDED,
        'camera_fov_deg': math.degrees(robot.camera_fov), 'camera_height': robot.camera_height,
        'preset': train.preset,
        'command': 'vn_nav ' + shlex.join(word for word in sys.argv[1:] if word != '--resume'),
        'data': _data(args.bags, drives, told, args.init),
        'notes': f'Pre-trained on {len(drives):,} steps of {len(args.bags)} bag'
                 f'{"s" * (len(args.bags) > 1)}: {", ".join(parts).replace("_", " ")}; '
                 f'{told.words}. Losses and figures are of these recorded steps, not of driving; '
                 'a guess without pictures says the most frequent action and the mean pose of the '
                 'steps that were learned from.'}
    for line in _legend(parts):
        print(line, flush=True)
    print(pretrain(policy, drives, parts, told, args.out, numbers, info=info, resume=args.resume,
                   on_epoch=_print_row))
    return 0


def _data(bags: Sequence[Path], drives: Drives, told: Split, init: Path | None) -> str:
    """Where the pictures came from, and how many."""
    held = sum(part.facts['pictures'] for part in drives.sets)
    begun = f'; begun with the weights of {init}' if init else ''
    return (f'{held:,} recorded pictures of {", ".join(bag.name for bag in bags)}: '
            f'{len(rows_of(told.train)):,} steps to learn from, {len(rows_of(told.validation)):,} '
            f'others to judge by{begun}')


def _legend(parts: Sequence[str]) -> list[str]:
    """What the columns of an epoch mean, those that there are."""
    lines = ['a line an epoch, 0 is before learning: figures while learning (on the validation; '
             'of a guess without pictures)',
             '  loss: the weighted sum of the losses behind it; less is better']
    if 'cloning' in parts:
        lines.append('  right actions: share of the steps where the likeliest action is the one '
                     'that was driven; the guess: always the most frequent one')
    if 'goal_pose' in parts:
        lines.append('  bearing off by deg: median error of the direction to the goal, of pairs '
                     'that show the same; the guess: the mean pose')
    return lines


def load_bags(bags: Sequence[Path], robot: RobotSpec, size: int, topics: Topics, cache: Path
              ) -> tuple[Drives, set[str]]:
    """Decode bags (see `load_drives`), and say what each of them holds.

    Returns:
        The drives, and the world versions of their pictures.

    Raises:
        UserError: a bag that cannot be used.
    """
    sets, worlds = [], set()
    for bag in bags:
        scene = scene_of(bag)
        wanted = Wanted(robot, size, topics, every=scene.get('poses') == RANDOM_POSES)
        sets.append(load_drives(bag, wanted, cache))
        worlds.add(str(scene.get('world_version', RECORDED)))
        print(_describe(bag, sets[-1], wanted), flush=True)
        for note in sets[-1].facts['notes']:
            print(f'{bag}: {note}', flush=True)
    return Drives(sets, robot), worlds


def _train_config(args: argparse.Namespace, given: LoadedCheckpoint | None) -> TrainConfig:
    """The numbers of a preset, for its network."""
    preset = args.preset or (given.info['preset'] if given else '') or 'fast'
    blank = dict.fromkeys(CHANGES)
    train = train_config(argparse.Namespace(**blank | {
        'preset': preset, 'set': args.set, 'seed': args.seed, 'no_tensorboard': True,
        'threads': args.threads, 'device': args.device}))
    if train.architecture == 'icra2017':
        raise UserError('an encoder that learns is pre-trained',
                        'the architecture icra2017, whose encoder is frozen',
                        'choose another --preset')
    if train.device != 'cpu' and not torch.cuda.is_available():
        raise UserError('the device is a GPU that torch finds', train.device, 'use --device cpu')
    return train


def _robot_and_network(args: argparse.Namespace, given: LoadedCheckpoint | None,
                       train: TrainConfig) -> tuple[RobotSpec, NetworkConfig]:
    """The robot with the actions of the policy, and the policy's network."""
    robot = load_robot(args.robot) if args.robot else RobotSpec()
    actions = tuple(args.actions.split(',')) if args.actions else None
    if given is None:
        robot = robot.with_actions(actions or DRIVE_ACTIONS)
        return robot, train.network(robot.action_names, args.size or 84, robot.moves)
    network = given.config
    for option, asked, own in (('--actions', actions, network.actions),
                               ('--size', args.size, network.size)):
        if asked is not None and asked != own:
            raise UserError(f'{option} is that of the checkpoint of --init: {own}', asked,
                            f'leave {option} out, or --init')
    if network.architecture == 'icra2017':
        raise UserError('an encoder that learns is pre-trained', f'{args.init}, whose encoder is '
                        'frozen', 'choose another --init')
    return robot.with_actions(network.actions, network.moves), network


def _policy(network: NetworkConfig, parts: Sequence[str], given: LoadedCheckpoint | None,
            seed: int) -> Policy:
    """The network with a head for each part; with a checkpoint's weights, where it has them."""
    heads = [part for part in parts if part != 'cloning' and part not in network.heads]
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        policy = Policy(dataclasses.replace(network, heads=(*network.heads, *heads)))
    if given is not None:
        policy.load_state_dict(policy.state_dict() | given.network.state_dict())
    return policy


def _describe(bag: Path, drives: DriveSet, wanted: Wanted) -> str:
    facts = drives.facts
    words = (f'{bag}: {len(drives):,} steps of {facts["pictures"]:,} pictures in '
             f'{facts["episodes"]:,} episodes')
    if wanted.every:
        return f'{words}; from random poses, so without actions'
    done = ', '.join(f'{name} {count:,}' for name, count in facts['actions'].items()) or 'none'
    return f'{words}; actions: {done}; {facts["misfit_share"]:.0%} of the motions fit none'


def _print_row(row: dict) -> None:
    """An epoch in a line: what was learned, in training and (in brackets) on the validation.

    Behind the validation's figure that of a guess, where there is one; see `_legend`.
    """
    def both(name: str, form: str) -> str:
        own = '' if math.isnan(row[name]) else format(row[name], form) + ' '  # before it learns
        guess = row.get(f'baseline_{name}', math.nan)
        guess = '' if math.isnan(guess) else f'; {guess:{form}}'
        return f'{own}({format(row[f"validation_{name}"], form)}{guess})'
    words = [f'epoch {row["epoch"]} · {row["minutes"]:.1f} min', f'loss {both("loss", ".3f")}']
    words += [f'{part.replace("_", " ")} {both(f"{part}_loss", ".3f")}' for part in PARTS
              if not math.isnan(row[f'validation_{part}_loss'])]
    for name, label, form in (('action_accuracy', 'right actions', '.0%'),
                              ('bearing_deg', 'bearing off by deg', '.0f')):
        if not math.isnan(row[f'validation_{name}']):
            words.append(f'{label} {both(name, form)}')
    print(' · '.join(words), flush=True)

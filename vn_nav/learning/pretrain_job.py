"""`pretrain`: from recorded bags and a few choices to a pre-trained policy.

The algorithm is `vn_nav.learning.pretraining`; here bags and a network come together.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch

from vn_nav.bags.dataset import DriveSet, Wanted
from vn_nav.bags.drive import RECORDED
from vn_nav.bags.drive_cache import load_drives
from vn_nav.bags.mapping.recorded_place import scene_of
from vn_nav.bags.roles import Topics
from vn_nav.errors import UserError
from vn_nav.labels import CLASSES
from vn_nav.learning.hindsight import Drives, Split, rows_of, split
from vn_nav.learning.precision import fast_dtype
from vn_nav.learning.presets import TrainConfig, check_not_search, preset
from vn_nav.learning.pretrain_config import PretrainConfig, choose_parts
from vn_nav.learning.pretraining import pretrain_network
from vn_nav.learning.supervised import PARTS
from vn_nav.learning.transfer import SEGMENTATIONS, initial_weights
from vn_nav.policy.checkpoint import LoadedCheckpoint, load_checkpoint
from vn_nav.policy.network import Policy
from vn_nav.policy.network_config import NetworkConfig
from vn_nav.robot import DRIVE_ACTIONS, RobotSpec

RANDOM_POSES = 'random'  # the entry `poses` of the topic scene in bags of `vn_nav collect`
DEFAULT_SIZE_PX = 84  # pixels a side of the pictures, by default


@dataclasses.dataclass(frozen=True)
class PretrainJob:
    """What a policy is pre-trained on, and how.

    Raises:
        UserError: no bag.
    """

    bags: Sequence[str | Path]  # rosbag2 folders or MCAP files, one or more
    out: str | Path  # folder of the run
    init: str | Path | None = None  # begin with this checkpoint: network, size, actions are its
    preset: str | None = None  # whose network; None: of `init`, or fast
    # Other numbers of `TrainConfig` that make the network, by name: give the same to a training.
    changes: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    size: int | None = None  # side of the pictures [pixels]; None: of `init`, or 84
    actions: tuple[str, ...] | None = None  # of the robot's table; None: of `init`, or to drive
    # None: what the bags have the keys for, and what the preset has of the others.
    heads: tuple[str, ...] | None = None
    cloning: bool | None = None  # imitate the actions driven; None: if the bags have some
    robot: RobotSpec = RobotSpec()  # that drove
    topics: Topics = Topics()  # names in the bags
    cache: str | Path | None = None  # folder of decoded bags; None: `decoded` in that of the run
    threads: int = 1  # of torch
    device: str = 'cpu'  # or a GPU such as cuda:0
    resume: bool = False  # go on with the run in `out`
    numbers: PretrainConfig = PretrainConfig()
    command: str = ''  # that the checkpoint shall name

    def __post_init__(self):
        bags = (self.bags,) if isinstance(self.bags, (str, Path)) else self.bags
        object.__setattr__(self, 'bags', tuple(map(Path, bags)))
        if not self.bags:
            raise UserError('there is a bag to learn from', self.bags, 'name one')


def print_line(line: str) -> None:
    """Progress for people, as it comes."""
    print(line, flush=True)


def pretrain(job: PretrainJob, *, say: Callable[[str], None] = print_line) -> Path:
    """Pre-train a policy on recorded bags.

    Args:
        job: bags, folder and numbers.
        say: called with each line of progress.

    Returns:
        The folder of the checkpoint.

    Raises:
        UserError: options, bags or a checkpoint that do not fit; see `pretrain_network` as well.
    """
    numbers, out, bags = job.numbers, Path(job.out), [*map(Path, job.bags)]
    given = load_checkpoint(job.init) if job.init else None
    train = _train_config(job, given)
    robot, network = _robot_and_network(job, given, train)
    drives, worlds = load_bags(bags, robot, network.size, job.topics,
                               Path(job.cache or out / 'decoded'), say)
    parts, notes = choose_parts(drives, job.heads, network.heads, job.cloning)
    divided = split(drives, numbers.validation_share, numbers.seed)
    for line in (*notes, divided.summary, f'learns {", ".join(parts).replace("_", " ")}'):
        say(line)
    torch.set_num_threads(train.threads)
    names: tuple[str, ...] = () if given is None else tuple(given.info['label_names'])
    if set(parts) & set(SEGMENTATIONS):
        names = drives.label_names
        network = dataclasses.replace(network, classes=max(CLASSES, drives.classes))
    policy, notes = _policy(network, parts, job.init, numbers.seed, names)
    for line in notes:
        say(f'{job.init}: {line}')
    policy.to(train.device)
    policy.compute_dtype = fast_dtype(train.device)
    info = {
        'world_version': worlds.pop() if len(worlds) == 1 else RECORDED,
        'camera_fov_deg': math.degrees(robot.camera_fov), 'camera_height': robot.camera_height,
        'preset': train.preset, 'command': job.command, 'label_names': list(names),
        'data': _data(bags, drives, divided, Path(job.init) if job.init else None),
        'notes': f'Pre-trained on {len(drives):,} steps of {len(job.bags)} bag'
                 f'{"s" * (len(job.bags) > 1)}: {", ".join(parts).replace("_", " ")}; '
                 f'{divided.summary}. Losses and figures are of these recorded steps, not of '
                 'driving; a guess without pictures says the most frequent action and the mean '
                 'pose of the steps that were learned from.'}
    for line in _legend(parts):
        say(line)
    return pretrain_network(policy, drives, parts, divided, out, numbers, info=info,
                            resume=job.resume, on_epoch=lambda row: say(_epoch_line(row)))


def load_bags(bags: Sequence[Path], robot: RobotSpec, size: int, topics: Topics,
              cache: Path, say: Callable[[str], None]) -> tuple[Drives, set[str]]:
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
        say(_describe(bag, sets[-1], wanted))
        for note in sets[-1].facts['notes']:
            say(f'{bag}: {note}')
    return Drives(sets, robot), worlds


def _train_config(job: PretrainJob, given: LoadedCheckpoint | None) -> TrainConfig:
    """The numbers of a preset, for its network."""
    name = job.preset or (given.info['preset'] if given else '') or 'fast'
    train = preset(name, **{'seed': job.numbers.seed, 'threads': job.threads,
                            'device': job.device, **job.changes})
    check_not_search(train.architecture, f'the preset {name}')
    if train.architecture == 'icra2017':
        raise UserError('an encoder that learns is pre-trained',
                        'the architecture icra2017, whose encoder is frozen',
                        'choose another --preset')
    if train.device != 'cpu' and not torch.cuda.is_available():
        raise UserError('the device is a GPU that torch finds', train.device, 'use --device cpu')
    return train


def _robot_and_network(job: PretrainJob, given: LoadedCheckpoint | None,
                       train: TrainConfig) -> tuple[RobotSpec, NetworkConfig]:
    """The robot with the actions of the policy, and the policy's network."""
    robot, actions = job.robot, job.actions
    if given is None:
        robot = robot.with_actions(actions or DRIVE_ACTIONS)
        return robot, train.network(robot.action_names, job.size or DEFAULT_SIZE_PX, robot.moves)
    network = given.config
    for option, asked, own in (('--actions', actions, network.actions),
                               ('--size', job.size, network.size)):
        if asked is not None and asked != own:
            raise UserError(f'{option} is that of the checkpoint of --init: {own}', asked,
                            f'leave {option} out, or --init')
    check_not_search(network.architecture, job.init)
    if network.architecture == 'icra2017':
        raise UserError('an encoder that learns is pre-trained', f'{job.init}, whose encoder is '
                        'frozen', 'choose another --init')
    return robot.with_actions(network.actions, network.moves), network


def _policy(network: NetworkConfig, parts: Sequence[str], init: str | Path | None, seed: int,
            label_names: Sequence[str]) -> tuple[Policy, list[str]]:
    """The network with a head for each part; with a checkpoint's weights, where it has them.

    And what it has not, in words.
    """
    heads = [part for part in parts if part != 'cloning' and part not in network.heads]
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        policy = Policy(dataclasses.replace(network, heads=(*network.heads, *heads)))
    if init is None:
        return policy, []
    start = initial_weights(init, policy, label_names)
    policy.load_state_dict(start.weights)
    return policy, start.words


def _data(bags: Sequence[Path], drives: Drives, divided: Split, init: Path | None) -> str:
    """Where the pictures came from, and how many."""
    held = sum(part.facts['pictures'] for part in drives.sets)
    begun = f'; begun with the weights of {init}' if init else ''
    return (f'{held:,} recorded pictures of {", ".join(bag.name for bag in bags)}: '
            f'{len(rows_of(divided.train)):,} steps to learn from, '
            f'{len(rows_of(divided.validation)):,} others to judge by{begun}')


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


def _describe(bag: Path, drives: DriveSet, wanted: Wanted) -> str:
    facts = drives.facts
    summary = (f'{bag}: {len(drives):,} steps of {facts["pictures"]:,} pictures in '
               f'{facts["episodes"]:,} episodes')
    if wanted.every:
        return f'{summary}; from random poses, so without actions'
    done = ', '.join(f'{name} {count:,}' for name, count in facts['actions'].items()) or 'none'
    return f'{summary}; actions: {done}; {facts["misfit_share"]:.0%} of the motions fit none'


def _epoch_line(row: dict) -> str:
    """An epoch in a line: what was learned, in training and (in brackets) on the validation.

    Behind the validation's figure that of a guess, where there is one; see `_legend`.
    """
    def both(name: str, form: str) -> str:
        own = '' if math.isnan(row[name]) else format(row[name], form) + ' '  # before it learns
        guess = row.get(f'baseline_{name}', math.nan)
        guess = '' if math.isnan(guess) else f'; {guess:{form}}'
        return f'{own}({format(row[f"validation_{name}"], form)}{guess})'
    figures = [f'epoch {row["epoch"]} · {row["minutes"]:.1f} min', f'loss {both("loss", ".3f")}']
    figures += [f'{part.replace("_", " ")} {both(f"{part}_loss", ".3f")}' for part in PARTS
                if not math.isnan(row[f'validation_{part}_loss'])]
    for name, label, form in (('action_accuracy', 'right actions', '.0%'),
                              ('bearing_deg', 'bearing off by deg', '.0f')):
        if not math.isnan(row[f'validation_{name}']):
            figures.append(f'{label} {both(name, form)}')
    return ' · '.join(figures)

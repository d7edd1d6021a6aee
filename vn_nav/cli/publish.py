"""`vn_nav publish`: a run's checkpoint, measured and rounded, as one to ship."""

from __future__ import annotations

import argparse
import dataclasses
import datetime
import os
import re
import tempfile
from collections.abc import Sequence
from pathlib import Path

from vn_nav.cli.scenes import SPLIT_SCENES, UNSEEN_GOALS, checkpoint_scenes, split_scenes
from vn_nav.cli.world import load_for_scenes, long_rows, machine, make_env_for
from vn_nav.errors import UserError
from vn_nav.evaluation import evaluator
from vn_nav.evaluation.measurement import EvaluateConfig, measure_checkpoint, odometry_for
from vn_nav.policy.checkpoint import LoadedCheckpoint, load_checkpoint, save_checkpoint
from vn_nav.policy.network_config import SEARCH
from vn_nav.report import tables
from vn_nav.robot import load_robot
from vn_nav.scenes import HOUSE, house_scene, parse_scene, rooms_of, scene_name

STOP_THRESHOLDS = (0.3, 0.5, 0.7, 0.85, 0.95)  # that are tried
SEARCH_THRESHOLDS = (0.8, 0.9, 0.95)  # the same of a policy that searches
THRESHOLD_SEED = 20_000  # of starts that no figure is from
NOISE = {'all': 'motion noise on', 'moves': 'motion noise along moves alone',
         'none': 'no motion noise'}  # by the name of `MOTION_NOISE`
# What an earlier publication said of its figures.
MEASURED = re.compile(r' ?Measured with `vn_nav publish`.*?docs/architecture\.md\.', re.DOTALL)


@dataclasses.dataclass(frozen=True)
class _Place:
    """Scenes that a policy is measured in, and the goals that it is shown there."""

    scenes: Sequence[str]
    goal_seed: int = 0


def add_options(parser: argparse.ArgumentParser) -> None:
    """Options of `vn_nav publish`."""
    parser.add_argument('source', type=Path, help='checkpoint of a training run')
    parser.add_argument('target', type=Path, help='for example models/house')
    parser.add_argument('--unseen', metavar='SCENE', help='measure in the scenes that it was '
                        'trained in, and in this one, held out: the name of a scene, or the seed '
                        'of a house')
    parser.add_argument('--split', action='append', metavar='NAME', help='measure in the scenes '
                        'of this split instead, as `vn_nav evaluate` does; may be given several '
                        'times')
    parser.add_argument('--houses', type=int, metavar='N', help='the first N scenes of each split '
                        '(default: all of its own, '
                        f'{SPLIT_SCENES} others), and N to choose the stop threshold in')
    parser.add_argument('--episodes', type=int, default=100,
                        help='of a row at least; the same number in each scene')
    threshold = parser.add_mutually_exclusive_group()
    threshold.add_argument('--stop-threshold', type=float, metavar='P', help='probability above '
                           'which it declares its stop (default: the best of a few, on starts '
                           'that no figure is from)')
    threshold.add_argument('--keep-threshold', action='store_true', help="the checkpoint's own")
    parser.add_argument('--notes', metavar='TEXT', help='of the training, for the card (default: '
                        "the checkpoint's)")
    parser.add_argument('--robot', type=Path, metavar='YAML', help='that it was trained for')


def run(args: argparse.Namespace) -> int:
    """`vn_nav publish`."""
    checkpoint, _ = load_for_scenes(args.source, args.robot)
    info = {key: value for key, value in checkpoint.info.items() if key != 'sha256'}
    places = _places(args, info)
    _check(args, checkpoint)
    searches = checkpoint.config.architecture == SEARCH
    if searches:  # it draws no lots
        info['decoding'] = 'greedy'
    with tempfile.TemporaryDirectory() as folder:  # measure what ships: the rounded weights
        save_checkpoint(Path(folder) / 'rounded', checkpoint.network, info, half=True)
        shipped = load_checkpoint(Path(folder) / 'rounded')
    chosen = ''
    if shipped.config.declares:
        info['stop_threshold'], chosen = _stop_threshold(shipped, places, args)
        shipped.info['stop_threshold'] = info['stop_threshold']
    # What the training itself measured, of pairs of pictures, stays; episodes are driven anew.
    info['results'] = {name: row for name, row in info['results'].items()
                       if searches and isinstance(row, dict) and 'episodes' not in row}
    counts = set()
    for name, place in places.items():
        results = evaluator.figures(_measure(shipped, place, args))
        tables.print_rows(results, name)
        for stop, rows in results.items():
            declared = '' if stop == evaluator.ARRIVAL else 'declared stop, '
            info['results'] |= {f'{name}: {declared}{row}': figures
                                for row, figures in rows.items()}
            counts |= {figures['episodes'] for figures in rows.values()}
    info['notes'] = _notes(info['notes'] if args.notes is None else args.notes,
                           sorted(counts), odometry_for(shipped.network), info['motion_noise'],
                           chosen)
    save_checkpoint(args.target, shipped.network, info, half=True)
    return 0


def _places(args: argparse.Namespace, info: dict) -> dict[str, _Place]:
    """The places that figures are from, by the name that the card gives them.

    Raises:
        UserError: no place, or one that the policy has no figures of.
    """
    if (args.unseen is None) == (args.split is None):
        raise UserError('a policy is measured in a scene that is held out, or in splits',
                        'neither' if args.unseen is None else '--unseen and --split',
                        'give one of --unseen and --split')
    if args.houses is not None and (args.split is None or args.houses < 1):
        raise UserError('a split has at least one scene', f'--houses {args.houses}' + (
            '' if args.split else ' without --split'), 'give --split, and one house or more')
    kind = 'house' if info['simulator'] == HOUSE else 'scene'
    if args.split:
        found = {}
        for split in args.split:
            scenes = checkpoint_scenes(info, split, args.houses)
            name = f'{len(scenes)} {kind}{"s" * (len(scenes) > 1)}, {tables.SPLITS[split].lower()}'
            found[name] = _Place(scenes, UNSEEN_GOALS if split == 'unseen_goals' else 0)
        return found
    if not info['scenes']:
        raise UserError('a policy is published with figures of the scenes that it was trained in',
                        'a checkpoint that names none', 'train it in a simulator, or give --split')
    unseen = held_out(args.unseen, info)
    named = parse_scene(unseen).place if info['simulator'] == HOUSE else unseen
    return {f'trained {kind}': _Place(info['scenes']),
            f'unseen {kind} {named}': _Place([unseen])}


def _check(args: argparse.Namespace, checkpoint: LoadedCheckpoint) -> None:
    """Refuse before hours of work what would fail in them.

    Raises:
        UserError: a threshold of a policy that declares nothing, or out of range; no episode; no
            folder to write into.
    """
    EvaluateConfig(episodes=args.episodes, stop_threshold=args.stop_threshold)
    folder = next(folder for folder in args.target.absolute().parents if folder.exists())
    if not (folder.is_dir() and os.access(folder, os.W_OK)):
        raise UserError('a checkpoint is written into a folder that may be written', str(folder),
                        'choose another one')
    given = args.keep_threshold or args.stop_threshold is not None
    if given and not checkpoint.config.declares:
        raise UserError('a policy that declares its stop has the head arrival, or searches',
                        'another one with a stop threshold', 'leave it out')
    if args.keep_threshold and checkpoint.info['stop_threshold'] is None:
        raise UserError('a threshold that is kept stands in the checkpoint', 'none',
                        'leave out --keep-threshold, or give --stop-threshold')


def held_out(text: str, info: dict) -> str:
    """The scene that is held out.

    Raises:
        UserError: no scene of the policy's simulator, or one that it was trained in.
    """
    seed = re.fullmatch(r'\d{1,18}', text) and info['simulator'] == HOUSE
    unseen = (house_scene(int(text), rooms_of(info['scenes'][0])) if seed else scene_name(text))
    if parse_scene(unseen).simulator != info['simulator'] or unseen in info['scenes']:
        raise UserError(f'the scene held out is one of {info["simulator"]} that the policy was '
                        'not trained in', text, 'name another one with --unseen')
    return unseen


def _measure(checkpoint: LoadedCheckpoint, place: _Place, args: argparse.Namespace,
             **changes) -> evaluator.Rows:
    """Episodes of a checkpoint in some scenes."""
    own = set(place.scenes) <= set(checkpoint.info['scenes'])

    def make(names, environments: int, stop: str):
        return make_env_for(checkpoint, names, environments, stop=stop, robot=args.robot, own=own,
                            goal_seed=place.goal_seed)
    config = EvaluateConfig(episodes=args.episodes, **changes,
                            robot=load_robot(args.robot) if args.robot else None)
    return measure_checkpoint(checkpoint, place.scenes, make, config, long_rows())


def _stop_threshold(checkpoint: LoadedCheckpoint, places: dict[str, _Place],
                    args: argparse.Namespace) -> tuple[float, str]:
    """The probability of arrival that is best declared at, and how it was chosen, for the card."""
    if args.stop_threshold is not None:
        return args.stop_threshold, ''
    if args.keep_threshold:
        return checkpoint.info['stop_threshold'], ''
    searches = checkpoint.config.architecture == SEARCH
    scenes = threshold_scenes(
        checkpoint.info, [scene for place in places.values() for scene in place.scenes],
        SPLIT_SCENES if args.houses is None else args.houses,
        others=searches or args.split is not None)
    tried = SEARCH_THRESHOLDS if searches else STOP_THRESHOLDS
    found: dict[float, tuple[float, float]] = {}
    for threshold in tried:
        rows = _measure(checkpoint, _Place(scenes), args, seed=THRESHOLD_SEED, controls=(),
                        stops=(evaluator.DECLARED,), stop_threshold=threshold)
        (row,) = evaluator.figures(rows)[evaluator.DECLARED].values()
        found[threshold] = row['success'], -row['false_stops']
        print(f'declaring above {threshold:.0%}: success {row["success"]:.2f}, false stops '
              f'{row["false_stops"]:.2f}', flush=True)
    best = max(found, key=found.__getitem__)
    where = ('that it was trained in' if set(scenes) <= set(checkpoint.info['scenes']) else
             'of the training split that it was not trained in')
    numbers = ', '.join(f'{threshold:g}: {success:.2f}' for threshold, (success, _) in
                        found.items())
    return best, (f'It declares its stop above a probability of {best:g}, chosen on other starts '
                  f'in {len(scenes)} scene{"s" * (len(scenes) > 1)} {where} (success above '
                  f'{numbers}). ')


def threshold_scenes(info: dict, measured: Sequence[str], count: int, *, others: bool
                     ) -> list[str]:
    """Scenes to choose the stop threshold in.

    Args:
        info: of the checkpoint.
        measured: scenes that figures are from: none of them, as far as there are others.
        count: at most so many.
        others: of the training split, but not trained in, where the simulator has such ones;
            else those of the training itself.
    """
    from vn_sim_bridge.simulators import simulator_class
    if others and 'train' in simulator_class(info['simulator']).splits:
        rooms = (rooms_of(info['scenes'][0]) if info['scenes'] and info['simulator'] == HOUSE
                 else None)
        taken = {*info['scenes'], *measured}
        found = [scene for scene in split_scenes(info['simulator'], 'train', None, rooms)
                 if scene not in taken]
        if found:
            return found[:count]
    return list(info['scenes'] or measured)[:count]


def _notes(training: str, counts: Sequence[int], odometry: str, noise: str, chosen: str) -> str:
    """What the card says of the training, and of how its figures were measured."""
    episodes = ' to '.join(map(str, dict.fromkeys([counts[0], counts[-1]])))
    given = '' if odometry == 'none' else f'odometry: {odometry}, '
    measured = (f'Measured with `vn_nav publish`, {episodes} episodes a row, 300 decisions at '
                f'most, {NOISE[noise]}, {given}on {machine()}, '
                f'{datetime.date.today().isoformat()}. {chosen}Figures are defined in '
                'docs/architecture.md.')
    return f'{MEASURED.sub("", training).strip()} {measured}'.strip()

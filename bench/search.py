"""The honest table of a policy: splits, controls, odometries, cameras, a row each.

    python bench/search.py models/search                                # everything: hours
    python bench/search.py models/search --rows validation low wide     # some rows
    python bench/search.py models/search --episodes 60 --print          # what there is so far

Every row is measured as `vn_nav evaluate` does, on the same starts, and kept as JSON in `--out`
as soon as it is finished: a second run goes on where the first one was ended, and measures again
what was measured of other weights, another planner or other numbers. Rows may be divided among
processes (`--rows`). Prints a Markdown table, ready for docs/results.md.

- **validation**, **test**, **unseen_look**: houses that no training saw; arrival, declared stop.
- **wrong**, **absent**, **blank**, **random**, **explorer**, **shortest**: the controls, in the
  houses of `--split`. Of a wrong picture (of another goal of the house) some stops are where that
  was taken; of an absent one (of another house) every stop is false.
- **rough**, **plain**: light, camera and base vary more, or not at all; **true**, **commanded**,
  **none**: odometry other than drifting; **scan**, **depth**: measured ranges for the map;
  **low**, **high**, **narrow**, **wide**: cameras 0.4 and 1.4 m high, fields of view of 70 and 110
  degrees (`bench/robots`), of a policy that was trained with another. All in the houses of
  `--split`, declared stop alone.
- **one_look**, **no_refuting**, **no_fitting**, **no_looking**, **no_squeezing**,
  **no_returning**: a part taken away. **truth**, **truth_scan**: where the goal is comes from the
  simulator, not from the picture; with the scan nothing that is seen decides any more. Declared
  stop alone.
"""

from __future__ import annotations

import argparse
import dataclasses
import datetime
import math
import sys
import time
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from vn_nav.cli.scenes import split_scenes
from vn_nav.cli.world import load_for, machine, make_env_for
from vn_nav.errors import UserError
from vn_nav.evaluation import evaluator
from vn_nav.evaluation.evaluator import ARRIVAL, DECLARED, STOPS
from vn_nav.evaluation.kept import conditions_of, finished, keep
from vn_nav.evaluation.measurement import (
    EvaluateConfig,
    measure_checkpoint,
    odometry_for,
    ranges_for,
)
from vn_nav.learning.auxiliary import POSE_OVERLAP
from vn_nav.policy.checkpoint import LoadedCheckpoint
from vn_nav.policy.search.look import Look
from vn_nav.policy.search.network import SearchPolicy
from vn_nav.policy.search.rules import Rules
from vn_nav.report import tables
from vn_nav.report.tables import number
from vn_nav.robot import load_robot
from vn_nav.scenes import rooms_of

TRUE_SIGMA, SURE = 0.05, 8.0  # m and rad; logit
ROBOTS = Path(__file__).resolve().parent / 'robots'


@dataclasses.dataclass(frozen=True)
class Row:
    """How one row is measured. None: as the policy was trained, or as the options say."""

    title: str
    split: str | None = None  # None: that of the option
    control: str | None = None  # None: the policy itself
    stops: tuple[str, ...] = (DECLARED,)
    randomisation: str | None = None
    odometry: str | None = None
    robot: str | None = None  # a file of `ROBOTS`
    ranges: str | None = None
    rules: Rules | None = None  # None: the usual ones
    truth: bool = False  # recognition is the simulator's


ROWS = {
    'validation': Row('validation houses', 'validation', stops=STOPS),
    'test': Row('test houses', 'test', stops=STOPS),
    'unseen_look': Row('unseen look', 'unseen_look', stops=STOPS),
    'wrong': Row('wrong goal (of the same house)', control=evaluator.WRONG, stops=STOPS),
    'absent': Row('absent goal (of another house)', control=evaluator.ABSENT),
    'blank': Row('blank goal', control=evaluator.BLANK, stops=STOPS),
    'random': Row('random actions', control=evaluator.RANDOM, stops=STOPS),
    'explorer': Row('explorer (true depth, true co-visibility)', control=evaluator.EXPLORER,
                    stops=STOPS),
    'shortest': Row('shortest path', control=evaluator.SHORTEST, stops=STOPS),
    'rough': Row('`rough` randomisation', randomisation='rough'),
    'plain': Row('no randomisation', randomisation='none'),
    'true': Row('odometry: true', odometry='true'),
    'commanded': Row('odometry: commanded', odometry='commanded'),
    'none': Row('odometry: none', odometry='none'),
    'scan': Row('map by a LaserScan', ranges='scan'),
    'depth': Row('map by a depth camera', ranges='depth'),
    'low': Row('camera 0.4 m high', robot='low'),
    'high': Row('camera 1.4 m high', robot='high'),
    'narrow': Row('field of view 70 deg', robot='narrow'),
    'wide': Row('field of view 110 deg', robot='wide'),
    'one_look': Row('evidence of the newest look alone', rules=Rules(gathers=False)),
    'no_refuting': Row('no evidence is lost', rules=Rules(refutes=False)),
    'no_fitting': Row('the goal is not fitted to the map', rules=Rules(registers=False)),
    'no_looking': Row('no turns to look', rules=Rules(look_from=math.inf)),
    'no_squeezing': Row('a stuck robot goes on as before', rules=Rules(unsticks=False)),
    'no_returning': Row('it explores to the end of its budget', rules=Rules(returns=False)),
    'truth': Row('true recognition', truth=True),
    'truth_scan': Row('true recognition, map by a LaserScan', truth=True, ranges='scan'),
}


def conditions(row: Row, checkpoint: LoadedCheckpoint, options: argparse.Namespace) -> dict:
    """What a row's figures depend on; what was measured under others is measured again."""
    info = checkpoint.info
    common = conditions_of(
        checkpoint, split=row.split or options.split, houses=options.houses,
        episodes=options.episodes, seed=options.seed, max_decisions=options.max_decisions,
        stops=row.stops, stop_threshold=options.stop_threshold)
    return {**common, 'randomisation': row.randomisation or info['randomisation'],
            'odometry': odometry_for(checkpoint.network, row.odometry),
            'ranges': ranges_for(checkpoint.network, row.ranges),
            'camera': row.robot or 'as trained', 'control': row.control,
            'rules': None if row.rules is None else repr(row.rules), 'truth': row.truth}


def measured(row: Row, checkpoint: LoadedCheckpoint, options: argparse.Namespace) -> dict:
    """A row's `figures` by kind of stop, and what they took.

    Raises:
        UserError: the policy, or this simulator, cannot be measured so.
    """
    begun = time.monotonic()
    robot = ROBOTS / f'{row.robot}.yaml' if row.robot else None
    info = checkpoint.info
    scenes = split_scenes(info['simulator'], row.split or options.split, options.houses,
                          rooms_of(info['scenes'][0]) if info['scenes'] else None)

    def make(names, environments: int, stop: str):
        env = make_env_for(checkpoint, names, environments, stop=stop, robot=robot, own=False,
                           randomisation=row.randomisation, odometry=row.odometry,
                           max_decisions=options.max_decisions, ranges=row.ranges,
                           privileged=('overlap',) if row.truth else ())
        if row.truth:
            tell_truth(checkpoint.network, env)
        return env
    if robot:
        load_for(options.checkpoint, robot, any_camera=True)  # it has the policy's actions
    checkpoint.network.rules = row.rules
    try:
        rows = measure_checkpoint(checkpoint, scenes, make, EvaluateConfig(
            episodes=options.episodes, seed=options.seed, stops=row.stops,
            policy=row.control is None, controls=() if row.control is None else (row.control,),
            stop_threshold=options.stop_threshold, robot=load_robot(robot) if robot else None))
    finally:
        vars(checkpoint.network).pop('look', None)
    return {'figures': {stop: next(iter(own.values()))
                        for stop, own in evaluator.figures(rows).items() if own},
            'minutes': round((time.monotonic() - begun) / 60, 1), 'machine': machine(),
            'date': datetime.date.today().isoformat()}


def tell_truth(network: SearchPolicy, env) -> None:
    """Let a network see the ranges, and have the simulator say where the goal is."""
    told: dict = {}

    def remember(function):
        def remembered(*args, **options):
            found = function(*args, **options)
            told.update(found[-1])
            return found
        return remembered

    def look(image: Tensor, goal_maps: Tensor, goal_index: Tensor | None = None) -> Look:
        robots, goals = told['pose'], env.goal_poses[told['goal']]
        position = (goals[:, :2] - robots[:, :2]).T
        c, s = np.cos(robots[:, 2]), np.sin(robots[:, 2])
        turn = goals[:, 2] - robots[:, 2]
        sees, there = told['overlap'] >= POSE_OVERLAP, told['arrived']
        return SearchPolicy.look(network, image, goal_maps, goal_index)._replace(**{
            name: torch.from_numpy(np.asarray(value, np.float32)) for name, value in {
                'position': np.stack([c * position[0] + s * position[1],
                                      c * position[1] - s * position[0]], axis=1),
                'position_sigma': np.full(len(robots), TRUE_SIGMA),
                'heading': np.stack([np.cos(turn), np.sin(turn)], axis=1),
                'heading_sigma': np.full(len(robots), TRUE_SIGMA),
                'co_visible': np.where(sees, SURE, -SURE),
                'arrived': np.where(there, SURE, -SURE)}.items()})
    env.reset, env.step, network.look = remember(env.reset), remember(env.step), look


def markdown(found: dict[str, dict]) -> str:
    """The rows that there are as a table."""
    headings = ['', 'episodes', 'arrival (95 %)', 'SPL', 'declared stop (95 %)', 'SPL',
                'false stops', 'within 1 m (SPL)', 'collisions', 'decisions']
    lines = [headings, ['---'] * len(headings)]
    for name, entry in found.items():
        arrival, declared = (entry['figures'].get(stop) for stop in (ARRIVAL, DECLARED))
        last = declared or arrival
        false = '' if declared is None else f'{declared["false_stops"]:.2f}'
        if declared is not None and ROWS[name].control == evaluator.ABSENT:
            false = f'{declared["declared"]:.2f}'  # every one
        elif declared is not None and 'stops_at_shown' in declared:
            false += f' (at the picture {declared["stops_at_shown"]:.2f})'
        lines.append([
            ROWS[name].title, str(last['episodes']), *_success(arrival), *_success(declared),
            false, '' if declared is None or declared['within_1m'] is None else
            f'{declared["within_1m"]:.2f} ({number(declared["spl_within_1m"], ".2f")})',
            f'{last["collisions"]:.1%}'.replace('%', ' %'), f'{last["decisions"]:.0f}'])
    return tables.markdown(lines)


def _success(figures: dict | None) -> list[str]:
    if figures is None:
        return ['', '']
    low, high = figures['success_interval']
    return [f'{figures["success"]:.2f} ({low:.2f}-{high:.2f})', number(figures['spl'], '.2f')]


def main() -> int:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__.split('\n')[0])
    parser.add_argument('checkpoint', type=Path)
    parser.add_argument('--rows', nargs='+', choices=ROWS, default=list(ROWS), metavar='ROW',
                        help=', '.join(ROWS))
    parser.add_argument('--episodes', type=int, default=200,
                        help='of a row at least; in 20 houses 200 make 232')
    parser.add_argument('--houses', type=int, default=20, help='of a split')
    parser.add_argument('--split', default='validation', help='of the rows that name none')
    parser.add_argument('--max-decisions', type=int, default=300)
    parser.add_argument('--stop-threshold', type=float, metavar='P')
    parser.add_argument('--seed', type=int, default=10_000)
    parser.add_argument('--out', type=Path, default=Path('runs/search_table'))
    parser.add_argument('--print', dest='only_print', action='store_true',
                        help='measure nothing: print what there is')
    options = parser.parse_args()
    torch.set_num_threads(1)
    refused = 0
    try:
        checkpoint, _ = load_for(options.checkpoint)
        options.out.mkdir(parents=True, exist_ok=True)
        found: dict[str, dict] = {}
        for name, row in ROWS.items():
            path, asked = options.out / f'{name}.json', name in options.rows
            try:
                wanted = conditions(row, checkpoint, options)
                entry = finished(path, wanted)
                if entry is None and asked and not options.only_print:
                    entry = {'row': name, 'checkpoint': str(options.checkpoint),
                             'conditions': wanted, **measured(row, checkpoint, options)}
                    keep(path, entry)
                    for stop, own in entry['figures'].items():
                        print(tables.row_line(f'{name}, {tables.TITLES[stop].lower()}', own, stop),
                              flush=True)
            except UserError as error:
                if asked:
                    print(f'{name}: {error}', file=sys.stderr, flush=True)
                    refused += 1
                continue
            if entry is not None:
                found[name] = entry
    except UserError as error:
        print(f'bench/search.py: {error}', file=sys.stderr)
        return 2
    print(markdown(found))
    return 1 if refused else 0


if __name__ == '__main__':
    sys.exit(main())

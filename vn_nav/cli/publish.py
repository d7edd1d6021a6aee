"""`vn_nav evaluate` and `vn_nav publish`: checkpoints in houses and in recorded drives."""

from __future__ import annotations

import argparse
import datetime
import tempfile
from collections.abc import Callable
from pathlib import Path

from vn_nav.cli.evaluate import (
    DRIVE_SPLITS,
    SPLIT_HOUSES,
    check_evaluate_options,
    evaluate,
)
from vn_nav.cli.world import (
    check_backend,
    check_world,
    load_for,
    load_for_house,
    machine,
    make_env,
)
from vn_nav.errors import UserError

STOP_THRESHOLDS = (0.3, 0.5, 0.7, 0.85, 0.95)  # that `vn_nav publish` tries
UNSEEN_GOALS = 1  # `EnvConfig.goal_seed` of goals that no training shows (its own is 0)


def measure(checkpoint, houses, rooms: int, *, episodes: int, seed: int, controls: bool = True,
            decoding: str | None = None, threshold: float | None = None, max_decisions: int = 300,
            robot: Path | None = None, randomisation: str | None = None, goal_seed: int = 0):
    """Episodes of a loaded checkpoint in some houses.

    Returns:
        The episodes as `evaluator.measure` returns them, and the houses' floor plans by seed.
    """
    from vn_nav.evaluation import evaluator
    from vn_nav.robot import load_robot
    info, plans = checkpoint.info, {}
    own = set(houses) <= set(info['houses'])

    def make(seeds, environments: int, stop: str):
        env = make_env(seeds, rooms, environments, robot=robot, size=checkpoint.config.size,
                       randomisation=randomisation or info['randomisation'], task=info['task'],
                       objects=info['objects'], actions=checkpoint.config.actions,
                       max_decisions=max_decisions, stop=stop, goal_seed=goal_seed,
                       goals_per_room=info['goals_per_room'] if own else 1)
        plans.update({house.seed: house.floor_plan() for house in env.houses})
        return env

    wanted = evaluator.CONTROLS if controls else ()
    if info['task'] == 'collect':  # no goal: none to show wrong, and no shortest path to it
        wanted = [name for name in wanted if name in (evaluator.OTHER, evaluator.RANDOM)]
    rows = evaluator.measure(
        make, checkpoint.network, houses, known=info['houses'],
        decoding=decoding or info['decoding'],
        episodes=episodes, controls=wanted, seed=seed,
        threshold=info.get('stop_threshold') if threshold is None else threshold,
        robot=load_robot(robot) if robot else None)
    return rows, plans


def _splits(args, info: dict) -> dict[str, list[int]]:
    """The houses of each split that is asked for."""
    from vn_sim_bridge.houses.splits import SPLITS
    if args.house:
        return {'houses': list(dict.fromkeys(args.house))}
    found = {}
    for name in args.split or ['seen_goals']:
        if name in ('seen_goals', 'unseen_goals'):
            found[name] = info['houses'][:args.houses]
            if not found[name]:
                raise UserError('seen and unseen goals are in the houses of the checkpoint',
                                'a checkpoint that names none', 'give --house or another --split')
        elif name in SPLITS:
            found[name] = list(SPLITS[name][:args.houses or SPLIT_HOUSES])
            known = sorted(set(found[name]) & set(info['houses']))
            if name != 'train' and known:
                raise UserError(f'the checkpoint was not trained in houses of split {name}',
                                f'house {known[0]}', 'choose another split')
        else:
            raise UserError(f'a split is one of {", ".join(SPLITS)}, seen_goals, unseen_goals',
                            name, 'choose one of them')
    return found


def run_evaluate(args: argparse.Namespace) -> int:
    """`vn_nav evaluate`."""
    check_backend(args.backend)
    check_evaluate_options(args)
    checkpoint, robot = load_for(args.checkpoint, args.robot)
    with tempfile.TemporaryDirectory() as decoded:  # the pictures of a drive are mapped from there
        splits, measure_split = (
            _drive(args, checkpoint, robot, args.cache or Path(decoded)) if args.bag else
            _houses(args, checkpoint))
        evaluate(args, checkpoint.info, splits, measure_split)
    return 0


def _houses(args: argparse.Namespace, checkpoint) -> tuple[dict, Callable]:
    """The houses of each split, and what measures in them."""
    from vn_sim_bridge.floor.contacts import WORLD_VERSION
    check_world(checkpoint.info, WORLD_VERSION)
    rooms = args.rooms or checkpoint.info['rooms']
    if rooms is None:
        raise UserError('houses have a number of rooms', 'a checkpoint that names none',
                        'give --rooms')

    def measure_split(name: str, houses):
        return measure(
            checkpoint, houses, rooms, episodes=args.episodes,
            seed=args.seed, controls=not args.no_controls, decoding=args.decoding,
            threshold=args.stop_threshold, max_decisions=args.max_decisions, robot=args.robot,
            randomisation=args.randomisation,
            goal_seed=UNSEEN_GOALS if name == 'unseen_goals' else 0)

    return _splits(args, checkpoint.info), measure_split


def _drive(args: argparse.Namespace, checkpoint, robot, cache: Path) -> tuple[dict, Callable]:
    """The goals of each split in a recorded drive, and what measures there."""
    from vn_nav.bags.mapping.recorded_place import read_place
    from vn_nav.evaluation import evaluator
    from vn_sim_bridge import teach_place as place
    info = checkpoint.info
    graph = read_place(args, place.build_graph, robot, checkpoint.config.size, cache)
    check_world(info, graph.world_version)
    graphs = {'all_goals': graph}
    if args.split:
        own, others = place.held_out(graph)
        if others is None:
            raise UserError('there are enough goals to hold some out',
                            f'{len(graph.goals)} goals', 'leave out --split')
        divided = dict(zip(DRIVE_SPLITS, (own, others), strict=True))
        graphs = {name: divided[name] for name in args.split}

    def measure_split(name: str, _):
        def make(_, environments: int, stop: str):
            return place.make_env(graphs[name], robot, environments, stop=stop, light=True,
                                  task=info['task'], max_decisions=args.max_decisions)
        rows = evaluator.measure(
            make, checkpoint.network, [graph.seed], known=info['houses'],
            decoding=args.decoding or info['decoding'], episodes=args.episodes,
            controls=() if args.no_controls else evaluator.CONTROLS, seed=args.seed,
            threshold=(info.get('stop_threshold') if args.stop_threshold is None
                       else args.stop_threshold), robot=robot)
        return rows, {graph.seed: graph.floor_plan()}

    return {name: [graph.seed] for name in graphs}, measure_split


def run_publish(args) -> int:
    """`vn_nav publish`."""
    from vn_nav.evaluation import evaluator
    from vn_nav.policy.checkpoint import load_checkpoint, save_checkpoint
    from vn_nav.report import tables
    checkpoint, _ = load_for_house(args.source, args.robot)
    info = {key: value for key, value in checkpoint.info.items() if key != 'sha256'}
    save_checkpoint(args.target, checkpoint.network, info, half=True)
    shipped = load_checkpoint(args.target)  # measure what ships: the rounded weights
    houses, rooms = info['houses'], info['rooms']
    if 'arrival' in shipped.config.heads:
        info['stop_threshold'] = _stop_threshold(shipped, args)
        save_checkpoint(args.target, shipped.network, info, half=True)
        shipped = load_checkpoint(args.target)
    info['results'] = {}
    for place, seeds in (('trained house', houses), (f'unseen house {args.unseen}',
                                                     [args.unseen])):
        rows, _ = measure(shipped, seeds, rooms, episodes=args.episodes, seed=10_000,
                          robot=args.robot)
        results = evaluator.figures(rows)
        tables.print_rows(results, place)
        for stop, row in results.items():
            kind = '' if stop == evaluator.ARRIVAL else 'declared stop, '
            info['results'] |= {f'{place}: {kind}{name}': figures
                                for name, figures in row.items()}
    info['notes'] += (f' Measured with `vn_nav publish`, {args.episodes} episodes a row, 300 '
                      f'decisions at most, motion noise on, on {machine()}, '
                      f'{datetime.date.today().isoformat()}. Figures are defined in '
                      'docs/architecture.md.')
    save_checkpoint(args.target, shipped.network, info, half=True)
    return 0


def _stop_threshold(checkpoint, args) -> float:
    """The probability of arrival that is best declared at, on starts that no figure is from."""
    from vn_nav.evaluation import evaluator
    success = {}
    for threshold in STOP_THRESHOLDS:
        rows, _ = measure(checkpoint, checkpoint.info['houses'][:16], checkpoint.info['rooms'],
                          episodes=args.episodes, seed=20_000, controls=False,
                          threshold=threshold, robot=args.robot)
        (row,) = evaluator.figures(rows)[evaluator.DECLARED].values()
        success[threshold] = row['success']
        print(f'declaring above {threshold:.0%}: success {row["success"]:.2f}, false stops '
              f'{row["false_stops"]:.2f}', flush=True)
    return max(success, key=success.get)

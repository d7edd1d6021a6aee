"""`vn_nav evaluate` and `vn_nav publish`: checkpoints in houses and in recorded drives."""

from __future__ import annotations

import argparse
import datetime
import tempfile
from collections.abc import Callable
from pathlib import Path

from vn_nav.cli_scenes import scenes_from, split_scenes
from vn_nav.cli_world import (
    check_backend,
    check_version,
    load_for,
    load_for_scenes,
    machine,
    make_env,
)
from vn_nav.errors import UserError
from vn_nav.evaluation.command import (
    DRIVE_SPLITS,
    SPLIT_SCENES,
    check_evaluate_options,
    evaluate,
)
from vn_nav.scenes import BAG, HOUSE, house_scene, one_simulator, parse_scene, rooms_of

STOP_THRESHOLDS = (0.3, 0.5, 0.7, 0.85, 0.95)  # that `vn_nav publish` tries
UNSEEN_GOALS = 1  # `EnvConfig.goal_seed` of goals that no training shows (its own is 0)


def measure(checkpoint, scenes, *, episodes: int, seed: int, controls: bool = True,
            decoding: str | None = None, threshold: float | None = None, max_decisions: int = 300,
            robot: Path | None = None, randomisation: str | None = None, goal_seed: int = 0):
    """Episodes of a loaded checkpoint in some scenes.

    Returns:
        The episodes as `evaluator.measure` returns them, and the scenes' floor plans by name.
    """
    from vn_nav.evaluation import evaluator
    from vn_nav.robot import load_robot
    info, plans = checkpoint.info, {}
    own = set(scenes) <= set(info['scenes'])

    def make(names, environments: int, stop: str):
        env = make_env(names, environments, robot=robot, size=checkpoint.config.size,
                       randomisation=randomisation or info['randomisation'], task=info['task'],
                       objects=info['objects'], actions=checkpoint.config.actions,
                       max_decisions=max_decisions, stop=stop, goal_seed=goal_seed,
                       goals_per_room=info['goals_per_room'] if own else 1)
        check_version(info, simulator=env.simulator_name, version=env.world_version)
        plans.update({place.name: place.plan() for place in env.places})
        can = env.simulator.capabilities
        if not (can.geodesic or env.simulator.planner) and evaluator.SHORTEST in wanted:
            wanted.remove(evaluator.SHORTEST)
        return env

    wanted = list(evaluator.CONTROLS if controls else ())
    if info['task'] == 'collect':  # no goal: none to show wrong, and no shortest path to it
        wanted = [name for name in wanted if name in (evaluator.OTHER, evaluator.RANDOM)]
    rows = evaluator.measure(
        make, checkpoint.network, scenes, known=info['scenes'],
        decoding=decoding or info['decoding'],
        episodes=episodes, controls=wanted, seed=seed,
        threshold=info.get('stop_threshold') if threshold is None else threshold,
        robot=load_robot(robot) if robot else None)
    return rows, plans


def _splits(args, info: dict) -> dict[str, list[str]]:
    """The scenes of each split that is asked for."""
    rooms = args.rooms or (_rooms(info) if info['simulator'] == HOUSE else None)
    if args.house or args.scene:
        return {'scenes': scenes_from(args, rooms)}
    found = {}
    for name in args.split or ['seen_goals']:
        if name in ('seen_goals', 'unseen_goals'):
            found[name] = info['scenes'][:args.houses]
            if args.rooms:
                found[name] = list(dict.fromkeys(
                    house_scene(int(parse_scene(scene).place), rooms) for scene in found[name]))
            if not found[name]:
                raise UserError('seen and unseen goals are in the scenes of the checkpoint',
                                'a checkpoint that names none', 'give --scene, --house or another '
                                '--split')
        else:
            found[name] = split_scenes(info['simulator'], name, args.houses or SPLIT_SCENES, rooms)
            known = [scene for scene in found[name] if scene in info['scenes']]
            if name != 'train' and known:
                raise UserError(f'the checkpoint was not trained in scenes of split {name}',
                                known[0], 'choose another split')
    return found


def _rooms(info: dict) -> int | None:
    """Rooms of the houses that a checkpoint knows."""
    return rooms_of(info['scenes'][0]) if info['scenes'] else None


def run_evaluate(args: argparse.Namespace) -> int:
    """`vn_nav evaluate`."""
    check_backend(args.backend)
    check_evaluate_options(args)
    checkpoint, robot = load_for(args.checkpoint, args.robot)
    with tempfile.TemporaryDirectory() as decoded:  # the pictures of a drive are mapped from there
        splits, measure_split = (
            _drive(args, checkpoint, robot, args.cache or Path(decoded)) if args.bag else
            _scenes(args, checkpoint))
        evaluate(args, checkpoint.info, splits, measure_split)
    return 0


def _scenes(args: argparse.Namespace, checkpoint) -> tuple[dict, Callable]:
    """The scenes of each split, and what measures in them."""
    splits = _splits(args, checkpoint.info)
    for scenes in splits.values():
        check_version(checkpoint.info, simulator=one_simulator(scenes)[0])

    def measure_split(name: str, scenes):
        return measure(
            checkpoint, scenes, episodes=args.episodes,
            seed=args.seed, controls=not args.no_controls, decoding=args.decoding,
            threshold=args.stop_threshold, max_decisions=args.max_decisions, robot=args.robot,
            randomisation=args.randomisation,
            goal_seed=UNSEEN_GOALS if name == 'unseen_goals' else 0)

    return splits, measure_split


def _drive(args: argparse.Namespace, checkpoint, robot, cache: Path) -> tuple[dict, Callable]:
    """The goals of each split in a recorded drive, and what measures there."""
    from vn_nav.bags.recorded_place import read_place
    from vn_nav.evaluation import evaluator
    from vn_sim_bridge import teach_place as place
    info = checkpoint.info
    graph = read_place(args, place.build_graph, robot, checkpoint.config.size, cache)
    check_version(info, simulator=BAG, version=graph.world_version)
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
            make, checkpoint.network, [graph.name], known=info['scenes'],
            decoding=args.decoding or info['decoding'], episodes=args.episodes,
            controls=() if args.no_controls else evaluator.CONTROLS, seed=args.seed,
            threshold=(info.get('stop_threshold') if args.stop_threshold is None
                       else args.stop_threshold), robot=robot)
        return rows, {graph.name: graph.plan()}

    return {name: [graph.name] for name in graphs}, measure_split


def run_publish(args) -> int:
    """`vn_nav publish`."""
    from vn_nav.evaluation import evaluator, tables
    from vn_nav.policy.checkpoint import load_checkpoint, save_checkpoint
    checkpoint, _ = load_for_scenes(args.source, args.robot)
    info = {key: value for key, value in checkpoint.info.items() if key != 'sha256'}
    save_checkpoint(args.target, checkpoint.network, info, half=True)
    shipped = load_checkpoint(args.target)  # measure what ships: the rounded weights
    scenes = info['scenes']
    if info['simulator'] != HOUSE or not scenes:
        raise UserError('a policy of embedded houses is published', f'{info["simulator"]} '
                        f'{", ".join(scenes)}', 'publish one that was trained in houses')
    rooms = rooms_of(scenes[0])
    if 'arrival' in shipped.config.heads:
        info['stop_threshold'] = _stop_threshold(shipped, args)
        save_checkpoint(args.target, shipped.network, info, half=True)
        shipped = load_checkpoint(args.target)
    info['results'] = {}
    for place, names in (('trained house', scenes),
                         (f'unseen house {args.unseen}', [house_scene(args.unseen, rooms)])):
        rows, _ = measure(shipped, names, episodes=args.episodes, seed=10_000,
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
        rows, _ = measure(checkpoint, checkpoint.info['scenes'][:16],
                          episodes=args.episodes, seed=20_000, controls=False,
                          threshold=threshold, robot=args.robot)
        (row,) = evaluator.figures(rows)[evaluator.DECLARED].values()
        success[threshold] = row['success']
        print(f'declaring above {threshold:.0%}: success {row["success"]:.2f}, false stops '
              f'{row["false_stops"]:.2f}', flush=True)
    return max(success, key=success.get)

"""The `vn_nav` command: the one place where simulator and stack meet."""

from __future__ import annotations

import argparse
import datetime
import math
import os
import platform
import shlex
import sys
import time
from pathlib import Path

from vn_nav import __version__
from vn_nav.bags.command import add_bag_commands
from vn_nav.errors import UserError
from vn_nav.evaluation.command import (
    SPLIT_HOUSES,
    add_compare_options,
    add_evaluate_options,
    check_evaluate_options,
    evaluate,
    run_compare,
)
from vn_nav.learning.command import (
    add_train_options,
    check_train_options,
    config_over_ros,
    train_config,
    world_options,
)
from vn_nav.learning.pretrain_command import add_pretrain_options, run_pretrain
from vn_nav.learning.teach import add_teach_options, teach

BACKENDS = ('house',)
STOP_THRESHOLDS = (0.3, 0.5, 0.7, 0.85, 0.95)  # that `vn_nav publish` tries
UNSEEN_GOALS = 1  # `EnvConfig.goal_seed` of goals that no training shows (its own is 0)


def build_parser() -> argparse.ArgumentParser:
    """The command line."""
    parser = argparse.ArgumentParser(
        prog='vn_nav', description='Visual navigation for ROS 2: show a robot a picture, and it '
        'drives to where the picture was taken.')
    parser.add_argument('--version', action='version', version=f'vn_nav {__version__}')
    commands = parser.add_subparsers(dest='command', required=True, metavar='COMMAND')

    demo = commands.add_parser('demo', help='watch the shipped policy drive over ROS 2')
    demo.add_argument('--out', type=Path, default=Path('demo'), help='folder for bag and page')
    demo.add_argument('--episodes', type=int, default=20, help='in the trained house')
    demo.add_argument('--unseen-episodes', type=int, default=10, help='in an unseen house')
    demo.add_argument('--checkpoint', type=Path, help='instead of the shipped policy')
    demo.set_defaults(run=run_demo)

    train = commands.add_parser('train', help='train a policy')
    _add_world(train)
    add_train_options(train)
    train.set_defaults(run=run_train)

    collected = commands.add_parser(
        'collect', help='record pictures from random poses as a bag, for pre-training')
    _add_world(collected)
    collected.add_argument('--houses', type=int, metavar='N', help='the first N training houses')
    collected.add_argument('--pictures', type=int, default=20_000,
                           help='in all (thesis, 5.7: 20,000)')
    collected.add_argument('--size', type=int, default=84, help='side of the pictures [pixels]')
    collected.add_argument('--threads', type=int, default=1, help='that draw')
    collected.add_argument('--out', type=Path, required=True, help='folder of the bag')
    collected.set_defaults(run=run_collect)

    pretrained = commands.add_parser('pretrain', help='pre-train a policy on recorded bags')
    add_pretrain_options(pretrained)
    pretrained.set_defaults(run=run_pretrain)

    taught = commands.add_parser(
        'teach', help='learn the place where a bag was driven, in its pictures')
    add_teach_options(taught)
    taught.set_defaults(run=run_teach)

    measured = commands.add_parser('evaluate', help='measure a checkpoint')
    measured.add_argument('checkpoint', type=Path)
    _add_world(measured, defaults=False)
    add_evaluate_options(measured)
    measured.set_defaults(run=run_evaluate)

    compare = commands.add_parser('compare', help="plot several runs' learning curves")
    add_compare_options(compare)
    compare.set_defaults(run=run_compare)

    publish = commands.add_parser(
        'publish', help='measure a run and write it as a checkpoint to ship')
    publish.add_argument('source', type=Path, help='checkpoint of a training run')
    publish.add_argument('target', type=Path, help='for example models/house')
    publish.add_argument('--unseen', type=int, required=True, help='seed of a held-out house')
    publish.add_argument('--episodes', type=int, default=100)
    publish.add_argument('--robot', type=Path, metavar='YAML', help='that it was trained for')
    publish.set_defaults(run=run_publish)

    export = commands.add_parser('export', help='write a checkpoint as ONNX')
    export.add_argument('checkpoint', type=Path)
    export.add_argument('--onnx', type=Path, required=True, metavar='FOLDER',
                        help='for policy.onnx and goal.onnx')
    export.set_defaults(run=run_export)

    add_bag_commands(commands.add_parser('bag', help='check and repair recorded drives'))

    house = commands.add_parser('house', help='look at an embedded house')
    actions = house.add_subparsers(dest='action', required=True, metavar='ACTION')
    for name, words, run, out in (
            ('show', 'write a contact sheet: views and a map', run_house_show, 'png'),
            ('walk', 'drive with the keyboard', run_house_walk, None),
            ('export', 'write a mesh that other programs open', run_house_export, 'glb')):
        action = actions.add_parser(name, help=words)
        action.add_argument('--seed', type=int, default=7)
        action.add_argument('--rooms', type=int, default=5)
        if name != 'export':
            action.add_argument('--randomisation', default='none' if out else 'standard',
                                metavar='NAME', help='of light and camera: none, standard, rough '
                                'or a YAML file')
        if out:
            action.add_argument('--out', type=Path, help=f'file (default house-SEED.{out})')
        action.set_defaults(run=run)
    return parser


def _add_world(parser: argparse.ArgumentParser, defaults: bool = True) -> None:
    parser.add_argument('--backend', default='house', help=f'one of: {", ".join(BACKENDS)}')
    parser.add_argument('--house', type=int, action='append', metavar='SEED',
                        help='seed of a house; may be given several times')
    parser.add_argument('--rooms', type=int, default=5 if defaults else None)
    parser.add_argument('--robot', type=Path, metavar='YAML',
                        help='robot file (config/robots/); default: the standard robot')
    parser.add_argument('--randomisation', default='none' if defaults else None, metavar='NAME',
                        help='of light, camera and base: none, standard, rough or a YAML file')
    parser.add_argument('--seed', type=int, default=0 if defaults else 10_000)


def _check_backend(name: str) -> None:
    if name not in BACKENDS:
        raise UserError(f'the backend is one of: {", ".join(BACKENDS)}', name, 'choose one')


def make_env(houses, rooms: int, envs: int, *, robot: Path | None = None, threads: int = 1,
             randomisation: str | Path = 'none', device: str = 'cpu', **options):
    """A `NavigationEnv` of embedded houses; without a robot file with the standard robot.

    On a device other than the CPU it is a `WarpNavigationEnv`.
    """
    from vn_nav.robot import load_robot
    from vn_sim_bridge.env import EnvConfig, NavigationEnv
    from vn_sim_bridge.randomisation import load_randomisation
    config = EnvConfig(houses=tuple(houses), rooms=rooms, num_envs=envs,
                       randomisation=load_randomisation(randomisation), **options)
    spec = load_robot(robot) if robot else None
    if device == 'cpu':
        return NavigationEnv(config, spec, threads=threads)
    _check_gpu(device)
    from vn_sim_bridge.warp_env import WarpNavigationEnv
    return WarpNavigationEnv(config, spec, device=device)


def _check_gpu(device: str) -> None:
    """Whether the simulator can run on a GPU such as cuda:0."""
    import torch
    try:
        import warp as wp
    except ImportError as error:
        raise UserError('the simulator runs on a GPU with the extra "gpu"', str(error),
                        "pip install 'vn_nav[gpu]', or use --device cpu") from error
    number = torch.device(device).index or 0
    known = min(torch.cuda.device_count(), wp.get_cuda_device_count())
    if number >= known:
        raise UserError('the device is a GPU that torch and Warp find', f'{device}; they find '
                        f'{known or "none"}', 'look at nvidia-smi and at torch.version.cuda, or '
                        'use --device cpu')


def run_collect(args) -> int:
    """`vn_nav collect`."""
    _check_backend(args.backend)
    from vn_nav.bags.recorder import BagWriter
    from vn_nav.robot import RobotSpec, load_robot
    from vn_sim_bridge.collect import collect, house_scenes
    from vn_sim_bridge.houses.splits import SPLITS
    from vn_sim_bridge.randomisation import load_randomisation
    if args.house and args.houses:
        raise UserError('pictures are of named houses or of the first N', '--house and --houses',
                        'give one of them')
    count = 1 if args.houses is None else max(args.houses, 0)
    houses = args.house or list(SPLITS['train'][:count])
    robot = load_robot(args.robot) if args.robot else RobotSpec()
    scenes = house_scenes(houses, args.rooms, args.size, robot,
                          load_randomisation(args.randomisation), args.seed, args.threads)
    begun = time.monotonic()
    done = collect(scenes, len(houses), args.pictures, robot,
                   lambda topics: BagWriter(args.out, topics))
    seconds = time.monotonic() - begun
    print(f'{args.out}: {done.pictures:,} pictures in {done.episodes:,} episodes of {done.scenes} '
          f'house{"s" * (done.scenes > 1)}, {done.pictures / seconds:,.0f} pictures/s')
    return 0


def run_train(args) -> int:
    """`vn_nav train`."""
    _check_backend(args.backend)
    check_train_options(args)
    if args.env == 'ros':
        return _train_over_ros(args)
    from vn_nav.learning.trainer import train
    from vn_sim_bridge.env import PRIVILEGED
    from vn_sim_bridge.houses.splits import SPLITS
    houses = args.house or list(SPLITS['train'][:args.houses or 1])
    config, world = train_config(args), world_options(args)
    env = make_env(houses, args.rooms, world.pop('envs'), robot=args.robot, threads=config.threads,
                   randomisation=args.randomisation, size=args.size, seed=args.seed,
                   device=config.device,
                   actions=tuple(args.actions.split(',')), task=args.task,
                   objects=args.objects, goals_per_room=args.goals_per_room,
                   goal_variants=args.goal_variants,
                   privileged=tuple(sorted(set(config.privileged) & set(PRIVILEGED))), **world)
    bags = _bag_mix(args, config, env.robot)
    info = _train_info(args, config, env, bags) | {
        'houses': houses, 'rooms': args.rooms, 'randomisation': args.randomisation,
        'goals_per_room': args.goals_per_room, 'goal_variants': args.goal_variants,
        'task': args.task, 'objects': args.objects}
    pairs = None
    if config.pair_minutes and not args.init:
        pairs = _pair_sources(args, config)
    print(train(env, config, args.out, info=info, resume=args.resume, init=args.init,
                pairs=pairs, bags=bags))
    return 0


def _train_info(args, config, env, bags) -> dict:
    """What every checkpoint of a training says."""
    taught = '' if bags is None else (
        f', beside {len(bags.drives):,} steps of {len(args.bags)} bag{"s" * (len(args.bags) > 1)}')
    return {
        'preset': args.preset,
        'command': 'vn_nav ' + shlex.join(word for word in sys.argv[1:] if word != '--resume'),
        'camera_fov_deg': math.degrees(env.robot.camera_fov),
        'camera_height': env.robot.camera_height,
        'notes': f'Trained on {machine(config.device)}, {config.threads} thread(s), '
                 f'{datetime.date.today().isoformat()}{taught}.',
        'world_version': env.world_version,
    }


def _bag_mix(args, config, robot):
    """The bags that a training learns from as well; None: there are none."""
    if not args.bags:
        return None
    from vn_nav.bags.drive import Topics, load_topics
    from vn_nav.learning.bag_mix import BagMix
    from vn_nav.learning.pretrain_command import load_bags
    drives, _ = load_bags(args.bags, robot, args.size,
                          load_topics(args.topics) if args.topics else Topics(),
                          args.cache or args.out / 'decoded')
    bags = BagMix(drives, config)
    parts = ', '.join(bags.parts).replace('_', ' ')
    for line in (*bags.words, f'bags teach {parts}'):
        print(line, flush=True)
    return bags


def _train_over_ros(args) -> int:
    """`vn_nav train --env ros`."""
    import torch

    from vn_nav.learning.trainer import train
    from vn_nav.robot import RobotSpec, load_robot
    try:
        from vn_nav.nodes.ros_env import RosEnv
    except ImportError as error:
        raise UserError('training over ROS needs rclpy and the common messages', str(error),
                        "source ROS 2, or pip install 'vn_nav[ros]'") from error
    if torch.distributed.is_torchelastic_launched():
        raise UserError('one process trains over ROS', 'torchrun',
                        'name several robots with --namespaces instead')
    config, world = train_config(args), world_options(args)
    robot = (load_robot(args.robot) if args.robot else RobotSpec()).with_actions(
        args.actions.split(','))
    bags = _bag_mix(args, config, robot)  # no robot waits for the decoding
    with RosEnv(robot, args.size,
                namespaces=args.namespaces or ('',), lock_step=args.lock_step,
                max_decisions=world['max_decisions'], collision_reward=world['collision_reward'],
                record=args.record, ros_arguments=args.ros_args or ()) as env:
        config, words = config_over_ros(config, world, env.offers, args.lock_step)
        for line in words:
            print(line, flush=True)
        env.listen(config.privileged)
        info = _train_info(args, config, env, bags) | {
            'houses': [env.scene['house']] if 'house' in env.scene else [],
            'rooms': env.scene.get('rooms')}

        def say(row: dict) -> None:
            print(f'{row["frames"]:,} frames: {env.steps / env.seconds:.2f} steps/s over ROS, '
                  f'{row["fps"]:.2f} with learning', flush=True)
        print(train(env, config, args.out, info=info, resume=args.resume, init=args.init,
                    bags=bags, on_update=say))
    return 0


def _pair_sources(args, config):
    """Makes the pairs that a training begins with, and those of validation houses."""
    def make():
        from vn_nav.robot import load_robot
        from vn_sim_bridge.houses.splits import SPLITS
        from vn_sim_bridge.pairs import PairSampler
        from vn_sim_bridge.randomisation import load_randomisation
        options = {'rooms': args.rooms, 'size': args.size, 'threads': config.threads,
                   'robot': load_robot(args.robot) if args.robot else None,
                   'randomisation': load_randomisation(args.randomisation)}
        return (PairSampler(SPLITS['train'][:config.pair_houses], seed=args.seed, **options),
                PairSampler(SPLITS['validation'][:16], seed=args.seed + 1, **options))
    return make


def run_teach(args) -> int:
    """`vn_nav teach`."""
    from vn_sim_bridge import teach as place
    return teach(args, place)


def machine(device: str = 'cpu') -> str:
    """The processor in words, or the GPU."""
    if device != 'cpu':
        import torch
        return torch.cuda.get_device_name(device)
    try:
        lines = Path('/proc/cpuinfo').read_text().splitlines()
        model = next(line.split(':', 1)[1].strip() for line in lines if 'model name' in line)
    except (OSError, StopIteration):
        model = platform.processor() or platform.machine()
    return f'{model}, {os.cpu_count()} cores'


def _load(path: Path, robot: Path | None = None):
    """A checkpoint for the present world, whose actions and camera the robot has."""
    from vn_nav.policy.checkpoint import load_checkpoint
    from vn_nav.robot import RobotSpec, load_robot
    from vn_sim_bridge.world import WORLD_VERSION
    checkpoint = load_checkpoint(path)
    spec = load_robot(robot) if robot else RobotSpec()
    # Or says which action is unknown, or too long.
    spec = spec.with_actions(checkpoint.config.actions, checkpoint.config.moves)
    trained = checkpoint.info['camera_fov_deg'], checkpoint.info['camera_height']
    present = math.degrees(spec.camera_fov), spec.camera_height
    if any(abs(a - b) > 0.01 * b for a, b in zip(present, trained, strict=True)):
        raise UserError('the robot has the camera that the policy was trained with: '
                        f'{trained[0]:g} deg, {trained[1]:g} m high',
                        f'{present[0]:g} deg, {present[1]:g} m (robot {spec.name})',
                        'give its file with --robot, or train a policy for this robot')
    if checkpoint.info['world_version'] != WORLD_VERSION:
        raise UserError(f'the checkpoint belongs to world version {WORLD_VERSION!r}',
                        checkpoint.info['world_version'], 'train it again (vn_nav train), or use '
                        'the version of vn_nav that it came with')
    return checkpoint


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


def run_evaluate(args) -> int:
    """`vn_nav evaluate`."""
    _check_backend(args.backend)
    check_evaluate_options(args)
    checkpoint = _load(args.checkpoint, args.robot)

    def measure_split(name: str, houses):
        return measure(
            checkpoint, houses, args.rooms or checkpoint.info['rooms'], episodes=args.episodes,
            seed=args.seed, controls=not args.no_controls, decoding=args.decoding,
            threshold=args.stop_threshold, max_decisions=args.max_decisions, robot=args.robot,
            randomisation=args.randomisation,
            goal_seed=UNSEEN_GOALS if name == 'unseen_goals' else 0)

    evaluate(args, checkpoint.info, _splits(args, checkpoint.info), measure_split)
    return 0


def run_publish(args) -> int:
    """`vn_nav publish`."""
    from vn_nav.evaluation import evaluator, tables
    from vn_nav.policy.checkpoint import load_checkpoint, save_checkpoint
    checkpoint = _load(args.source, args.robot)
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


def run_export(args) -> int:
    """`vn_nav export`."""
    from vn_nav.policy.checkpoint import load_checkpoint
    from vn_nav.policy.export import export_onnx
    for path in export_onnx(load_checkpoint(args.checkpoint), args.onnx):
        print(f'{path}: {path.stat().st_size / 1e6:.1f} MB')
    return 0


def run_demo(args) -> int:
    """`vn_nav demo`."""
    from vn_nav.demo import run
    from vn_nav.resources import share_file
    folder = args.checkpoint or share_file('models/house')
    task = _load(folder).info['task']  # refuse before anything is written
    if task != 'image':
        raise UserError('the demo drives to the places of pictures: a checkpoint of task image',
                        task, 'use vn_nav evaluate')
    return run(args.out, folder, make_env=make_env, episodes=args.episodes,
               unseen_episodes=args.unseen_episodes)


def run_house_show(args) -> int:
    """`vn_nav house show`."""
    from vn_sim_bridge.houses.contact_sheet import write_contact_sheet
    from vn_sim_bridge.houses.procedural import generate_house
    from vn_sim_bridge.randomisation import load_randomisation
    house = generate_house(args.seed, rooms=args.rooms)
    path = args.out or Path(f'house-{args.seed}.png')
    write_contact_sheet(path, house, load_randomisation(args.randomisation))
    print(f'{path}: {len(house.rooms)} rooms, {house.area:.0f} m2, '
          f'{house.scene.triangle_count} triangles, goals in '
          f'{", ".join(goal.room for goal in house.goals)}')
    return 0


def run_house_walk(args) -> int:
    """`vn_nav house walk`."""
    from vn_sim_bridge.houses.procedural import generate_house
    from vn_sim_bridge.houses.walk import walk
    from vn_sim_bridge.randomisation import load_randomisation
    walk(generate_house(args.seed, rooms=args.rooms), load_randomisation(args.randomisation))
    return 0


def run_house_export(args) -> int:
    """`vn_nav house export`."""
    from vn_sim_bridge.houses.mesh import export_mesh
    from vn_sim_bridge.houses.procedural import generate_house
    house = generate_house(args.seed, rooms=args.rooms)
    path = args.out or Path(f'house-{args.seed}.glb')
    export_mesh(house.scene, path)
    print(f'{path}: {house.scene.triangle_count} triangles, {path.stat().st_size / 1e6:.1f} MB, '
          'parts named by class and instance')
    return 0


def main(argv: list[str] | None = None) -> int:
    """Entry point: 2 and one line on standard error for bad input."""
    args = build_parser().parse_args(argv)
    try:
        return args.run(args)
    except UserError as error:
        print(f'vn_nav: {error}', file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return 130


if __name__ == '__main__':
    sys.exit(main())

"""The `vn_nav` command: the one place where simulator and stack meet."""

from __future__ import annotations

import argparse
import datetime
import json
import math
import os
import platform
import shlex
import sys
from pathlib import Path

from vn_nav import __version__
from vn_nav.errors import UserError
from vn_nav.robot import DRIVE_ACTIONS

BACKENDS = ('house',)


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
    train.add_argument('--task', default='image', help='image, object, room or collect')
    train.add_argument('--objects', type=int, default=1, help='in the house at a time')
    train.add_argument('--out', type=Path, required=True, help='folder of the run')
    train.add_argument('--resume', action='store_true', help='go on with the run in --out')
    train.add_argument('--frames', type=float, default=1.5e6, help='agent decisions')
    train.add_argument('--minutes', type=float, help='stop after this wall-clock time')
    train.add_argument('--envs', type=int, default=64)
    train.add_argument('--actions', default=','.join(DRIVE_ACTIONS),
                       help="names from the robot's table, with commas between")
    train.add_argument('--size', type=int, default=84, help='side of the pictures [pixels]')
    train.add_argument('--progress-reward', type=float, default=1.0, help='per metre')
    train.add_argument('--collision-reward', type=float, default=-0.02, help='per contact')
    train.add_argument('--learning-rate', type=float, default=4e-4)
    train.add_argument('--entropy', type=float, default=0.008, help='weight of the entropy')
    train.add_argument('--curriculum', choices=('success', 'frames'), default='success',
                       help='what raises the difficulty')
    train.add_argument('--rollout-length', type=int, default=32)
    train.add_argument('--epochs', type=int, default=2)
    train.add_argument('--minibatches', type=int, default=4)
    train.add_argument('--channels', type=int, nargs=3, default=(16, 32, 64),
                       help='of the three convolutions')
    train.add_argument('--no-tensorboard', action='store_true')
    train.add_argument('--no-bf16', action='store_true', help='float32 throughout')
    train.add_argument('--threads', type=int, default=1)
    train.set_defaults(run=run_train)

    evaluate = commands.add_parser('evaluate', help='measure a checkpoint')
    evaluate.add_argument('checkpoint', type=Path)
    _add_world(evaluate, defaults=False)
    evaluate.add_argument('--episodes', type=int, default=100)
    evaluate.add_argument('--max-decisions', type=int, default=300)
    evaluate.add_argument('--decoding', choices=('sample', 'greedy'))
    evaluate.add_argument('--no-controls', action='store_true')
    evaluate.add_argument('--json', type=Path, help='also write the figures here')
    evaluate.set_defaults(run=run_evaluate)

    publish = commands.add_parser(
        'publish', help='measure a run and write it as a checkpoint to ship')
    publish.add_argument('source', type=Path, help='checkpoint of a training run')
    publish.add_argument('target', type=Path, help='for example models/house')
    publish.add_argument('--unseen', type=int, required=True, help='seed of a held-out house')
    publish.add_argument('--episodes', type=int, default=100)
    publish.add_argument('--robot', type=Path, metavar='YAML', help='that it was trained for')
    publish.set_defaults(run=run_publish)

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
             randomisation: str | Path = 'none', **options):
    """A `NavigationEnv` of embedded houses; without a robot file with the standard robot."""
    from vn_nav.robot import load_robot
    from vn_sim_bridge.env import EnvConfig, NavigationEnv
    from vn_sim_bridge.randomisation import load_randomisation
    config = EnvConfig(houses=tuple(houses), rooms=rooms, num_envs=envs,
                       randomisation=load_randomisation(randomisation), **options)
    return NavigationEnv(config, load_robot(robot) if robot else None, threads=threads)


def run_train(args) -> int:
    """`vn_nav train`."""
    _check_backend(args.backend)
    from vn_nav.learning.trainer import TrainConfig, train
    houses = args.house or [0]
    env = make_env(houses, args.rooms, args.envs, robot=args.robot, threads=args.threads,
                   randomisation=args.randomisation, size=args.size, seed=args.seed,
                   actions=tuple(args.actions.split(',')), task=args.task,
                   objects=args.objects,
                   progress_reward=args.progress_reward, collision_reward=args.collision_reward)
    config = TrainConfig(
        frames=int(args.frames), minutes=args.minutes, rollout_length=args.rollout_length,
        curriculum=args.curriculum, epochs=args.epochs, minibatches=args.minibatches,
        channels=tuple(args.channels),
        learning_rate=args.learning_rate, final_learning_rate=args.learning_rate / 10,
        entropy_coefficient=args.entropy, final_entropy_coefficient=args.entropy / 3,
        seed=args.seed, bf16=False if args.no_bf16 else None, threads=args.threads,
        tensorboard=not args.no_tensorboard)
    words = [word for word in sys.argv[1:] if word != '--resume']
    info = {
        'houses': houses, 'rooms': args.rooms, 'randomisation': args.randomisation,
        'task': args.task, 'objects': args.objects, 'command': 'vn_nav ' + shlex.join(words),
        'camera_fov_deg': math.degrees(env.robot.camera_fov),
        'camera_height': env.robot.camera_height,
        'notes': f'Trained on {machine()}, {args.threads} thread(s), '
                 f'{datetime.date.today().isoformat()}.',
        'world_version': env.world_version,
    }
    print(train(env, config, args.out, info=info, resume=args.resume))
    return 0


def machine() -> str:
    """The processor in words."""
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
    spec.with_actions(checkpoint.config.actions)  # or says which action is unknown
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
            decoding: str | None = None, max_decisions: int = 300,
            robot: Path | None = None, randomisation: str | None = None) -> dict:
    """Figures of a loaded checkpoint in some houses."""
    from vn_nav.evaluation.evaluator import evaluate
    env = make_env(houses, rooms, min(50, episodes), robot=robot, size=checkpoint.config.size,
                   randomisation=randomisation or checkpoint.info['randomisation'],
                   task=checkpoint.info['task'], objects=checkpoint.info['objects'],
                   actions=checkpoint.config.actions, max_decisions=max_decisions)
    return evaluate(env, checkpoint.network, decoding=decoding or checkpoint.info['decoding'],
                    episodes=episodes, controls=controls, seed=seed)


def run_evaluate(args) -> int:
    """`vn_nav evaluate`."""
    _check_backend(args.backend)
    if args.episodes < 1:
        raise UserError('there is at least one episode', args.episodes, 'raise --episodes')
    checkpoint = _load(args.checkpoint, args.robot)
    houses = args.house or checkpoint.info['houses']
    rooms = args.rooms or checkpoint.info['rooms']
    results = measure(checkpoint, houses, rooms, episodes=args.episodes, seed=args.seed,
                      controls=not args.no_controls, decoding=args.decoding,
                      max_decisions=args.max_decisions, robot=args.robot,
                      randomisation=args.randomisation)
    show_results(results, f'{args.checkpoint} in house {", ".join(map(str, houses))}, '
                          f'{args.max_decisions} decisions at most')
    if args.json:
        args.json.write_text(json.dumps(results, indent=2))
    return 0


def show_results(results: dict, title: str) -> None:
    """Print figures as a table."""
    from rich.console import Console
    from rich.table import Table
    count = next(iter(results.values()))['episodes']
    table = Table(title=f'{title}, {count} episodes each')
    for heading in ('policy', 'success (95 %)', 'SPL', 'decisions', 'seconds', 'collisions',
                    'contact-free', 'stop error'):
        table.add_column(heading, justify='left' if heading == 'policy' else 'right',
                         no_wrap=True)
    for name, r in results.items():
        low, high = r['success_interval']
        table.add_row(name, f'{r["success"]:.2f} ({low:.2f}-{high:.2f})',
                      f'{r["spl"]:.2f}', f'{r["decisions"]:.0f}', f'{r["seconds"]:.0f}',
                      f'{r["collisions"]:.1%}', f'{r["contact_free_success"]:.2f}',
                      f'{r["stop_error_m"]:.2f} m {r["stop_error_deg"]:.0f} deg')
    console = Console()
    if not console.is_terminal:
        console.width = 120  # a file or a pipe has no width of its own
    console.print(table)


def run_publish(args) -> int:
    """`vn_nav publish`."""
    from vn_nav.policy.checkpoint import load_checkpoint, save_checkpoint
    checkpoint = _load(args.source, args.robot)
    info = {key: value for key, value in checkpoint.info.items() if key != 'sha256'}
    save_checkpoint(args.target, checkpoint.network, info, half=True)
    shipped = load_checkpoint(args.target)  # measure what ships: the rounded weights
    houses, rooms = info['houses'], info['rooms']
    info['results'] = {}
    for place, seeds in (('trained house', houses), (f'unseen house {args.unseen}',
                                                     [args.unseen])):
        results = measure(shipped, seeds, rooms, episodes=args.episodes, seed=10_000,
                          robot=args.robot)
        show_results(results, place)
        info['results'] |= {f'{place}: {name}': figures for name, figures in results.items()}
    info['notes'] += (f' Measured with `vn_nav publish`, {args.episodes} episodes a row, 300 '
                      f'decisions at most, motion noise on, on {machine()}, '
                      f'{datetime.date.today().isoformat()}. Figures are defined in '
                      'docs/architecture.md.')
    save_checkpoint(args.target, shipped.network, info, half=True)
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

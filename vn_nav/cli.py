"""The `vn_nav` command: the one place where simulator and stack meet."""

from __future__ import annotations

import argparse
import contextlib
import datetime
import math
import shlex
import sys
import time
from pathlib import Path

from vn_nav import __version__
from vn_nav.bags.command import add_bag_commands
from vn_nav.cli_scenes import run_simulators, training_scenes
from vn_nav.cli_world import add_world, check_backend, load_for_scenes, machine, make_env
from vn_nav.errors import UserError
from vn_nav.scenes import ROOMS


def build_parser(command: str | None = None) -> argparse.ArgumentParser:
    """The command line.

    Args:
        command: whose options are wanted; None: all. Those of training take torch along, which
            a look into a bag must not wait for.
    """
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
    if command in (None, 'train'):
        from vn_nav.learning.command import add_train_options
        add_world(train)
        add_train_options(train)
    train.set_defaults(run=run_train)

    collected = commands.add_parser(
        'collect', help='record pictures from random poses as a bag, for pre-training')
    add_world(collected)
    collected.add_argument('--houses', type=int, metavar='N', help='the first N training houses')
    collected.add_argument('--pictures', type=int, default=20_000,
                           help='in all (thesis, 5.7: 20,000)')
    collected.add_argument('--size', type=int, default=84, help='side of the pictures [pixels]')
    collected.add_argument('--threads', type=int, default=1, help='that draw')
    collected.add_argument('--out', type=Path, required=True, help='folder of the bag')
    collected.set_defaults(run=run_collect)

    pretrained = commands.add_parser('pretrain', help='pre-train a policy on recorded bags')
    if command in (None, 'pretrain'):
        from vn_nav.learning.pretrain_command import add_pretrain_options, run_pretrain
        add_pretrain_options(pretrained)
        pretrained.set_defaults(run=run_pretrain)

    taught = commands.add_parser(
        'teach', help='learn the place where a bag was driven, in its pictures')
    if command in (None, 'teach'):
        from vn_nav.learning.teach import add_teach_options
        add_teach_options(taught)
    taught.set_defaults(run=run_teach)

    measured = commands.add_parser('evaluate', help='measure a checkpoint')
    if command in (None, 'evaluate'):
        from vn_nav.cli_evaluate import run_evaluate
        from vn_nav.evaluation.command import add_evaluate_options
        measured.add_argument('checkpoint', type=Path)
        add_world(measured, defaults=False)
        add_evaluate_options(measured)
        measured.set_defaults(run=run_evaluate)

    compare = commands.add_parser('compare', help="plot several runs' learning curves")
    if command in (None, 'compare'):
        from vn_nav.evaluation.command import add_compare_options, run_compare
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

    listed = commands.add_parser('simulators', help='list the simulators, and what each can do')
    listed.set_defaults(run=run_simulators)

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


def run_collect(args) -> int:
    """`vn_nav collect`."""
    check_backend(args.backend)
    from vn_nav.bags.recorder import BagWriter
    from vn_nav.robot import RobotSpec, load_robot
    from vn_sim_bridge.datasets.collect import collect, house_scenes
    from vn_sim_bridge.render.randomisation import load_randomisation
    names = training_scenes(args)
    robot = load_robot(args.robot) if args.robot else RobotSpec()
    scenes = house_scenes(names, args.size, robot, load_randomisation(args.randomisation),
                          args.seed, args.threads)
    begun = time.monotonic()
    done = collect(scenes, len(names), args.pictures, robot,
                   lambda topics: BagWriter(args.out, topics))
    seconds = time.monotonic() - begun
    print(f'{args.out}: {done.pictures:,} pictures in {done.episodes:,} episodes of {done.scenes} '
          f'scene{"s" * (done.scenes > 1)}, {done.pictures / seconds:,.0f} pictures/s')
    return 0


def run_train(args) -> int:
    """`vn_nav train`."""
    from vn_nav.learning.command import check_train_options, train_config, world_options
    check_backend(args.backend)
    check_train_options(args)
    if args.env == 'ros':
        return _train_over_ros(args)
    from vn_nav.learning.trainer import train
    from vn_sim_bridge.navigation.env_config import PRIVILEGED
    scenes = training_scenes(args)
    config, world = train_config(args), world_options(args)
    env = make_env(scenes, world.pop('envs'), robot=args.robot, threads=config.threads,
                   randomisation=args.randomisation, size=args.size, seed=args.seed,
                   device=config.device,
                   actions=tuple(args.actions.split(',')), task=args.task,
                   objects=args.objects, goals_per_room=args.goals_per_room,
                   goal_variants=args.goal_variants,
                   privileged=tuple(sorted(set(config.privileged) & set(PRIVILEGED))), **world)
    bags = _bag_mix(args, config, env.robot)
    info = _train_info(args, config, env, bags) | {
        'simulator': env.simulator_name, 'scenes': scenes, 'randomisation': args.randomisation,
        'goals_per_room': args.goals_per_room, 'goal_variants': args.goal_variants,
        'task': args.task, 'objects': args.objects}
    pairs = None
    if config.pair_minutes and not args.init:
        pairs = _pair_sources(args, config)
    with contextlib.closing(env):
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
    from vn_nav.bags.roles import Topics, load_topics
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

    from vn_nav.learning.command import config_over_ros, train_config, world_options
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
            'simulator': env.simulator_name, 'scenes': env.scene_names}

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
        from vn_sim_bridge.datasets.house_pairs import PairSampler
        from vn_sim_bridge.houses.splits import SPLITS
        from vn_sim_bridge.render.randomisation import load_randomisation
        options = {'rooms': args.rooms or ROOMS, 'size': args.size, 'threads': config.threads,
                   'robot': load_robot(args.robot) if args.robot else None,
                   'randomisation': load_randomisation(args.randomisation)}
        return (PairSampler(SPLITS['train'][:config.pair_houses], seed=args.seed, **options),
                PairSampler(SPLITS['validation'][:16], seed=args.seed + 1, **options))
    return make


def run_teach(args) -> int:
    """`vn_nav teach`."""
    from vn_nav.learning.teach import teach
    from vn_sim_bridge import teach_place as place
    return teach(args, place)


def run_export(args) -> int:
    """`vn_nav export`."""
    from vn_nav.policy.checkpoint import load_checkpoint
    from vn_nav.policy.export import export_onnx
    for path in export_onnx(load_checkpoint(args.checkpoint), args.onnx):
        print(f'{path}: {path.stat().st_size / 1e6:.1f} MB')
    return 0


def run_publish(args) -> int:
    """`vn_nav publish`."""
    from vn_nav import cli_evaluate
    return cli_evaluate.run_publish(args)


def run_demo(args) -> int:
    """`vn_nav demo`."""
    from vn_nav.demo import run
    from vn_nav.resources import share_file
    folder = args.checkpoint or share_file('models/house')
    task = load_for_scenes(folder)[0].info['task']  # refuse before anything is written
    if task != 'image':
        raise UserError('the demo drives to the places of pictures: a checkpoint of task image',
                        task, 'use vn_nav evaluate')
    return run(args.out, folder, make_env=make_env, episodes=args.episodes,
               unseen_episodes=args.unseen_episodes)


def run_house_show(args) -> int:
    """`vn_nav house show`."""
    from vn_sim_bridge.houses.procedural import generate_house
    from vn_sim_bridge.render.randomisation import load_randomisation
    from vn_sim_bridge.tools.contact_sheet import write_contact_sheet
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
    from vn_sim_bridge.render.randomisation import load_randomisation
    from vn_sim_bridge.tools.walk import walk
    walk(generate_house(args.seed, rooms=args.rooms), load_randomisation(args.randomisation))
    return 0


def run_house_export(args) -> int:
    """`vn_nav house export`."""
    from vn_sim_bridge.houses.mesh_export import export_mesh
    from vn_sim_bridge.houses.procedural import generate_house
    house = generate_house(args.seed, rooms=args.rooms)
    path = args.out or Path(f'house-{args.seed}.glb')
    export_mesh(house.scene, path)
    print(f'{path}: {house.scene.triangle_count} triangles, {path.stat().st_size / 1e6:.1f} MB, '
          'parts named by class and instance')
    return 0


def main(argv: list[str] | None = None) -> int:
    """Entry point: 2 and one line on standard error for bad input."""
    words = sys.argv[1:] if argv is None else argv
    # The first word that is no option is the command: no option before it takes a value.
    command = next((word for word in words if not word.startswith('-')), '')
    args = build_parser(command).parse_args(words)
    try:
        return args.run(args)
    except UserError as error:
        print(f'vn_nav: {error}', file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return 130


if __name__ == '__main__':
    sys.exit(main())

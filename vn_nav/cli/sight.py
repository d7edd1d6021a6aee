"""`vn_nav train --preset search`: the networks of search, supervised, on picture pairs."""

from __future__ import annotations

import argparse
import contextlib
import datetime
import math

import torch

from vn_nav.cli.options import command_line
from vn_nav.cli.scenes import scenes_from, split_scenes
from vn_nav.cli.world import machine
from vn_nav.errors import UserError
from vn_nav.learning.precision import fast_dtype
from vn_nav.learning.presets import TrainConfig
from vn_nav.learning.sight_training import SightConfig, train_sight
from vn_nav.learning.stages import Stages
from vn_nav.policy.search.network import SearchPolicy
from vn_nav.policy.zhu_policy import build_policy
from vn_nav.scenes import HOUSE, one_simulator

VALIDATION_SCENES = 20
# Options of `vn_nav train` that have no meaning where nobody drives, and their defaults.
DRIVING = {
    'env': 'sim', 'lock_step': False, 'namespaces': None, 'record': None, 'ros_args': None,
    'bags': None, 'topics': None, 'cache': None, 'bag_share': None, 'goals_per_room': 1,
    'goal_variants': None, 'task': 'image', 'objects': 1, 'envs': None, 'max_decisions': None,
    'progress_reward': None, 'collision_reward': None, 'exploration_reward': None,
    'entropy_coefficient': None, 'final_entropy_coefficient': None, 'rollout_length': None,
    'epochs': None, 'minibatches': None, 'hidden': None, 'frozen_weights': None, 'scenes': None,
    'pair_minutes': None, 'curriculum': None, 'overlap': None,
}


def run(args: argparse.Namespace, config: TrainConfig) -> int:
    """Train, as the options and the preset with their changes say."""
    given = [name for name, default in DRIVING.items() if getattr(args, name) != default]
    if given:
        raise UserError('the preset search learns from picture pairs, nobody drives',
                        ' '.join(f'--{name.replace("_", "-")}' for name in given),
                        'leave these out')
    if config.device != 'cpu':
        raise UserError('the preset search learns on the processor', config.device,
                        'use --device cpu')
    from vn_nav.robot import load_robot
    from vn_sim_bridge.datasets.lenses import Lenses
    from vn_sim_bridge.datasets.pair_poses import RECOGNITION
    from vn_sim_bridge.datasets.view_pairs import PairSampler
    from vn_sim_bridge.render.randomisation import load_randomisation
    torch.set_num_threads(config.threads)
    scenes, others = _scenes(args, config)
    options = {'size': args.size, 'threads': config.threads, 'mix': RECOGNITION,
               'robot': load_robot(args.robot) if args.robot else None,
               'randomisation': load_randomisation(args.randomisation)}
    with contextlib.ExitStack() as open_now:
        print(f'opens {len(scenes)} scenes to learn from, and {len(others)} others to judge by',
              flush=True)
        many = args.cameras == 'many'
        source = PairSampler(scenes, seed=args.seed, lenses=Lenses() if many else None, **options)
        open_now.callback(source.simulator.close)
        validation = PairSampler(others, seed=args.seed + 1, **options)
        open_now.callback(validation.simulator.close)
        robot = source.robot.with_actions(args.actions.split(','))
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(config.seed)
            network = build_policy(config.network(
                robot.action_names, args.size, robot.moves, view=robot.camera_fov,
                footprint=robot.footprint_radius))
        assert isinstance(network, SearchPolicy)  # by the preset
        network.compute_dtype = (fast_dtype() if config.bf16 is None else
                                 torch.bfloat16 if config.bf16 else torch.float32)
        numbers = SightConfig(
            augment=many,
            pairs=config.frames, minutes=config.minutes, learning_rate=config.learning_rate,
            final_learning_rate=config.final_learning_rate,
            max_gradient_norm=config.max_gradient_norm,
            save_seconds=min(config.checkpoint_seconds, 30.0), seed=config.seed)
        simulator, _ = one_simulator(scenes)
        info = {
            'preset': args.preset, 'command': command_line(), 'simulator': simulator,
            'scenes': scenes, 'randomisation': args.randomisation,
            'camera_fov_deg': math.degrees(robot.camera_fov),
            'camera_height': robot.camera_height,
            'world_version': source.simulator.version,
            'data': f' of {len(scenes)} scenes, and {len(others)} others to judge by',
            'notes': f'Trained on {machine(config.device)}, {config.threads} thread(s), '
                     f'{datetime.date.today().isoformat()}. Held-out pairs are of pictures '
                     f'in {len(others)} scenes that it did not learn from.'}

        def page(rows, judged) -> str:
            from vn_nav.report.sight_page import sight_page
            return sight_page(rows, judged, name=args.out.name,
                              places=f'{len(others)} other scenes of the simulator {simulator}')
        stages = open_now.enter_context(Stages(config.minutes or math.inf))
        print(train_sight(network, source, validation, args.out, numbers, info=info,
                          resume=args.resume, init=args.init,
                          say=lambda line: print(line, flush=True),
                          on_step=lambda share: stages('learns to see', share), page=page))
    return 0


def _scenes(args: argparse.Namespace, config: TrainConfig) -> tuple[list[str], list[str]]:
    """Scenes to learn from, and scenes to judge by.

    Raises:
        UserError: scenes that are named, and a number of houses; or a simulator without a split to
            judge by.
    """
    from vn_sim_bridge.simulators import simulator_class
    if (args.house or args.scene) and args.houses:
        raise UserError('scenes are named, or the first N training houses',
                        '--scene or --house, and --houses', 'give one of them')
    scenes = scenes_from(args) or split_scenes(HOUSE, 'train', args.houses or config.pair_houses,
                                               args.rooms)
    simulator, _ = one_simulator(scenes)
    if 'validation' not in simulator_class(simulator).splits:
        raise UserError('what was learned is judged in scenes of a split validation',
                        f'the simulator {simulator}, which has none',
                        'train in houses, or in another simulator (vn_nav simulators)')
    return scenes, split_scenes(simulator, 'validation', VALIDATION_SCENES, args.rooms)

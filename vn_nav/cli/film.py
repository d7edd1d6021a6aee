"""`vn_nav film`: an episode of a policy that searches, with its map, as an animated GIF."""

from __future__ import annotations

import argparse
import contextlib
import math
from pathlib import Path

from vn_nav.cli.options import check_folders
from vn_nav.cli.world import load_for, make_env_for
from vn_nav.errors import UserError
from vn_nav.evaluation.evaluator import ARRIVAL, DECLARED, STOP_THRESHOLD, PolicyActor
from vn_nav.files import write_file
from vn_nav.scenes import HOUSE, parse_scene, scene_name
from vn_nav.vector_env import MeasuredVectorEnv

LOOKED_AT = 240  # pixels: side of the pictures that people see
UNSEEN_HOUSE = 'house:11000'  # of the split test


def add_options(parser: argparse.ArgumentParser) -> None:
    """Options of `vn_nav film`."""
    parser.add_argument('checkpoint', type=Path, help='a policy that searches, as models/search')
    parser.add_argument('--out', type=Path, default=Path('film.gif'), help='default film.gif')
    parser.add_argument('--scene', metavar='NAME', default=UNSEEN_HOUSE,
                        help=f'default {UNSEEN_HOUSE}, of the split test')
    parser.add_argument('--seed', type=int, default=10_000, help='another one, another episode')
    parser.add_argument('--stop', choices=(ARRIVAL, DECLARED), default=DECLARED,
                        help='what ends the episode (default: the policy says so)')
    parser.add_argument('--randomisation', metavar='NAME',
                        help='of light, camera and base (default: that of the training)')
    parser.add_argument('--max-decisions', type=int, default=300)
    parser.add_argument('--odometry', choices=('true', 'drift', 'commanded', 'none'))


def run(args: argparse.Namespace) -> int:
    """`vn_nav film`."""
    from vn_nav.evaluation.filming import film_episode
    from vn_nav.report.film import gif
    if args.out.suffix != '.gif':
        raise UserError('a film is a GIF: its name ends in .gif', str(args.out), 'correct --out')
    check_folders(args.out)
    checkpoint, _ = load_for(args.checkpoint)
    scene = scene_name(args.scene)

    def make(size: int | None = None) -> MeasuredVectorEnv:
        return make_env_for(
            checkpoint, [scene], 1, stop=args.stop, own=scene in checkpoint.info['scenes'],
            randomisation=args.randomisation, max_decisions=args.max_decisions,
            odometry=args.odometry, size=size)
    with contextlib.ExitStack() as opened:
        env = opened.enter_context(contextlib.closing(make()))
        # Elsewhere than in houses a second engine may cost more than larger pictures are worth.
        twin = (opened.enter_context(contextlib.closing(make(LOOKED_AT)))
                if parse_scene(scene).simulator == HOUSE else None)
        threshold = checkpoint.info['stop_threshold']
        actor = PolicyActor(env, checkpoint.network, checkpoint.info['decoding'], args.seed,
                            STOP_THRESHOLD if threshold is None else threshold,
                            camera_fov=math.radians(checkpoint.info['camera_fov_deg']))
        film = film_episode(env, actor, seed=args.seed, twin=twin)
    known = 'known' if scene in checkpoint.info['scenes'] else 'never seen before'
    e = film.episode
    data = gif(film, f'{args.checkpoint}, {scene} ({known}), to the {e.goal}')
    write_file(args.out, data)
    outcome = 'arrived' if e.success else 'false stop' if e.declared else 'gave up'
    print(f'{args.out}: {scene}, to the {e.goal}: {outcome} after {e.decisions} decisions, '
          f'{e.path_length:.1f} m, shortest way {e.start_distance:.1f} m, end '
          f'{e.stop_distance:.2f} m and {math.degrees(e.stop_heading):.0f} deg from the goal; '
          f'{len(data) / 1e6:.1f} MB')
    return 0

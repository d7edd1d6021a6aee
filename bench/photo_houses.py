"""What cameras cost a policy of the architecture search, one change at a time, in houses.

    python bench/photo_houses.py --checkpoint models/search

The same figures as `photographs.py`, of views at random poses of houses of the simulator, all
pairs of a house. From the known camera to the one of hand-held photographs: lens, format, height,
pitch. What is left between the last row and photographs is the look.
"""

from __future__ import annotations

import argparse
import math
import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from photographs import Pairs, judge, look, print_table

from vn_nav.co_visibility import co_visible, lift, relative_pose
from vn_nav.errors import UserError
from vn_nav.lens import zoom_of
from vn_nav.policy.checkpoint import load_checkpoint
from vn_nav.policy.search.network import SearchPolicy
from vn_nav.resources import share_file
from vn_nav.scenes import house_scenes
from vn_sim_bridge.counter_random import Stream, key
from vn_sim_bridge.datasets.lenses import cut
from vn_sim_bridge.datasets.view_pairs import PairSampler
from vn_sim_bridge.render.randomisation import load_randomisation

HOUSES, ROOMS = (10_001, 10_002, 10_003), 3  # of the split validation
VIEWS = 80  # of a house
BATCH = 2000  # pairs
PITCH_DEG, SWAY_DEG = 22.0, 10.0  # of the photographs of a head-set: mean, deviation


class Kind(NamedTuple):
    """A camera: horizontal field of view [deg], height of its picture in widths, m, pitch."""

    fov_deg: float = 90.0
    aspect: float = 1.0
    height: float = 1.0
    pitch_deg: float = 0.0
    sway_deg: float = 0.0


KINDS = {
    'known': Kind(), 'lens 57 deg': Kind(57.0), 'and 2:3': Kind(57.0, 2 / 3),
    'and 1.6 m high': Kind(57.0, 2 / 3, 1.6),
    'and 22 deg down': Kind(57.0, 2 / 3, 1.6, PITCH_DEG),
    'and swayed': Kind(57.0, 2 / 3, 1.6, PITCH_DEG, SWAY_DEG),
    'known, 1.6 m high': Kind(height=1.6), 'known, 22 deg down': Kind(pitch_deg=PITCH_DEG),
}


def views_of(sampler: PairSampler, kind: Kind, seed: int) -> tuple[np.ndarray, Pairs]:
    """Pictures of random poses in the sampler's one house, and all their pairs."""
    random = np.random.default_rng(seed)
    cells = sampler.places[0].floor.centres()
    poses = np.zeros((VIEWS, 4))
    poses[:, :2] = cells[random.integers(len(cells), size=VIEWS)]
    poses[:, 2] = random.uniform(-math.pi, math.pi, VIEWS)
    poses[:, 3] = np.radians(kind.pitch_deg + kind.sway_deg * random.standard_normal(VIEWS))
    numbers, none = np.arange(VIEWS), np.zeros(VIEWS, np.int64)
    simulator, robot = sampler.simulator, sampler.robot
    light = simulator.appearance(seed, Stream.PAIR_APPEARANCE, numbers, none)
    light = light._replace(fov=light.fov + math.radians(kind.fov_deg) - robot.camera_fov,
                           height=light.height + kind.height - robot.camera_height)
    frames = simulator.view(none, poses, None, light,
                            key(seed, Stream.PAIR_SENSOR, numbers, none))
    cut(frames, np.full(VIEWS, kind.aspect))
    cameras, fov = simulator.cameras(poses, light)
    points = lift(frames.depth, cameras, fov)
    first, second = np.nonzero(~np.eye(VIEWS, dtype=bool))
    overlap = np.concatenate([
        co_visible(points[other], frames.depth[own], cameras[own], fov[own])
        for own, other in zip(*(np.split(part, range(BATCH, len(part), BATCH))
                                for part in (first, second)), strict=True)])
    shares = np.zeros((VIEWS, VIEWS))
    shares[first, second] = overlap
    return frames.rgb, Pairs(numbers, first, second, overlap,
                             (overlap == 0) & (shares[second, first] == 0),
                             relative_pose(poses[first], poses[second]))


def run(options: argparse.Namespace) -> None:
    """All kinds of cameras in all houses; means over the houses."""
    torch.set_num_threads(1)
    networks = {str(path): load_checkpoint(path).network for path in options.checkpoint}
    for name, network in networks.items():
        if not isinstance(network, SearchPolicy):
            raise UserError('cameras are compared for policies of the architecture search', name,
                            'give another checkpoint')
    found: dict[str, list[dict[str, float]]] = {}
    for seed in HOUSES:
        sampler = PairSampler(house_scenes((seed,), ROOMS), size=options.size,
                              randomisation=load_randomisation('standard'))
        for title, kind in KINDS.items():
            images, pairs = views_of(sampler, kind, seed)
            for name, network in networks.items():
                zoom = zoom_of(math.radians(kind.fov_deg), network.config.view)
                said = look(network, images, pairs, zoom)
                found.setdefault(f'{name}: {title}', []).append(judge(
                    pairs, said.co_visible.numpy(), said.position.numpy(), said.heading.numpy(),
                    said.co_visible.numpy() > 0, said.arrived.numpy()))
        sampler.simulator.close()
    print_table({title: {name: float(np.mean([row[name] for row in rows])) for name in rows[0]}
                 for title, rows in found.items()})


def main() -> int:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__.split('\n')[0])
    parser.add_argument('--checkpoint', type=Path, nargs='+',
                        default=[share_file('models/search')])
    parser.add_argument('--size', type=int, default=64, help='of the pictures [pixels]')
    try:
        run(parser.parse_args())
    except UserError as error:
        print(error, file=sys.stderr)
        return 2
    return 0


if __name__ == '__main__':
    sys.exit(main())

"""Which encoder learns where the goal stands? Picture pairs, equal minutes, unseen houses.

    python bench/pairs.py --minutes 4 --json runs/pairs.json
    python bench/pairs.py --only matching --minutes 4

Each encoder learns from pairs of the first training houses for so many minutes of one core,
drawing included, one after the other, and is then measured on the same pairs of 32 validation
houses: by distance, and by how much of the goal picture is in view. A bearing is the direction of
the goal's place; recall is how often it says that the pictures overlap.
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile
from pathlib import Path

import numpy as np
import torch
from common import pin

from vn_nav.cli.world import machine
from vn_nav.learning.pairs import PairConfig, look, pretrain_pairs
from vn_nav.policy.network import Policy
from vn_nav.policy.network_config import NetworkConfig
from vn_nav.robot import DRIVE_ACTIONS
from vn_nav.scenes import house_scenes
from vn_sim_bridge.datasets.view_pairs import PairSampler
from vn_sim_bridge.houses.splits import SPLITS
from vn_sim_bridge.render.randomisation import load_randomisation

ENCODERS = {
    'fused': {'architecture': 'fused', 'channels': (32, 64, 64)},
    'fused, residual': {'architecture': 'fused', 'channels': (32, 64, 64), 'blocks': 1},
    'matching': {'architecture': 'matching', 'channels': (32, 64, 32), 'blocks': 1},
}
DISTANCES = (0.3, 1.0, 2.0, 3.0, 6.0)  # m
IN_VIEW = (0.1, 0.25, 0.5, 1.01)  # share of the goal picture
MEASURED = 4096  # pairs


def main():
    """Train and measure, then print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--only', nargs='+', choices=tuple(ENCODERS), default=list(ENCODERS))
    parser.add_argument('--minutes', type=float, default=4.0)
    parser.add_argument('--houses', type=int, default=128)
    parser.add_argument('--size', type=int, default=64)
    parser.add_argument('--json', type=Path)
    arguments = parser.parse_args()
    pin(1)
    torch.set_num_threads(1)
    result = {'machine': machine(), 'minutes': arguments.minutes, 'encoders': {}}
    for name in arguments.only:
        result['encoders'][name] = row = train(ENCODERS[name], arguments)
        last = row['last']
        print(f'{name}: {last["pairs"]:,.0f} pictures, '
              f'{row["parameters"]:,} parameters of the encoder\n  all pairs in view: bearing '
              f'{last["validation_bearing_deg"]:.0f} deg, within 30 deg '
              f'{last["validation_bearing_within_30"]:.0%}, heading '
              f'{last["validation_heading_deg"]:.0f} deg, overlap right '
              f'{last["validation_overlap_accuracy"]:.0%}', flush=True)
        for line in row['table']:
            print('  {in_view} in view, {distance} m: {pairs} pairs, bearing {bearing_deg:.0f} '
                  'deg, recall {recall:.0%}'.format(**line), flush=True)
        print(f'  says so of pictures that share next to nothing: {row["false_positives"]:.0%}')
    if arguments.json:
        arguments.json.write_text(json.dumps(result, indent=1))


def train(network: dict, arguments) -> dict:
    """One encoder's figures."""
    options = {'size': arguments.size, 'randomisation': load_randomisation('standard')}
    source = PairSampler(house_scenes(SPLITS['train'][:arguments.houses]), seed=1, **options)
    validation = PairSampler(house_scenes(SPLITS['validation'][:32]), seed=2, **options)
    torch.manual_seed(0)
    policy = Policy(NetworkConfig(DRIVE_ACTIONS, size=arguments.size, features=512,
                                  heads=('goal_pose',), **network))
    policy.compute_dtype = torch.bfloat16
    rows = []
    with tempfile.TemporaryDirectory(dir=os.environ.get('TMPDIR')) as folder:
        pretrain_pairs(policy, source, validation, Path(folder),
                       PairConfig(minutes=arguments.minutes), rows.append)
    return {'last': rows[-1], 'parameters': sum(p.numel() for p in policy.encoder.parameters()),
            **measure(policy, validation)}


@torch.no_grad()
def measure(policy: Policy, validation: PairSampler) -> dict:
    """Errors by distance and by share in view."""
    validation.count = 10**6  # none of those that the training was watched by
    found = {name: [] for name in ('position', 'overlap', 'truth', 'share')}
    for _ in range(0, MEASURED, 256):
        pairs = validation.draw(256)
        pose, _ = look(policy, np.concatenate([pairs['image'], pairs['goal']]), np.arange(256),
                       np.arange(256, 512))
        for name, rows in (('position', pose.position), ('overlap', pose.co_visible),
                           ('truth', pairs['goal_pose'][:, :2]), ('share', pairs['overlap'])):
            found[name].append(np.asarray(rows))
    position, overlap, truth, share = (np.concatenate(rows) for rows in found.values())
    distance = np.hypot(*truth.T)
    bearing = np.degrees(np.abs(np.angle(
        (position[:, 0] + 1j * position[:, 1]) * (truth[:, 0] - 1j * truth[:, 1]))))
    table = []
    for low, high in zip(IN_VIEW, IN_VIEW[1:], strict=False):
        for near, far in zip(DISTANCES, DISTANCES[1:], strict=False):
            own = (share >= low) & (share < high) & (distance >= near) & (distance < far)
            table.append({
                'in_view': f'{low:.0%}-{min(high, 1):.0%}', 'distance': f'{near:g}-{far:g}',
                'pairs': int(own.sum()), 'bearing_deg': float(np.median(bearing[own])),
                'recall': float((overlap[own] > 0).mean())})
    return {'table': table, 'false_positives': float((overlap[share < 0.02] > 0).mean())}


if __name__ == '__main__':
    main()

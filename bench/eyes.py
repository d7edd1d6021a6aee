"""What the networks of search see of picture pairs in houses that they did not learn from.

    python bench/eyes.py models/search
    python bench/eyes.py models/search runs/search/checkpoint --groups 3000

Each checkpoint with and without mirror images, on the same pairs of the mixture `recognition` in
20 houses of the split validation: medians of errors, areas under ROCs. Prints a Markdown table.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import torch

from vn_nav.cli.scenes import split_scenes
from vn_nav.cli.world import load_for
from vn_nav.errors import UserError
from vn_nav.learning.sight_figures import figures, judge
from vn_nav.policy.search.look import column_bearings
from vn_nav.policy.search.network import SearchPolicy
from vn_nav.report import tables
from vn_sim_bridge.datasets.pair_poses import RECOGNITION
from vn_sim_bridge.datasets.view_pairs import PairSampler
from vn_sim_bridge.render.randomisation import load_randomisation

SHOWN = {  # column, digits
    'loss': ('loss', 2), 'co_visible_auc': ('in view, AUC', 3), 'arrived_auc': ('arrived, AUC', 3),
    'arrived_ring_auc': ('in the ring', 3), 'bearing_deg': ('bearing [deg]', 1),
    'heading_deg': ('heading [deg]', 1), 'far_position_m': ('beyond 1.5 m, position [m]', 2),
    'position_m_quarter': ('a quarter in view [m]', 2), 'position_m_half': ('a half [m]', 2),
    'range_error': ('ranges', 3)}


def rows(checkpoint: Path, groups: int, seed: int) -> list[list[str]]:
    """Of one checkpoint: name, whether mirrored, and `SHOWN`."""
    loaded, _ = load_for(checkpoint)
    network = loaded.network
    if not isinstance(network, SearchPolicy):
        raise UserError('these eyes are of the architecture search', loaded.config.architecture,
                        'choose another checkpoint')
    sampler = PairSampler(split_scenes(loaded.info['simulator'], 'validation', 20, None),
                          size=network.config.size, mix=RECOGNITION, seed=seed,
                          randomisation=load_randomisation(loaded.info['randomisation']))
    batch = sampler.draw_groups(groups, 1, bearings=column_bearings(network.config.view))
    sampler.simulator.close()
    found = []
    for mirror in (False, True):
        seen = figures(judge(network, batch, mirror))
        found.append([str(checkpoint), 'yes' if mirror else 'no',
                      *(f'{seen[name]:.{digits}f}' for name, (_, digits) in SHOWN.items())])
    return found


def main() -> int:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__.split('\n')[0])
    parser.add_argument('checkpoints', nargs='+', type=Path)
    parser.add_argument('--groups', type=int, default=1500, help='of two pairs each')
    parser.add_argument('--seed', type=int, default=5)
    options = parser.parse_args()
    torch.set_num_threads(1)
    lines = [['checkpoint', 'mirrored', *(title for title, _ in SHOWN.values())]]
    lines.append(['---'] * len(lines[0]))
    try:
        for checkpoint in options.checkpoints:
            lines += rows(checkpoint, options.groups, options.seed)
    except UserError as error:
        print(f'bench/eyes.py: {error}', file=sys.stderr)
        return 2
    print(tables.markdown(lines))
    return 0


if __name__ == '__main__':
    sys.exit(main())

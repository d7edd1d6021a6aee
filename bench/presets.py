"""Frames a second of whole trainings, preset by preset: collecting and learning, all heads.

    python bench/presets.py --threads 2

House 3 with two rooms, 84 x 84, the preset's own environments, steps and replay; after the replay
memory has something to draw from. In turns: fp32 and bfloat16, each with all threads in every
operation and, where there are two, with one that collects while the other learns. One JSON line a
figure, with the share of time that learning waits for collecting.
"""

from __future__ import annotations

import argparse
import itertools
import tempfile
import time
from pathlib import Path

import numpy as np
import torch
from common import pin, report

from vn_nav.learning.distributed import Processes
from vn_nav.learning.presets import ENVIRONMENT, preset
from vn_nav.learning.training import Training
from vn_sim_bridge.navigation.env import NavigationEnv
from vn_sim_bridge.navigation.env_config import PRIVILEGED, EnvConfig

WARM_UP = 4  # updates


def begun(name: str, bf16: bool, overlap: bool, threads: int, folder: Path) -> Training:
    """A training of a preset, past its warm-up."""
    config = preset(name, bf16=bf16, overlap=overlap, threads=1 if overlap else threads,
                    pair_minutes=0.0)
    world = dict(ENVIRONMENT[name])
    env = NavigationEnv(EnvConfig(
        scenes=('house:3?rooms=2',), num_envs=world.pop('envs'),
        privileged=tuple(sorted(set(config.privileged) & set(PRIVILEGED))), **world),
        threads=config.threads)
    training = Training(env, config, folder, {}, Processes())
    training.start(resume=False, init=None, pairs=None)
    for _ in range(WARM_UP):
        training.update()
    return training


def main():
    """Measure in turns."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--presets', nargs='+', default=['thesis', 'unreal', 'a2c', 'fast'])
    parser.add_argument('--threads', type=int, default=2)
    parser.add_argument('--rounds', type=int, default=7)
    parser.add_argument('--updates', type=int, default=3, help='a round')
    arguments = parser.parse_args()
    pin(arguments.threads)
    ways = list(itertools.product((False, True), (False, True)[:min(arguments.threads, 2)]))
    for name in arguments.presets:
        with tempfile.TemporaryDirectory() as folder:
            trainings = {way: begun(name, *way, arguments.threads, Path(folder) / str(way))
                         for way in ways}
            rows = {way: [] for way in ways}
            for _ in range(arguments.rounds):
                for way, training in trainings.items():
                    torch.set_num_threads(training.config.threads)
                    frames, start = training.frames, time.perf_counter()
                    own = [training.update() for _ in range(arguments.updates)]
                    seconds = time.perf_counter() - start
                    waited = sum(row['collect_seconds'] for row in own)
                    rows[way].append(((training.frames - frames) / seconds, waited / seconds))
        for (bf16, overlap), training in trainings.items():
            rates, shares = np.transpose(rows[bf16, overlap])
            report(f'training, preset {name}, {"bf16" if bf16 else "fp32"}'
                   f'{", overlapped" if overlap else ""}', rates,
                   f'{training.env.num_envs} environments x {training.config.rollout_length} '
                   f'steps, 84 x 84, {arguments.threads} thread(s), '
                   f'{np.median(shares):.0%} collecting')


if __name__ == '__main__':
    main()

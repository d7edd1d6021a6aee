"""Frames a second of whole trainings, preset by preset: collecting and learning, all heads.

    python bench/presets.py --threads 2

House 3 with two rooms, 84 x 84, the preset's own environments, steps and replay; after the replay
memory has something to draw from. One JSON line a figure, with the share of time that goes into
collecting. fp32 and bfloat16 take turns.
"""

from __future__ import annotations

import argparse
import time

import numpy as np
import torch
from common import pin, report

from vn_nav.learning.learner import Learner
from vn_nav.learning.presets import ENVIRONMENT, preset
from vn_nav.learning.replay import Replay
from vn_nav.learning.rollout import Collector
from vn_nav.policy.network import Policy
from vn_sim_bridge.env import PRIVILEGED, EnvConfig, NavigationEnv

WARM_UP = 4  # updates


class Training:
    """One preset's loop.

    Args:
        name: of the preset; dtype: of its matrix products; threads: of renderer and torch.
    """

    def __init__(self, name: str, dtype: torch.dtype, threads: int):
        config = preset(name)
        world = dict(ENVIRONMENT[name])
        env = NavigationEnv(EnvConfig(
            houses=(3,), rooms=2, num_envs=world.pop('envs'),
            privileged=tuple(sorted(set(config.privileged) & set(PRIVILEGED))), **world),
            threads=threads)
        torch.manual_seed(0)
        self.network = Policy(config.network(tuple(env.action_names), 84))
        self.network.compute_dtype = dtype
        generator = torch.Generator().manual_seed(0)
        replay = None
        if config.from_replay:
            replay = Replay(
                config.replay_steps // env.num_envs, env.num_envs, 84, torch.from_numpy(env.goals),
                privileged=tuple(key for key in config.privileged
                                 if key in ('depth', 'segmentation')),
                goal_segmentation=(torch.from_numpy(env.goal_segmentation)
                                   if 'goal_segmentation' in config.privileged else None))
        self.learner = Learner(self.network, config, generator, replay=replay)
        self.collector = Collector(env, self.network, generator, config.privileged)
        self.collector.begin(0)
        self.steps = config.rollout_length
        self.envs = env.num_envs

    def update(self) -> tuple[int, float, float]:
        """Frames, seconds of collecting, seconds of learning."""
        begun = time.perf_counter()
        rollout, _ = self.collector.collect(self.steps)
        middle = time.perf_counter()
        self.learner.update(rollout)
        return rollout.frames, middle - begun, time.perf_counter() - middle


def main():
    """Measure in turns."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--presets', nargs='+', default=['thesis', 'unreal', 'a2c', 'fast'])
    parser.add_argument('--threads', type=int, default=2)
    parser.add_argument('--rounds', type=int, default=7)
    parser.add_argument('--updates', type=int, default=3, help='a round')
    arguments = parser.parse_args()
    pin(arguments.threads)
    torch.set_num_threads(arguments.threads)
    for name in arguments.presets:
        rows = {word: Training(name, dtype, arguments.threads) for word, dtype in
                (('fp32', torch.float32), ('bf16', torch.bfloat16))}
        rates = {word: [] for word in rows}
        shares = {word: [] for word in rows}
        for training in rows.values():
            for _ in range(WARM_UP):
                training.update()
        for _ in range(arguments.rounds):
            for word, training in rows.items():
                done = np.array([training.update() for _ in range(arguments.updates)])
                frames, collecting, learning = done.sum(0)
                rates[word].append(frames / (collecting + learning))
                shares[word].append(collecting / (collecting + learning))
        for word, training in rows.items():
            report(f'training, preset {name}, {word}', rates[word],
                   f'{training.envs} environments x {training.steps} steps, 84 x 84, '
                   f'{arguments.threads} thread(s), {np.median(shares[word]):.0%} collecting')


if __name__ == '__main__':
    main()

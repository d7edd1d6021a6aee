"""Decisions per second of our training, end to end, compared with other recurrent PPO loops.

One environment, one network (same weights, same outputs: checked first), same rollouts, epochs,
minibatches, one thread; in turns, pinned to one core. RecurrentPPO lives in an environment of its
own, see bench/requirements.txt; without it its rows are left out.

    python bench/train.py [--peers runs/peers/bin/python]
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import torch
from common import pin, report
from peers_train import (
    CHANNELS,
    CLIP,
    ENTROPY,
    ENVS,
    EPOCHS,
    FEATURES,
    GAMMA,
    HIDDEN,
    LAMBDA,
    MAX_NORM,
    MINIBATCHES,
    PIXEL_MEAN,
    PIXEL_STD,
    RATE,
    STEPS,
    UPDATES,
    VALUE,
    PlainLoop,
    PlainNetwork,
    StackedEnv,
    last_action_and_reward,
    make_env,
    map_side,
)

from vn_nav.learning.learner import Learner
from vn_nav.learning.learner_config import LearnerConfig
from vn_nav.learning.rollout import Collector
from vn_nav.policy.network import Policy
from vn_nav.policy.network_config import NetworkConfig

ROUNDS = 7
SAMPLE = 8  # environments whose rollout the networks are compared on
CONDITIONS = (f'{ENVS} environments x {STEPS} steps, {EPOCHS} epochs x {MINIBATCHES} minibatches, '
              f'84 x 84, channels {CHANNELS}, LSTM {HIDDEN}, one thread, {UPDATES} rollouts and '
              'updates a round, image goals in one house of six rooms')


class Ours:
    """Our collector and learner."""

    def __init__(self, dtype: torch.dtype):
        env = make_env()
        self.network = our_network(env)
        self.network.compute_dtype = dtype
        generator = torch.Generator().manual_seed(0)
        self.collector = Collector(env, self.network, generator)
        self.collector.begin(0)
        self.learner = Learner(self.network, LearnerConfig(
            learning_rate=RATE, gamma=GAMMA, lam=LAMBDA, clip=CLIP, epochs=EPOCHS,
            minibatches=MINIBATCHES, value_coefficient=VALUE, entropy_coefficient=ENTROPY,
            max_gradient_norm=MAX_NORM), generator)

    def update(self) -> int:
        """One rollout and its epochs; the number of decisions (reset rows are none)."""
        rollout, _ = self.collector.collect(STEPS)
        self.learner.update(rollout, 0.0)
        return rollout.frames


def our_network(env) -> Policy:
    """The network of the comparison."""
    torch.manual_seed(0)
    return Policy(NetworkConfig(
        actions=tuple(env.action_names), size=env.config.size, channels=CHANNELS,
        features=FEATURES, hidden=HIDDEN, pixel_mean=PIXEL_MEAN, pixel_std=PIXEL_STD))


def plain_weights(network: Policy) -> dict:
    """Our weights under the names, and in the layout, of `PlainNetwork`."""
    own = network.state_dict()
    side = map_side(network.config.size)  # our trunk reads the maps as [row, column, channel]
    own['encoder.trunk.weight'] = own['encoder.trunk.weight'].view(
        FEATURES, side, side, -1).permute(0, 3, 1, 2).flatten(1)

    def gates(rows):  # input, forget, output, cell -> input, forget, cell, output
        i, f, o, g = rows.chunk(4)
        return torch.cat([i, f, g, o])
    memory = {'weight_ih_l0': gates(own['memory.input_weight']),
              'weight_hh_l0': gates(own['memory.recurrent_weight']),
              'bias_ih_l0': gates(own['memory.bias']),
              'bias_hh_l0': torch.zeros_like(own['memory.bias'])}
    layers = {'encoder.layers.0': 'encoder.first.conv', 'encoder.layers.2': 'encoder.conv2',
              'encoder.layers.4': 'encoder.conv3', 'encoder.layers.7': 'encoder.trunk',
              'actor': 'actor', 'critic': 'critic'}
    return {**{f'lstm.{name}': rows for name, rows in memory.items()},
            **{f'{theirs}.{part}': own[f'{ours}.{part}']
               for theirs, ours in layers.items() for part in ('weight', 'bias')}}


def make_sample() -> dict:
    """A rollout of our network as the peers see it, with our values and log-probabilities."""
    env = make_env()
    network = our_network(env)
    with torch.no_grad():
        network.actor.weight *= 100  # as it starts, all actions are almost alike
    collector = Collector(env, network, torch.Generator().manual_seed(0))
    collector.begin(0)
    env._step[:] = env.config.max_decisions - torch.arange(ENVS).numpy() % STEPS  # ends inside
    collector.collect(STEPS)  # a memory that is not zero
    env._step[:] = env.config.max_decisions - torch.arange(ENVS).numpy() % STEPS
    rollout, _ = collector.collect(STEPS)
    seen = rollout.observation
    goals = seen.goals[seen.goal_index[:-1, :SAMPLE]]
    return {
        'weights': plain_weights(network),
        'picture': torch.cat([seen.image[:-1, :SAMPLE], goals], dim=2).contiguous(),
        'extra': last_action_and_reward(seen.last_action[:-1, :SAMPLE],
                                        seen.last_reward[:-1, :SAMPLE], len(env.action_names)),
        'starts': rollout.starts[:-1, :SAMPLE],
        'state': tuple(part[:SAMPLE].unsqueeze(0).contiguous() for part in rollout.state),
        'action': rollout.action[:, :SAMPLE],
        'value': rollout.value[:-1, :SAMPLE],
        'log_probability': rollout.log_probability[:, :SAMPLE],
    }


@torch.no_grad()
def plain_difference(network: PlainNetwork, sample: dict) -> float:
    """Largest difference of its values and log-probabilities from ours, with our weights."""
    network.load_state_dict(sample['weights'])
    flat = {name: sample[name].flatten(0, 1) for name in (
        'picture', 'extra', 'starts', 'action', 'value', 'log_probability')}
    logits, value, _ = network(flat['picture'], flat['extra'], flat['starts'], sample['state'])
    chance = torch.log_softmax(logits, -1).gather(1, flat['action'].unsqueeze(1)).squeeze(1)
    return max(float((value - flat['value']).abs().max()),
               float((chance - flat['log_probability']).abs().max()))


class Peer:
    """RecurrentPPO, in a process of its own."""

    def __init__(self, python: Path, sample: Path):
        here = Path(__file__).absolute()
        self.process = subprocess.Popen(
            [python.absolute(), here.with_name('peers_train.py'), sample], text=True,
            env=os.environ | {'PYTHONPATH': str(here.parents[1])}, stdin=subprocess.PIPE,
            stdout=subprocess.PIPE)
        line = self.process.stdout.readline()
        if not line:
            sys.exit(f'bench/train.py: RecurrentPPO did not start (exit code '
                     f'{self.process.wait()})')
        self.difference = json.loads(line)['difference']

    def rate(self) -> float:
        """Decisions a second."""
        self.process.stdin.write('measure\n')
        self.process.stdin.flush()
        return json.loads(self.process.stdout.readline())


def rate(loop) -> float:
    """Decisions a second of some rollouts and updates."""
    begun = time.perf_counter()
    decisions = sum(loop.update() for _ in range(UPDATES))
    return decisions / (time.perf_counter() - begun)


def main():
    """Check that the networks are one, measure in turns, then print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--rounds', type=int, default=ROUNDS)
    parser.add_argument('--peers', type=Path, default=Path('runs/peers/bin/python'))
    arguments = parser.parse_args()
    pin(1)
    torch.set_num_threads(1)
    sample = make_sample()
    env = StackedEnv(make_env())
    plain = PlainNetwork(env.count, map_side(env.env.config.size))
    differences = {'CleanRL-style loop': plain_difference(plain, sample)}
    ours = {'fp32': Ours(torch.float32), 'bf16': Ours(torch.bfloat16)}
    loop = PlainLoop(env, plain)
    for warm in (*ours.values(), loop):
        rate(warm)
    runs = {'fp32': lambda: rate(ours['fp32']), 'CleanRL-style loop': lambda: rate(loop),
            'bf16': lambda: rate(ours['bf16'])}
    if arguments.peers.exists():
        with tempfile.NamedTemporaryFile(suffix='.pt') as file:
            torch.save(sample, file.name)
            peer = Peer(arguments.peers, Path(file.name))
        differences['RecurrentPPO'] = peer.difference
        runs['RecurrentPPO'] = peer.rate
    else:
        print(f'bench/train.py: no RecurrentPPO ({arguments.peers}, see bench/requirements.txt)',
              file=sys.stderr)
    for name, difference in differences.items():
        if not difference < 1e-4:
            sys.exit(f'bench/train.py: the network of {name} differs from ours by {difference}')
    values = {name: [] for name in runs}
    for _ in range(arguments.rounds):
        for name, run in runs.items():
            values[name].append(run())
    for name, difference in differences.items():
        report(f'network: largest difference of value and log-probability from {name}',
               [difference * 1e6], f'same weights, {STEPS} steps of {SAMPLE} environments with '
               'resets inside', unit='1e-6')
    for dtype in ours:
        for name in differences:
            report(f'training: {dtype}', values[dtype], CONDITIONS, unit='decisions/s', peer=name,
                   peer_values=values[name])


if __name__ == '__main__':
    main()

"""The recurrent PPO loops that bench/train.py compares with.

`PlainLoop` is the plain way to write one: the goal stacked under every picture, rollouts in
tensors, nn.LSTM stepped through time. sb3-contrib's RecurrentPPO runs in an environment of its
own (bench/requirements.txt), as this file's main program: it receives on standard input when to
"""

import argparse
import json
import os
import sys
import time

import numpy as np
import torch
from torch import nn
from torch.distributions import Categorical

from vn_sim_bridge.counter_random import Stream, key
from vn_sim_bridge.navigation.env import NavigationEnv
from vn_sim_bridge.navigation.env_config import EnvConfig

ENVS, STEPS = 64, 32  # of a rollout
EPOCHS, MINIBATCHES = 2, 4
UPDATES = 2  # rollouts and updates of a measurement
CHANNELS, FEATURES, HIDDEN = (16, 32, 64), 256, 256
PIXEL_MEAN, PIXEL_STD = 120.0, 36.0
RATE, GAMMA, LAMBDA, CLIP, MAX_NORM = 4e-4, 0.99, 0.95, 0.2, 0.5
VALUE, ENTROPY = 0.5, 0.01  # coefficients of the loss


def make_env() -> NavigationEnv:
    """The environment of every loop."""
    return NavigationEnv(EnvConfig(scenes=('house:7?rooms=6',), num_envs=ENVS, progress_reward=1.0,
                                   collision_reward=-0.02))


class StackedEnv:
    """`NavigationEnv` as the peers want it: goals stacked, a new episode in the same step.

    Only the pictures of new episodes are drawn a second time.
    """

    def __init__(self, env: NavigationEnv):
        self.env, self.count = env, len(env.action_names)

    def reset(self, seed: int) -> dict:
        """First observations of every environment."""
        return self._stacked(self.env.reset(seed=seed)[0])

    def step(self, actions):
        """Observations, rewards, dones, truncations; last observations {environment: ...}."""
        env = self.env
        observation, reward, terminated, truncated, _ = env.step(actions)
        stacked, done = self._stacked(observation), terminated | truncated
        last, ended = {}, np.nonzero(done)[0]
        if len(ended):
            last = {n: {name: rows[n].copy() for name, rows in stacked.items()} for n in ended}
            env._begin(ended)
            env._done[ended] = False
            seeds, numbers, episodes = env._counters(ended)
            frames = env.simulator.observe(ended, key(seeds, Stream.SENSOR, numbers, episodes,
                                                      env._step[ended]))
            stacked['picture'][ended, :3] = frames.rgb
            stacked['picture'][ended, 3:] = env.goals[env._shown_goal[ended]]
            stacked['extra'][ended] = 0.0
        return stacked, reward, done, truncated, last

    def _stacked(self, observation: dict) -> dict:
        extra = last_action_and_reward(torch.from_numpy(observation['last_action']),
                                       torch.from_numpy(observation['last_reward']), self.count)
        goals = self.env.goals[observation['goal_index']]
        return {'picture': np.concatenate([observation['image'], goals], axis=1),
                'extra': extra.numpy()}


def last_action_and_reward(action, reward, count: int):
    """What the LSTM gets besides features: one-hot action (zeros for -1) and clipped reward."""
    one_hot = (action.unsqueeze(-1) == torch.arange(count)).float()
    return torch.cat([one_hot, reward.clamp(-1, 1).unsqueeze(-1)], dim=-1)


class Encoder(nn.Module):
    """Features [N,F+A+1] of stacked pictures [N,6,S,S] and last actions and rewards [N,A+1]."""

    def __init__(self, extra: int, maps: int):
        super().__init__()
        first, second, third = CHANNELS
        self.extra = extra
        self.layers = nn.Sequential(
            nn.Conv2d(6, first, 8, 4), nn.ReLU(), nn.Conv2d(first, second, 4, 2), nn.ReLU(),
            nn.Conv2d(second, third, 3, 1), nn.ReLU(), nn.Flatten(),
            nn.Linear(third * maps**2, FEATURES), nn.ReLU())

    def forward(self, picture, extra):
        """Standardise, convolve, append."""
        pixels = (picture.float() - PIXEL_MEAN) / PIXEL_STD
        return torch.cat([self.layers(pixels), extra], dim=-1)


class PlainNetwork(nn.Module):
    """Encoder, nn.LSTM stepped through time, actor and critic."""

    def __init__(self, actions: int, maps: int):
        super().__init__()
        self.encoder = Encoder(actions + 1, maps)
        self.lstm = nn.LSTM(FEATURES + actions + 1, HIDDEN)
        self.actor, self.critic = nn.Linear(HIDDEN, actions), nn.Linear(HIDDEN, 1)

    def forward(self, picture, extra, done, state):
        """Rows in the order of time, [T*B,...], `done` [T*B]: logits, values, last state."""
        batch = state[0].shape[1]
        features = self.encoder(picture, extra).view(-1, batch, self.lstm.input_size)
        outputs = []
        for x, ended in zip(features, done.view(-1, batch), strict=True):
            keep = (1.0 - ended.float()).view(1, batch, 1)
            output, state = self.lstm(x.unsqueeze(0), (keep * state[0], keep * state[1]))
            outputs.append(output)
        hidden = torch.cat(outputs).flatten(0, 1)
        return self.actor(hidden), self.critic(hidden).flatten(), state


class PlainLoop:
    """PPO with an LSTM, written down plainly."""

    def __init__(self, env: StackedEnv, network: PlainNetwork):
        self.env, self.network = env, network
        self.optimiser = torch.optim.Adam(network.parameters(), RATE, eps=1e-5)
        first = env.reset(seed=0)
        self.now = {name: torch.from_numpy(rows) for name, rows in first.items()}
        self.done = torch.ones(ENVS)
        zeros = torch.zeros(1, ENVS, HIDDEN)
        self.state = (zeros, zeros)
        self.seen = {name: torch.zeros(STEPS, *rows.shape, dtype=rows.dtype)
                     for name, rows in self.now.items()}
        self.dones, self.values, self.rewards, self.chances = (
            torch.zeros(STEPS, ENVS) for _ in range(4))
        self.actions = torch.zeros(STEPS, ENVS, dtype=torch.int64)

    def update(self) -> int:
        """One rollout and its epochs; the number of decisions."""
        before = self.state
        with torch.no_grad():
            self._collect()
            _, value, _ = self.network(*self.now.values(), self.done, self.state)
            advantage = torch.zeros(STEPS, ENVS)
            following = torch.zeros(ENVS)
            ended = self.done
            for t in reversed(range(STEPS)):
                error = self.rewards[t] + GAMMA * value * (1 - ended) - self.values[t]
                following = error + GAMMA * LAMBDA * (1 - ended) * following
                advantage[t], value, ended = following, self.values[t], self.dones[t]
            target = advantage + self.values
        for _ in range(EPOCHS):
            for columns in torch.randperm(ENVS).chunk(MINIBATCHES):
                self._learn(columns, advantage, target, before)
        return STEPS * ENVS

    def _collect(self) -> None:
        for t in range(STEPS):
            for name, rows in self.now.items():
                self.seen[name][t] = rows
            self.dones[t] = self.done
            logits, self.values[t], self.state = self.network(*self.now.values(), self.done,
                                                              self.state)
            choice = Categorical(logits=logits)
            self.actions[t] = choice.sample()
            self.chances[t] = choice.log_prob(self.actions[t])
            observation, reward, done, _, _ = self.env.step(self.actions[t].numpy())
            self.rewards[t] = torch.from_numpy(reward)
            self.now = {name: torch.from_numpy(rows) for name, rows in observation.items()}
            self.done = torch.from_numpy(done).float()

    def _learn(self, columns, advantage, target, before) -> None:
        seen = {name: rows[:, columns].flatten(0, 1) for name, rows in self.seen.items()}
        logits, value, _ = self.network(*seen.values(), self.dones[:, columns].flatten(),
                                        tuple(part[:, columns] for part in before))
        choice = Categorical(logits=logits)
        chance = choice.log_prob(self.actions[:, columns].flatten())
        gain = advantage[:, columns].flatten()
        gain = (gain - gain.mean()) / (gain.std() + 1e-8)
        ratio = (chance - self.chances[:, columns].flatten()).exp()
        clipped = ratio.clamp(1 - CLIP, 1 + CLIP)
        loss = (-torch.min(ratio * gain, clipped * gain).mean()
                + VALUE * ((value - target[:, columns].flatten()) ** 2).mean()
                - ENTROPY * choice.entropy().mean())
        self.optimiser.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(self.network.parameters(), MAX_NORM)
        self.optimiser.step()


def recurrent_ppo(env: StackedEnv):
    """sb3-contrib's RecurrentPPO on the same environment, network and numbers."""
    from gymnasium import spaces
    from sb3_contrib import RecurrentPPO
    from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
    from stable_baselines3.common.vec_env import VecEnv

    class Extractor(BaseFeaturesExtractor):
        def __init__(self, space, maps: int):
            extra = space['extra'].shape[0]
            super().__init__(space, FEATURES + extra)
            self.encoder = Encoder(extra, maps)

        def forward(self, observation):
            return self.encoder(observation['picture'], observation['extra'])

    class Adapter(VecEnv):
        def __init__(self):
            size, inner = env.env.config.size, env.env
            super().__init__(ENVS, spaces.Dict({
                'picture': spaces.Box(0, 255, (6, size, size), np.uint8),
                'extra': spaces.Box(-1, 1, (env.count + 1,), np.float32),
            }), spaces.Discrete(len(inner.action_names)))

        def reset(self):
            return env.reset(seed=0)

        def step_async(self, actions):
            self.chosen = actions

        def step_wait(self):
            observation, reward, done, truncated, last = env.step(self.chosen)
            infos = [{} for _ in range(ENVS)]
            for n, end in last.items():
                infos[n] = {'terminal_observation': end, 'TimeLimit.truncated': truncated[n]}
            return observation, reward, done, infos

        def close(self):
            pass

        def get_attr(self, attr_name, indices=None):
            return [None] * ENVS

        def set_attr(self, attr_name, value, indices=None):
            raise AttributeError(attr_name)

        def env_method(self, method_name, *args, indices=None, **options):
            raise AttributeError(method_name)

        def env_is_wrapped(self, wrapper_class, indices=None):
            return [False] * ENVS

    return RecurrentPPO(
        'MultiInputLstmPolicy', Adapter(), learning_rate=RATE, n_steps=STEPS,
        batch_size=STEPS * ENVS // MINIBATCHES, n_epochs=EPOCHS, gamma=GAMMA, gae_lambda=LAMBDA,
        clip_range=CLIP, ent_coef=ENTROPY, vf_coef=VALUE, max_grad_norm=MAX_NORM, device='cpu',
        policy_kwargs={
            'features_extractor_class': Extractor,
            'features_extractor_kwargs': {'maps': map_side(env.env.config.size)},
            'net_arch': [], 'normalize_images': False, 'lstm_hidden_size': HIDDEN,
            'n_lstm_layers': 1, 'shared_lstm': True, 'enable_critic_lstm': False,
            'optimizer_kwargs': {'eps': 1e-5}})


def map_side(size: int) -> int:
    """Side of the maps after the three convolutions."""
    return (((size - 8) // 4 + 1 - 4) // 2 + 1 - 3) + 1


def policy_difference(policy, sample: dict) -> float:
    """Largest difference of RecurrentPPO's outputs from a sample's, with the same weights."""
    names = {'encoder': 'features_extractor.encoder', 'lstm': 'lstm_actor', 'actor': 'action_net',
             'critic': 'value_net'}
    weights = {f'{names[name.split(".", 1)[0]]}.{name.split(".", 1)[1]}': value
               for name, value in sample['weights'].items()}
    own = policy.state_dict()
    own.update(weights)
    before = {name: value.clone() for name, value in policy.state_dict().items()}
    policy.load_state_dict(own)
    from sb3_contrib.common.recurrent.type_aliases import RNNStates
    # Its rows are sequence after sequence.
    rows = {name: sample[name].transpose(0, 1).flatten(0, 1)
            for name in ('picture', 'extra', 'starts', 'action', 'value', 'log_probability')}
    with torch.no_grad():
        value, chance, _ = policy.evaluate_actions(
            {name: rows[name] for name in ('picture', 'extra')}, rows['action'],
            RNNStates(sample['state'], sample['state']), rows['starts'].float())
    policy.load_state_dict(before)
    return max(float((value.flatten() - rows['value']).abs().max()),
               float((chance - rows['log_probability']).abs().max()))


def main():
    """Set RecurrentPPO up, then measure whenever asked."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('sample', help='weights, inputs and outputs of our network')
    arguments = parser.parse_args()
    answers = os.fdopen(os.dup(1), 'w')
    os.dup2(2, 1)  # what is printed on the way goes elsewhere
    torch.set_num_threads(1)
    torch.manual_seed(0)
    model = recurrent_ppo(StackedEnv(make_env()))
    difference = policy_difference(model.policy, torch.load(arguments.sample))
    decisions = UPDATES * STEPS * ENVS
    model.learn(decisions)
    print(json.dumps({'difference': difference}), file=answers, flush=True)
    for line in sys.stdin:
        if line.strip() != 'measure':
            break
        begun = time.perf_counter()
        model.learn(decisions, reset_num_timesteps=False)
        print(json.dumps(decisions / (time.perf_counter() - begun)), file=answers, flush=True)


if __name__ == '__main__':
    main()

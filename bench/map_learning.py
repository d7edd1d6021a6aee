"""A network that drives by a map, its imitation of the explorer (DAgger) and its PPO.

Shapes: N rows, B robots, T steps of a rollout, P side of the crops; see `map_views`.
"""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import numpy as np
import torch
from map_views import ACTIONS, CHANNELS, NUMBERS, PIXELS, MapDriver, Views
from torch import Tensor, nn
from torch.nn import functional as F

from vn_nav.learning.returns import generalised_advantages, masked_mean, normalise

ADVICE_LOGIT = 4.0  # of the planner's action: at first it is chosen in 95 % of the draws


class MapNetwork(nn.Module):
    """Crops and numbers to logits of the actions and a value.

    Args:
        advised: it is told the planner's action as well, and begins by following it.
    """

    def __init__(self, advised: bool):
        super().__init__()
        self.advised = advised
        self.see = nn.Sequential(
            nn.Conv2d(CHANNELS, 32, 5, 2, 2), nn.ReLU(), nn.Conv2d(32, 48, 3, 2, 1), nn.ReLU(),
            nn.Conv2d(48, 64, 3, 2, 1), nn.ReLU(), nn.Flatten(),
            nn.Linear(64 * (PIXELS // 8) ** 2, 256), nn.ReLU())
        self.read = nn.Sequential(nn.Linear(NUMBERS + ACTIONS * advised, 128), nn.ReLU())
        self.join = nn.Sequential(nn.Linear(256 + 128, 256), nn.ReLU())
        self.actor, self.critic = nn.Linear(256, ACTIONS), nn.Linear(256, 1)
        nn.init.orthogonal_(self.actor.weight, 0.01)
        nn.init.zeros_(self.actor.bias)

    def forward(self, maps: Tensor, numbers: Tensor, advice: Tensor) -> tuple[Tensor, Tensor]:
        """Logits [N,ACTIONS] and values [N] of crops uint8, numbers, the planner's actions."""
        if self.advised:
            told = F.one_hot(advice, ACTIONS).float()
            numbers = torch.cat([numbers, told], 1)
        joined = self.join(torch.cat([self.see(maps.float() / 128 - 1), self.read(numbers)], 1))
        logits = self.actor(joined)
        return logits + ADVICE_LOGIT * told if self.advised else logits, self.critic(joined)[:, 0]


def tensors(views: Views) -> tuple[Tensor, Tensor, Tensor]:
    """What the network takes."""
    return tuple(torch.from_numpy(part) for part in views[:3])


@torch.inference_mode()
def act(network: MapNetwork, views: Views, decoding: str, generator: torch.Generator
        ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Actions [N], their log-probabilities and the values."""
    logits, value = network(*tensors(views))
    log = F.log_softmax(logits, 1)
    action = log.argmax(1) if decoding == 'greedy' else torch.multinomial(
        log.exp(), 1, generator=generator)[:, 0]
    return action.numpy(), log.gather(1, action[:, None])[:, 0].numpy(), value.numpy()


class MapActor:
    """Planner or network as an actor of `vn_nav.evaluation.evaluator`; both declare alike.

    Args:
        env: where.
        eyes: the networks of the checkpoint.
        network: None: the planner alone, whose actions are those of `evaluator.PolicyActor`.
        decoding, seed: of the network's actions.
        threshold: probability of having arrived above which it declares.
        episodes: of each environment; what comes after them is not looked at.
    """

    def __init__(self, env, eyes, network: MapNetwork | None, decoding: str, seed: int,
                 threshold: float, episodes: int):
        self._env, self._network, self._decoding = env, network, decoding
        self._threshold, self._left = threshold, np.full(env.num_envs, episodes)
        self._driver = MapDriver(eyes, env.num_envs, plans=network is None or network.advised)
        self._generator = torch.Generator().manual_seed(seed)

    def __call__(self, observation: dict, reset: np.ndarray) -> np.ndarray:
        self._left[reset] -= 1
        for n in np.flatnonzero(self._left < 0):
            self._driver.searchers[n].resting = True
        if self._network is None:
            action, arrival = self._driver.advise(observation, self._env.goals, reset)
        else:
            views = self._driver.look(observation, self._env.goals, reset)
            arrival = views.arrival
            action, _, _ = act(self._network, views, self._decoding, self._generator)
        return np.where(arrival > self._threshold, self._env.declare_action, action)


class Examples:
    """The newest examples of what the teacher does; older ones are overwritten."""

    def __init__(self, most: int):
        self.maps = np.empty((most, CHANNELS, PIXELS, PIXELS), np.uint8)
        self.numbers = np.empty((most, NUMBERS), np.float32)
        self.advice, self.action = np.empty(most, np.int64), np.empty(most, np.int64)
        self.count = 0  # ever seen

    def add(self, views: Views, action: np.ndarray, rows: np.ndarray) -> None:
        """Keep some rows [K] of views and the teacher's actions [N]."""
        at = np.arange(self.count, self.count + len(rows)) % len(self.action)
        for own, new in ((self.maps, views.maps), (self.numbers, views.numbers),
                         (self.advice, views.advice), (self.action, action)):
            own[at] = new[rows]
        self.count += len(rows)

    def draw(self, size: int, rng: np.random.Generator) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Some of them: maps, numbers, the planner's and the teacher's actions."""
        at = rng.integers(min(self.count, len(self.action)), size=size)
        return tuple(torch.from_numpy(part[at])
                     for part in (self.maps, self.numbers, self.advice, self.action))


def imitate(network: MapNetwork, optimiser, maps: Tensor, numbers: Tensor, advice: Tensor,
            action: Tensor) -> tuple[float, float]:
    """One step towards the teacher's actions [N]; loss, and share of them that it would take."""
    logits, _ = network(maps, numbers, advice)
    loss = F.cross_entropy(logits, action)
    descend(network, optimiser, loss)
    return loss.item(), (logits.argmax(1) == action).float().mean().item()


def descend(network: MapNetwork, optimiser, loss: Tensor, critic_only: bool = False) -> None:
    """One step of the optimiser, of a bounded gradient."""
    optimiser.zero_grad()
    loss.backward()
    if critic_only:  # the layers before it stay: the actor reads them too
        for name, parameter in network.named_parameters():
            if not name.startswith('critic'):
                parameter.grad = None
    nn.utils.clip_grad_norm_(network.parameters(), 0.5)
    optimiser.step()


@dataclasses.dataclass(frozen=True)
class Ppo:
    """Numbers of the reinforcement."""

    steps: int = 32  # of a rollout, T
    epochs: int = 3
    batch: int = 256  # rows
    clip: float = 0.2
    gamma: float = 0.99
    lam: float = 0.95
    entropy: float = 0.003
    value: float = 0.5  # weight of its loss
    critic_first: int = 6  # rollouts in which the critic alone learns
    learning_rate: float = 1e-4


class Rollout(NamedTuple):
    """T steps of B robots."""

    maps: Tensor  # [T,B,...]
    numbers: Tensor
    advice: Tensor
    action: Tensor  # [T,B]
    log: Tensor  # [T,B] log-probability of the action
    value: Tensor  # [T+1,B]
    reward: Tensor  # [T,B]
    terminated: Tensor  # [T,B] bool
    truncated: Tensor
    valid: Tensor  # [T,B] bool: a decision, not the end of an episode
    own: Tensor  # [T,B] bool: the network's action was done, no stop declared in its place


def reinforce(network: MapNetwork, optimiser, rollout: Rollout, numbers: Ppo, critic_only: bool,
              generator: torch.Generator) -> dict[str, float]:
    """PPO (Schulman et al. 2017) over a rollout; figures of the last epoch."""
    advantage = generalised_advantages(rollout.reward, rollout.value, rollout.terminated,
                                       rollout.truncated, gamma=numbers.gamma, lam=numbers.lam)
    returns = (advantage + rollout.value[:-1]).flatten()
    own = (rollout.own & rollout.valid).flatten()
    valid = rollout.valid.flatten()
    advantage = normalise(advantage.flatten(), own)
    inputs = [part.flatten(0, 1) for part in rollout[:3]]
    action, before = rollout.action.flatten(), rollout.log.flatten()
    found: dict[str, list[float]] = {'value_loss': [], 'entropy': [], 'kl': []}
    for _ in range(numbers.epochs):
        for values in found.values():
            values.clear()
        for rows in torch.randperm(len(action), generator=generator).split(numbers.batch):
            logits, value = network(*(part[rows] for part in inputs))
            log = F.log_softmax(logits, 1)
            ratio = (log.gather(1, action[rows, None])[:, 0] - before[rows]).exp()
            gain = torch.min(ratio * advantage[rows], ratio.clamp(
                1 - numbers.clip, 1 + numbers.clip) * advantage[rows])
            entropy = masked_mean(-(log.exp() * log).sum(1), own[rows])
            value_loss = masked_mean(F.smooth_l1_loss(value, returns[rows], reduction='none'),
                                     valid[rows])
            loss = numbers.value * value_loss
            if not critic_only:
                loss = loss - masked_mean(gain, own[rows]) - numbers.entropy * entropy
            descend(network, optimiser, loss, critic_only)
            found['value_loss'].append(value_loss.item())
            found['entropy'].append(entropy.item())
            found['kl'].append(masked_mean(ratio - 1 - ratio.log(), own[rows]).item())
    return {name: float(np.mean(values)) for name, values in found.items()}

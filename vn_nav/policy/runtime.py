"""Running a policy: NumPy in, NumPy out."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from vn_nav.errors import UserError
from vn_nav.observation import Observation
from vn_nav.policy.checkpoint import DECODINGS, load_checkpoint
from vn_nav.policy.network import Policy


class BatchedPolicy:
    """Acts in N environments at once; keeps their recurrent state.

    Args:
        network: the policy.
        num_envs: N.
        decoding: 'sample' (as in training) or 'greedy'.
        seed: of the sampled actions.
    """

    def __init__(self, network: Policy, num_envs: int, *, decoding: str = 'sample', seed: int = 0):
        if decoding not in DECODINGS:
            raise UserError(f'decoding is one of {", ".join(DECODINGS)}', decoding, 'choose one')
        self.network, self.decoding, self.num_envs = network, decoding, num_envs
        self.generator = torch.Generator().manual_seed(seed)
        self.state = network.initial_state(num_envs)
        self._goals: np.ndarray | None = None
        self._goal_maps: torch.Tensor | None = None

    @torch.no_grad()
    def act(self, observation: dict, goals: np.ndarray, reset: np.ndarray) -> np.ndarray:
        """Choose actions.

        Args:
            observation: image [N,3,S,S] uint8, goal_index, last_action, last_reward [N].
            goals: [G,3,S,S] uint8, encoded when they change.
            reset: [N] bool, a new episode begins with this observation.

        Returns:
            [N] int64.

        Raises:
            FloatingPointError: the network's output is not finite.
        """
        if goals is not self._goals:
            self._goals = goals
            self._goal_maps = self.network.encode_goals(torch.from_numpy(goals))
        seen = Observation(
            torch.from_numpy(observation['image'])[None], None,
            *(torch.from_numpy(np.asarray(observation[name]))[None]
              for name in ('goal_index', 'last_action', 'last_reward')))
        output, self.state = self.network(seen, torch.from_numpy(np.asarray(reset))[None],
                                          self.state, self._goal_maps)
        logits = output.logits[0]
        if not torch.isfinite(logits).all():
            raise FloatingPointError('the output of the network is finite; received NaN or Inf')
        if self.decoding == 'greedy':
            return logits.argmax(-1).numpy()
        return torch.multinomial(torch.softmax(logits, -1), 1,
                                 generator=self.generator)[:, 0].numpy()


class PolicyRuntime:
    """One robot's policy from a checkpoint.

    Args:
        folder: the checkpoint.
        seed: of the sampled actions.
        decoding: 'sample' or 'greedy'; None: what the checkpoint's figures were measured with.

    Attributes:
        size: side of the pictures it takes [pixels].
        action_names: its actions; `act` returns an index into them.
        camera_fov: field of view that it was trained with [rad].
        info: the facts in the checkpoint.
    """

    def __init__(self, folder: str | Path, *, seed: int = 0, decoding: str | None = None):
        network, config, self.info = load_checkpoint(folder)
        self.size, self.action_names = config.size, config.actions
        self.camera_fov = float(np.deg2rad(self.info.get('camera_fov_deg', 90.0)))
        torch.set_num_threads(1)  # one picture is too little work to share
        self._batch = BatchedPolicy(network, 1, seed=seed,
                                    decoding=decoding or self.info.get('decoding', 'sample'))
        self._goal: np.ndarray | None = None
        self.reset()

    def set_goal(self, goal: np.ndarray) -> None:
        """Take a new goal picture [3,S,S] uint8, and forget the last episode."""
        self._check(goal)
        self._goal = np.ascontiguousarray(goal)[None]
        self.reset()

    def reset(self) -> None:
        """Forget the episode so far."""
        self._last_action, self._fresh = -1, True

    def act(self, image: np.ndarray) -> int:
        """The next action for a camera picture [3,S,S] uint8.

        Raises:
            UserError: no goal yet, or a picture of another shape.
            FloatingPointError: the network's output is not finite.
        """
        if self._goal is None:
            raise UserError('a goal picture is set before the policy acts', None, 'call set_goal')
        self._check(image)
        observation = {
            'image': np.ascontiguousarray(image)[None], 'goal_index': np.zeros(1, np.int64),
            'last_action': np.array([self._last_action]),
            'last_reward': np.zeros(1, np.float32)}  # a robot knows of no reward before the goal
        action = int(self._batch.act(observation, self._goal, np.array([self._fresh]))[0])
        self._last_action, self._fresh = action, False
        return action

    def _check(self, picture: np.ndarray) -> None:
        if picture.shape != (3, self.size, self.size) or picture.dtype != np.uint8:
            raise UserError(f'the policy takes uint8 pictures [3,{self.size},{self.size}]',
                            f'{picture.dtype} {picture.shape}',
                            'use vn_nav.observation.preprocess')

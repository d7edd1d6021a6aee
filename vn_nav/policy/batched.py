"""A policy for many robots at once, and how actions are chosen by its logits."""

from __future__ import annotations

import math

import numpy as np
import torch

from vn_nav.measured_ranges import Scan, Scanner
from vn_nav.observation import Observation
from vn_nav.policy.action_filter import make_filter
from vn_nav.policy.goal_maps import GoalMaps
from vn_nav.policy.memory import RecurrentState
from vn_nav.policy.network import Policy
from vn_nav.policy.runtime import check_decoding
from vn_nav.policy.search.driver import SearchDriver
from vn_nav.policy.search.network import SearchPolicy
from vn_nav.policy.search.torch_eyes import TorchEyes
from vn_nav.policy.search.views import NONE, FeaturePairs, check_verify
from vn_nav.policy.zhu import check_scenes
from vn_nav.policy.zhu_policy import ScenePolicy


def choose(logits: torch.Tensor, decoding: str, generator: torch.Generator) -> torch.Tensor:
    """Actions [N] from logits [N,A]: sampled, or the likeliest.

    Raises:
        FloatingPointError: a logit is not finite.
    """
    if not torch.isfinite(logits).all():
        raise FloatingPointError('logits of the policy are not finite')
    if decoding == 'greedy':
        return logits.argmax(-1)
    return torch.multinomial(torch.softmax(logits, -1), 1, generator=generator).squeeze(-1)


def choose_filtered(logits: torch.Tensor, offsets: np.ndarray | None, decoding: str,
                    generator: torch.Generator
                    ) -> tuple[torch.Tensor, torch.Tensor, np.ndarray, np.ndarray]:
    """Actions [N] under an action filter, and what it did.

    Args:
        logits: [N,A], of the policy.
        offsets: [N,A] of the filter; None: there is none.
        decoding, generator: see `choose`; the filter draws no random numbers.

    Returns:
        Actions [N], the logits that they were chosen by, and two [N] bool: where the filter acted,
        and where another action came out than would have without it, by the same random numbers.

    Raises:
        FloatingPointError: a logit is not finite.
    """
    acted = np.zeros(len(logits), bool) if offsets is None else (offsets != 0).any(1)
    if not acted.any():
        return choose(logits, decoding, generator), logits, acted, acted
    again = torch.Generator()
    again.set_state(generator.get_state())
    filtered = logits + torch.from_numpy(offsets)
    actions = choose(filtered, decoding, generator)
    return actions, filtered, acted, (actions != choose(logits, decoding, again)).numpy()


class BatchedPolicy:
    """A policy for all environments of a vector environment at once.

    Args:
        network: the policy; used as it is, in its `compute_dtype`.
        num_envs: environments N.
        decoding: 'sample' or 'greedy'.
        seed: of the sampled actions.
        zoom: how many times the robots' lens magnifies against the policy's, for one that
            searches; see `vn_nav.policy.search.lens`.
        scanner: what measures the `scan` of observations, if the robots have one.
        verify: as of `PolicyRuntime`; pictures may be larger then than the network's.
        camera_fov, camera_pitch: of the robots' square pictures [rad], for `verify`.
        max_decisions: of an episode, for one that searches; None: nobody knows.

    Attributes:
        arrival: [N] float32 probability that the robots have arrived, by the head `arrival`, at
            the observation that `act` saw last; nan where the network has no such head.
        logits: [N,A] tensor, of the actions at that observation, behind the action filter; None
            before the first.
        filtered: two [N] bool: where the action filter acted at that observation, and where it
            changed the action; None where the policy has none.
    """

    def __init__(self, network: Policy, num_envs: int, decoding: str = 'sample', seed: int = 0,
                 scanner: Scanner | None = None, zoom: float = 1.0, verify: str = NONE,
                 camera_fov: float = math.pi / 2, camera_pitch: float = 0.0,
                 max_decisions: int | None = None):
        check_decoding(decoding)
        check_verify(verify, isinstance(network, SearchPolicy))
        self._features = None if verify == NONE else FeaturePairs(camera_fov)
        self.network, self.decoding, self.scanner = network, decoding, scanner
        self._zoom = zoom
        self._generator = torch.Generator().manual_seed(seed)
        self.arrival = np.full(num_envs, np.nan, np.float32)
        self.logits: torch.Tensor | None = None
        self.search = None
        if isinstance(network, SearchPolicy):
            self.search = SearchDriver(TorchEyes(network), num_envs, camera_pitch, max_decisions)
        self._state: RecurrentState | None = (
            network.initial_state(num_envs) if self.search is None else None)
        self._goals: np.ndarray | None = None
        self._goal_maps = GoalMaps(network)
        config = network.config
        self._filter = make_filter(config.filter_name, config.moves, num_envs)
        self.filtered: tuple[np.ndarray, np.ndarray] | None = None

    def takes_features(self, size: int) -> bool:
        """Whether frozen features of this size [F] can stand for pictures: icra2017 alone."""
        return isinstance(self.network, ScenePolicy) and self.network.takes_features(size)

    @torch.inference_mode()
    def act(self, obs: dict[str, np.ndarray], goals: np.ndarray, reset_mask: np.ndarray,
            scene: np.ndarray | None = None,
            full: tuple[np.ndarray, np.ndarray] | None = None) -> np.ndarray:
        """Actions [N] int64.

        Args:
            obs: `image` [N,3,S,S] uint8, `goal_index` [N], `last_action` [N], `last_reward` [N];
                `features` [N,F] float32, if somebody has computed them, see `takes_features`;
                `odometry` [N,3] float64, if the robots have it: x, y [m], yaw [rad] in a frame of
                the episode (a network that does not use it ignores it); `scan` [N,K] float32 m,
                ranges along the bearings of the `scanner`, for the map of a policy that has one.
            goals: [G,3,S,S] uint8, or their features [G,F] float32; encoded again only when
                another array is passed, so do not write into one.
            reset_mask: [N] bool, where an episode begins with this observation.
            scene: [N] number of each robot's scene; only for a network with several.
            full: pictures [N,3,H,H] and goals [G,3,H,H] in full, for `verify`; None: nothing is
                verified.

        Raises:
            FloatingPointError: the logits are not finite.
            UserError: a scene that the network does not know, or none where it needs one.
        """
        extras: dict[str, torch.Tensor] = {}
        scenes = self.network.config.scenes
        if scenes > 1 and scene is not None:
            extras['scene'] = torch.from_numpy(check_scenes(scene, scenes))[None]
        if 'features' in obs and self.takes_features(obs['features'].shape[-1]):
            extras['features'] = torch.from_numpy(obs['features'])[None]
        if goals is not self._goals:
            self._goals, self._goal_maps = goals, GoalMaps(self.network)
        maps = self._goal_maps.of(torch.from_numpy(goals),
                                  torch.from_numpy(np.asarray(obs['goal_index'])))
        last_action, reset_mask = np.asarray(obs['last_action']), np.asarray(reset_mask, bool)
        if self.search is not None:
            scans = None if self.scanner is None else [
                Scan(self.scanner, ranges) for ranges in obs['scan']]
            pairs = None if self._features is None or full is None else self._features.of(
                *full, np.asarray(obs['goal_index']))
            chosen = self.search.act(obs['image'], maps.float().numpy(), last_action, reset_mask,
                                     obs.get('odometry'), scans, self._zoom, pairs)
            self.arrival = self.search.arrival.copy()
            return chosen
        observation = Observation(
            torch.from_numpy(obs['image'])[None], None, None,
            torch.from_numpy(last_action)[None],
            torch.from_numpy(np.asarray(obs['last_reward']))[None], extras or None)
        starts = torch.from_numpy(reset_mask)[None]
        output, self._state = self.network(observation, starts, self._state, maps)
        if output.arrival is not None:
            self.arrival = torch.sigmoid(output.arrival[0]).numpy()
        offsets = None
        if self._filter is not None:
            offsets = self._filter.offsets(obs['image'], last_action, reset_mask)
        actions, self.logits, acted, changed = choose_filtered(
            output.logits[0], offsets, self.decoding, self._generator)
        if self._filter is not None:
            self.filtered = acted, changed
        return actions.numpy()

"""Policies at work: NumPy pictures in, action numbers out."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import torch

from vn_nav.errors import UserError
from vn_nav.measured_ranges import Scan, Scanner
from vn_nav.observation import (
    Observation,
    check_lens,
    crop_fraction,
    fov_across,
    preprocess,
    through_lens,
)
from vn_nav.policy.action_filter import FilterCounts, make_filter
from vn_nav.policy.checkpoint import load_checkpoint
from vn_nav.policy.checkpoint_info import DECODINGS
from vn_nav.policy.goal_maps import GoalMaps
from vn_nav.policy.memory import RecurrentState
from vn_nav.policy.network import Policy
from vn_nav.policy.network_config import NetworkConfig
from vn_nav.policy.search.driver import SearchDriver
from vn_nav.policy.search.local_features import Features
from vn_nav.policy.search.network import SearchPolicy
from vn_nav.policy.search.verification import NONE, FeaturePairs, Pair, View, check_verify
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


class PolicyRuntime:
    """One robot's policy. Limits torch to one thread: more only add latency at this size.

    Args:
        folder: a checkpoint.
        seed: of the sampled actions.
        decoding: 'sample' or 'greedy'; left out, the rule of the checkpoint's figures.
        stop_threshold: probability of arrival above which the policy declares its stop, 0 to 1
            (1: never); left out, the checkpoint's.
        verify: 'sift': what a policy that searches sees of its goal is verified by local features
            of the full pictures, see `vn_nav.policy.search.verification`; 'none'.
        camera_pitch: down, of the camera [rad]; for `verify` alone.

    Attributes:
        size: side of the square pictures [pixels].
        action_names: an action's number is its place here.
        moves: what the actions do to the robot, if the policy counts on it; else empty.
        action_filter: of `vn_nav.policy.action_filter.FILTERS`, as the checkpoint says.
        filter_counts: how often it acted, since this object was made.
        camera_fov: field of view that the pictures have [rad].
        info: what else the checkpoint says.
        stop_threshold: the one in force; None: the policy declares nothing.
        arrival: probability that the robot has arrived, by the head `arrival`, at the picture
            that `act` saw last; nan before it, and where the network has no such head.
        search: map and hypotheses of a policy that searches; None: it is another.

    Raises:
        UserError: see `load_checkpoint`; an unknown decoding; a threshold out of range, or one
            for a network without the head `arrival`; an unknown `verify`, or one for a policy
            that does not search.
    """

    def __init__(self, folder: str | Path, *, seed: int = 0, decoding: str | None = None,
                 stop_threshold: float | None = None, verify: str = NONE,
                 camera_pitch: float = 0.0):
        checkpoint = load_checkpoint(folder)
        self.decoding = checkpoint.info['decoding'] if decoding is None else decoding
        _check_decoding(self.decoding)
        self.stop_threshold: float | None = (
            checkpoint.info['stop_threshold'] if stop_threshold is None else stop_threshold)
        _check_stop_threshold(self.stop_threshold, checkpoint.config)
        check_verify(verify, isinstance(checkpoint.network, SearchPolicy))
        self.verify = verify
        self._goal_features: Features | None = None
        self.arrival = math.nan
        torch.set_num_threads(1)
        self.size: int = checkpoint.config.size
        self.action_names: tuple[str, ...] = checkpoint.config.actions
        self.moves: tuple[tuple[float, float, float], ...] = checkpoint.config.moves
        self.camera_fov: float = math.radians(checkpoint.info['camera_fov_deg'])
        self.info: dict = checkpoint.info
        self._network = checkpoint.network
        self._generator = torch.Generator().manual_seed(seed)
        self._goal_maps: torch.Tensor | None = None
        self._reward = torch.zeros(1, 1)  # a robot gets none
        self.action_filter: str = checkpoint.config.filter_name
        self.filter_counts = FilterCounts()
        self._filter = make_filter(self.action_filter, self.moves, 1)
        self.search = _search(self._network, 1, camera_pitch)
        self.reset()

    @torch.inference_mode()
    def set_goal(self, goal: np.ndarray, view: View | None = None) -> None:
        """Take a goal picture, uint8 [3,S,S], encode it once, and begin an episode.

        Args:
            goal: the picture; view: the same in full, for `verify`.
        """
        self._goal_features = (None if view is None or self.verify == NONE
                               else view.features())
        self._goal_maps = self._network.encode_goals(self._tensor(goal)[None])
        if self.search is not None:
            self.search.prepare(self._goal_maps)
        self.arrival = math.nan
        self.reset()

    def check_camera(self, fov: float, aspect: float) -> None:
        """Whether this policy can drive by a camera.

        Args:
            fov: of the picture's shorter side [rad]; aspect: its width over its height.

        Raises:
            UserError: it sees too little or, for a policy that searches, too much.
        """
        if self.search is None:
            crop_fraction(fov, self.camera_fov)
        else:
            check_lens(fov_across(fov, aspect))

    def prepare(self, picture: np.ndarray, fov: float | None = None, zoom: float | None = None
                ) -> tuple[np.ndarray, float]:
        """A camera's picture as `act` and `set_goal` take it, and the `zoom` for `act`.

        Args:
            picture: [H,W,3] uint8 RGB.
            fov: of its shorter side [rad]; None: unknown, and taken for the policy's own.
            zoom: that it has to have, for a goal picture of another camera than the robot's;
                None: what the camera gives.

        Raises:
            UserError: see `vn_nav.observation.preprocess` and `through_lens`.
        """
        if self.search is None or fov is None:
            return preprocess(picture, self.size, fov=fov, target_fov=self.camera_fov), 1.0
        return through_lens(picture, self.size, fov=fov, target_fov=self.camera_fov, zoom=zoom)

    def reset(self) -> None:
        """Begin an episode: empty memory, no last action."""
        if self.search is None:
            self._state = self._network.initial_state(1)
        self._last_action = -1
        self._starts = True

    def correct(self, action: int) -> None:
        """Say what was really done since `act`, where another driver has control.

        Args:
            action: -1: none of the policy's. The memory is emptied then, as in pre-training: the
                network has not seen that motion.
        """
        if self._last_action >= 0:  # else an episode begins
            self._last_action = action

    def reset_odometry(self) -> None:
        """Say that the poses given to `act` from now on are in another frame than those before.

        The odometry jumped or was set anew: how the robot moved between the last picture and the
        next one, odometry does not tell. The episode goes on. A network has no use for odometry,
        and forgets nothing; a policy that searches counts on its nominal move.
        """
        if self.search is not None:
            for searcher in self.search.searchers:
                searcher.reset_odometry()

    @property
    def arrived(self) -> bool:
        """Whether the policy declares, at the picture that `act` saw last, that it is there."""
        return self.stop_threshold is not None and self.arrival > self.stop_threshold

    @torch.inference_mode()
    def act(self, image: np.ndarray, odometry: np.ndarray | None = None,
            scan: Scan | None = None, zoom: float = 1.0, view: View | None = None) -> int:
        """The next action for a picture; remembered as the last action.

        Where the policy declares that it has `arrived` the action is not for driving: the episode
        is over, and the next picture begins another one towards the same goal.

        Args:
            image: the picture, uint8 [3,S,S].
            odometry: [3] float64 x, y [m], yaw [rad] of the robot there, in any frame that stays
                the same until `reset_odometry`, `reset` or `set_goal`; what counts is how it
                changes. None: unknown at this picture; the frame stays. Of use to a policy that
                searches alone.
            scan: ranges that were measured there, which its map takes in place of those that it
                sees in the picture. None: there are none at this picture.
            zoom: of picture and goal, as `prepare` says.
            view: the picture in full, for `verify`; None: nothing is verified at this one.

        Raises:
            FloatingPointError: the outputs are not finite; memory and last action stay.
            UserError: no goal yet, a picture of another shape or type, or a pose that is none.
        """
        if odometry is not None and not (odometry.shape == (3,) and np.isfinite(odometry).all()):
            raise UserError('odometry is x, y and yaw, finite', odometry.tolist(),
                            'pass None where the pose is unknown')
        if self._goal_maps is None:
            raise UserError('a goal picture is set before the policy acts', None, 'call set_goal')
        picture, last = self._tensor(image)[None], torch.tensor([self._last_action])
        if self.search is not None:
            return self._search_on(picture, odometry, scan, zoom, view)
        observation = Observation(picture[None], None, None, last[None], self._reward)
        starts = last[None] < 0
        output, state = self._network(observation, starts, self._state, self._goal_maps)
        offsets = None
        if self._filter is not None:
            offsets = self._filter.offsets(image[None], last.numpy(), starts[0].numpy())
        actions, _, acted, changed = choose_filtered(output.logits[0], offsets, self.decoding,
                                                     self._generator)
        action = int(actions)
        if output.arrival is not None:
            arrival = float(torch.sigmoid(output.arrival[0, 0]))
            if not math.isfinite(arrival):
                raise FloatingPointError('the arrival of the policy is not finite')
            self.arrival = arrival
        self._state, self._last_action = state, action
        if self._filter is not None:  # where the policy declares its stop nothing is driven
            self.filter_counts.add(acted[0] and not self.arrived, changed[0] and not self.arrived)
        if self.arrived:
            self.reset()
        return action

    def _search_on(self, picture: torch.Tensor, odometry: np.ndarray | None, scan: Scan | None,
                   zoom: float, view: View | None) -> int:
        """`act` of a policy that searches."""
        assert self.search is not None and self._goal_maps is not None
        goal = self._goal_features
        pair = None if view is None or goal is None else Pair(view.features(), goal)
        action = int(self.search.act(
            picture.numpy(), self._goal_maps, np.array([self._last_action]),
            np.array([self._starts]), None if odometry is None else odometry[None], [scan],
            zoom, [pair])[0])
        self.arrival = float(self.search.arrival[0])
        self._last_action, self._starts = action, False
        if self.arrived:
            self.reset()
        return action

    def _tensor(self, picture: np.ndarray) -> torch.Tensor:
        wanted = (3, self.size, self.size)
        if picture.shape != wanted or picture.dtype != np.uint8:
            raise UserError(f'a picture for this policy is uint8 {wanted}',
                            f'{picture.dtype} {picture.shape}',
                            'use vn_nav.observation.preprocess with its size')
        return torch.from_numpy(np.ascontiguousarray(picture))


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
                 camera_fov: float = math.pi / 2, camera_pitch: float = 0.0):
        _check_decoding(decoding)
        check_verify(verify, isinstance(network, SearchPolicy))
        self._features = None if verify == NONE else FeaturePairs(camera_fov)
        self.network, self.decoding, self.scanner = network, decoding, scanner
        self._zoom = zoom
        self._generator = torch.Generator().manual_seed(seed)
        self.arrival = np.full(num_envs, np.nan, np.float32)
        self.logits: torch.Tensor | None = None
        self.search = _search(network, num_envs, camera_pitch)
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
            chosen = self.search.act(obs['image'], maps, last_action, reset_mask,
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


def _search(network: Policy, num_envs: int, pitch: float) -> SearchDriver | None:
    """What decides where the network only sees."""
    if not isinstance(network, SearchPolicy):
        return None
    return SearchDriver(network, num_envs, pitch=pitch)


def _check_decoding(decoding: str) -> None:
    if decoding not in DECODINGS:
        raise UserError('decoding is sample or greedy', decoding, 'choose one of them')


def _check_stop_threshold(threshold: float | None, config: NetworkConfig) -> None:
    if threshold is None:
        return
    if not 0 <= threshold <= 1:
        raise UserError('the stop threshold lies in [0, 1]', threshold, 'choose a value in range')
    if threshold < 1 and not config.declares:
        raise UserError('a policy that declares its stop has the head arrival, or searches',
                        f'stop threshold {threshold:g}, architecture {config.architecture}, '
                        f'heads {", ".join(config.heads) or "none"}',
                        'leave the threshold out, or train with the head')

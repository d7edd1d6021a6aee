"""A policy at work on one robot: NumPy pictures in, action numbers out."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from vn_nav.errors import UserError
from vn_nav.lens import zoom_of
from vn_nav.measured_ranges import Scan
from vn_nav.observation import SAME_LENS, check_camera, fov_across, preprocess, through_lens
from vn_nav.policy.action_filter import FilterCounts, make_filter
from vn_nav.policy.backend import load_backend
from vn_nav.policy.checkpoint_info import DECODINGS, SEARCH
from vn_nav.policy.network_config import NetworkConfig
from vn_nav.policy.search.eyes import Eyes
from vn_nav.policy.search.local_features import Features
from vn_nav.policy.search.views import NONE, Pair, View, check_verify

if TYPE_CHECKING:
    from vn_nav.policy.search.driver import SearchDriver

NEVER = -1e9  # logit of an action that is left out


class PolicyRuntime:
    """One robot's policy, by PyTorch or by ONNX Runtime, on one thread: more only add latency.

    Args:
        folder: a checkpoint, or what `vn_nav export` made of one.
        seed: of the sampled actions.
        decoding: 'sample' or 'greedy'; left out, the rule of the checkpoint's figures.
        stop_threshold: probability of arrival above which the policy declares its stop, 0 to 1
            (1: never); left out, the checkpoint's.
        verify: 'sift': what a policy that searches sees of its goal is verified by local features
            of the full pictures, see `vn_nav.policy.search.verification`; 'none'.
        camera_pitch: down, of the camera [rad]; for `verify` alone.
        keep_map: a policy that searches keeps its map from goal to goal, where odometry says how
            the robot moves meanwhile; else each goal begins with an empty one, as it was measured.

    Attributes:
        size: side of the square pictures [pixels].
        action_names: an action's number is its place here.
        moves: what the actions do to the robot, if the policy counts on it; else empty.
        action_filter: of `vn_nav.policy.action_filter.FILTERS`, as the checkpoint says.
        filter_counts: how often it acted, since this object was made.
        camera_fov: field of view that the pictures have [rad].
        info: what else the checkpoint says.
        engine: what computes it, for people.
        stop_threshold: the one in force; None: the policy declares nothing.
        arrival: probability that the robot has arrived, by the head `arrival`, at the picture
            that `act` saw last; nan before it, and where the network has no such head.
        search: map and hypotheses of a policy that searches; None: it is another.

    Raises:
        UserError: see `load_checkpoint` and `vn_nav.policy.onnx_backend`; an unknown decoding; a
            threshold out of range, or one for a network without the head `arrival`; an unknown
            `verify`, or one for a policy that does not search.
    """

    def __init__(self, folder: str | Path, *, seed: int = 0, decoding: str | None = None,
                 stop_threshold: float | None = None, verify: str = NONE,
                 camera_pitch: float = 0.0, keep_map: bool = False):
        self._keep_map = keep_map
        self._backend = backend = load_backend(Path(folder), seed)
        info, config = backend.info, backend.config
        self.decoding = info['decoding'] if decoding is None else decoding
        check_decoding(self.decoding)
        self.stop_threshold: float | None = (
            info['stop_threshold'] if stop_threshold is None else stop_threshold)
        _check_stop_threshold(self.stop_threshold, config)
        check_verify(verify, config.architecture == SEARCH)
        self.verify = verify
        self._goal_features: Features | None = None
        self.arrival = math.nan
        self.size: int = config.size
        self.action_names: tuple[str, ...] = config.actions
        self.moves: tuple[tuple[float, float, float], ...] = config.moves
        self.camera_fov: float = math.radians(info['camera_fov_deg'])
        self.info: dict = info
        self.engine: str = backend.engine
        self._goal_maps: np.ndarray | None = None
        self.action_filter: str = config.filter_name
        self.filter_counts = FilterCounts()
        self._filter = make_filter(self.action_filter, self.moves, 1)
        self.search: SearchDriver | None = (None if backend.eyes is None
                                            else _driver(backend.eyes, camera_pitch))
        self.forbid(())
        self.reset()

    def set_goal(self, goal: np.ndarray, view: View | None = None) -> None:
        """Take a goal picture, uint8 [3,S,S], encode it once, and begin an episode.

        Args:
            goal: the picture; view: the same in full, for `verify`.
        """
        self._goal_features = (None if view is None or self.verify == NONE
                               else view.features())
        self._goal_maps = self._backend.encode_goal(self._checked(goal)[None])
        if self.search is not None:
            self.search.prepare(self._goal_maps)
        self.arrival = math.nan
        self._begin()

    def check_camera(self, fov: float, aspect: float) -> None:
        """Whether this policy can drive by a camera.

        Args:
            fov: of the picture's shorter side [rad]; aspect: its width over its height.

        Raises:
            UserError: it sees too little or, for a policy that searches, too much.
        """
        check_camera(fov, aspect, self.camera_fov, any_lens=self.search is not None)

    def prepare(self, picture: np.ndarray, fov: float | None = None, zoom: float | None = None
                ) -> tuple[np.ndarray, float]:
        """A camera's picture as `act` and `set_goal` take it, and the `zoom` for `act`.

        Args:
            picture: [H,W,3] uint8 RGB.
            fov: of its shorter side [rad]; None: unknown, and taken for the policy's own.
            zoom: that it has to have, for a goal picture of another camera than the robot's (see
                `zoom_of`): it is cut, or padded with grey. None: what the camera gives.

        Raises:
            UserError: see `vn_nav.observation.preprocess` and `through_lens`.
        """
        if fov is None or (self.search is None and zoom is None):
            return preprocess(picture, self.size, fov=fov, target_fov=self.camera_fov), 1.0
        return through_lens(picture, self.size, fov=fov, target_fov=self.camera_fov, zoom=zoom)

    def zoom_of(self, fov: float | None, aspect: float) -> float:
        """The zoom that `prepare` gives the pictures of a camera.

        Args:
            fov: of their shorter side [rad], None: unknown; aspect: their width over their height.
        """
        if self.search is None or fov is None:
            return 1.0
        zoom = zoom_of(fov_across(fov, aspect), self.camera_fov)
        return zoom if zoom > SAME_LENS else 1.0

    def forbid(self, actions: Sequence[int]) -> None:
        """Leave actions out: the base cannot do them (`RobotSpec.impossible`)."""
        self._forbidden = np.isin(np.arange(len(self.action_names)), actions)
        if self.search is not None:
            for searcher in self.search.searchers:
                searcher.forbid(self._forbidden)

    def reset(self) -> None:
        """Begin an episode: empty memory, no last action."""
        self._state = self._backend.initial_state()
        self._last_action = -1
        self._starts = True

    def _begin(self) -> None:
        """Begin an episode from where the robot is."""
        begins = self._starts  # nothing has been mapped since `reset`
        self.reset()
        if self._keep_map and self.search is not None and not begins:
            self._starts = False
            self.search.new_goals()

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

    @property
    def goal_estimate(self) -> np.ndarray | None:
        """[3] x, y [m], yaw [rad] of the goal in the robot's frame at the newest picture.

        None: it has no guess that is worth following; only a policy that searches has any.
        """
        return None if self.search is None else self.search.searchers[0].goal_estimate

    def set_budget(self, max_decisions: int | None) -> None:
        """How many decisions there are for a goal; None: nobody knows."""
        if self.search is not None:
            self.search.max_decisions = max_decisions

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
        picture = self._checked(image)[None]
        if self.search is not None:
            return self._search_on(picture, odometry, scan, zoom, view)
        last = np.array([self._last_action])
        said = self._backend.decide(picture, self._goal_maps, last, self._state)
        offsets = None
        if self._filter is not None:
            offsets = self._filter.offsets(picture, last, last < 0)
        logits = np.where(self._forbidden, np.float32(NEVER), said.logits)
        action, acted, changed = self._backend.choose(logits, offsets, self.decoding)
        if said.arrival is not None:
            if not math.isfinite(said.arrival):
                raise FloatingPointError('the arrival of the policy is not finite')
            self.arrival = 1 / (1 + math.exp(-max(min(said.arrival, 700.0), -700.0)))
        self._state, self._last_action = said.state, action
        if self._filter is not None:  # where the policy declares its stop nothing is driven
            self.filter_counts.add(acted and not self.arrived, changed and not self.arrived)
        if self.arrived:
            self.reset()
        return action

    def _search_on(self, picture: np.ndarray, odometry: np.ndarray | None, scan: Scan | None,
                   zoom: float, view: View | None) -> int:
        """`act` of a policy that searches."""
        assert self.search is not None and self._goal_maps is not None
        goal = self._goal_features
        pair = None if view is None or goal is None else Pair(view.features(), goal)
        action = int(self.search.act(
            picture, self._goal_maps, np.array([self._last_action]),
            np.array([self._starts]), None if odometry is None else odometry[None], [scan],
            zoom, [pair])[0])
        self.arrival = float(self.search.arrival[0])
        self._last_action, self._starts = action, False
        if self.arrived:
            self._begin()
        return action

    def _checked(self, picture: np.ndarray) -> np.ndarray:
        wanted = (3, self.size, self.size)
        if picture.shape != wanted or picture.dtype != np.uint8:
            raise UserError(f'a picture for this policy is uint8 {wanted}',
                            f'{picture.dtype} {picture.shape}',
                            'use vn_nav.observation.preprocess with its size')
        return np.ascontiguousarray(picture)


def _driver(eyes: Eyes, pitch: float) -> SearchDriver:
    """What searches; other policies need no Numba."""
    from vn_nav.policy.search import driver
    return driver.SearchDriver(eyes, 1, pitch)


def check_decoding(decoding: str) -> None:
    """Raise a `UserError` for an unknown rule."""
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

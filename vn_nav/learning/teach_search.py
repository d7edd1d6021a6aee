"""`teach` for a policy that searches: it keeps the drive's key pictures and a map of it.

Its weights stay as they are: the networks that recognise a goal recognise places of the drive.
"""

from __future__ import annotations

import functools
import time

import numpy as np

from vn_nav.learning.taught_keys import choose_keys, recall_drive
from vn_nav.learning.teaching import Teaching
from vn_nav.lens import zoom_of
from vn_nav.policy.checkpoint import load_checkpoint, save_checkpoint
from vn_nav.policy.network import Policy
from vn_nav.policy.search.grid import CELL, KNOWN
from vn_nav.policy.search.network import SearchPolicy


class SearchTeaching(Teaching):
    """From a place to a policy that recalls it, and its figures. Arguments as of `Teaching`."""

    evaluation_share = 0.8

    def _candidate(self, seconds: float) -> Policy:
        assert self.given is not None  # who searches was trained before
        return self.given.network

    def learn(self) -> None:
        """Keep key pictures, and draw the map."""
        assert self.given is not None
        network = load_checkpoint(self.job.checkpoint or '').network  # the given one stays
        assert isinstance(network, SearchPolicy)  # by its architecture
        begun, graph = time.monotonic(), self.graph
        rows = np.arange(len(graph.poses))
        if self.others is not None:  # pictures that are judged by are none to know the place by
            rows = np.setdiff1d(rows, self.others.goal_nodes)
        pictures, poses = graph.pictures[rows], graph.poses[rows]
        self.stages('choosing key pictures', 0.0)
        keys = choose_keys(pictures, poses)
        place = recall_drive(network, pictures, poses, keys, zoom_of(
            self.robot.camera_fov, network.config.view),
            functools.partial(self.stages, 'drawing the map'))
        network.taught = place
        facts = {'key_pictures': len(keys),
                 'mapped_m2': round(CELL**2 * float((place.seen >= KNOWN).sum()), 1)}
        print(f'{len(keys)} key pictures, {facts["mapped_m2"]} m2 of the map seen', flush=True)
        save_checkpoint(self.folder, network, {
            **self._info(), 'frames': 0, 'seed': self.job.seed,
            'minutes': round((time.monotonic() - begun) / 60, 2), 'results': {'place': facts}})

    def _info(self) -> dict:
        """As of any teaching, with what was and stays true of the weights."""
        assert self.given is not None
        before = self.given.info
        return {**super()._info(), **{name: before[name] for name in (
            # What the camera sees is told by how it magnifies against the lens that they know.
            'camera_fov_deg', 'preset', 'decoding', 'stop_threshold', 'losses', 'randomisation')}}

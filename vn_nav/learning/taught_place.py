"""What `teach` asks of a simulator that makes a place out of pictures with poses."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from vn_nav.learning.pairs import PairSource
from vn_nav.learning.places import Views
from vn_nav.robot import RobotSpec


class Place(Protocol):
    """What the simulator's half makes of a drive; `vn_sim_bridge.teach_place` is one."""

    @property
    def build_graph(self) -> Callable[..., Any]:
        """Makes a place out of pictures with poses; what `read_place` calls."""

    def held_out(self, graph) -> tuple[Any, Any]:
        """The place with the goals to learn, and with those to judge by, or None."""

    def make_env(self, graph, robot: RobotSpec, envs: int, **options) -> Any:
        """A vector environment there."""

    def make_pairs(self, own, others, robot: RobotSpec, seed: int
                   ) -> tuple[PairSource, PairSource]:
        """Picture pairs to learn from, and to judge by."""

    def make_views(self, graph, robot: RobotSpec, seed: int) -> tuple[Views, Views]:
        """Pictures with poses to know the place by, and others to judge by."""

    def regrets(self, graph, poses: np.ndarray, until: float, show: Callable[[float], None]
                ) -> np.ndarray:
        """[G,N,A] float16 decisions that actions at poses [N,3] lose on the ways to the goals.

        To the first G goals, as many as there is time for until `time.monotonic()` is `until`.
        """

    def draw_map(self, path: Path, own, others) -> None:
        """A picture of the place."""


class Watched:
    """Picture pairs that are drawn under somebody's eyes (a `PairSource`)."""

    def __init__(self, source: PairSource, look: Callable[[], None]):
        self._source, self._look = source, look

    @property
    def count(self) -> int:
        return self._source.count

    @count.setter
    def count(self, value: int) -> None:
        self._source.count = value

    def draw(self, count: int) -> dict[str, np.ndarray]:
        return self._source.draw(count)

    def draw_groups(self, count: int, robots: int) -> dict[str, np.ndarray]:
        self._look()
        return self._source.draw_groups(count, robots)

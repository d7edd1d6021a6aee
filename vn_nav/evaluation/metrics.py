"""What every figure means (docs/architecture.md, "Figures"), as pure functions over episodes.

Arrival and declared stop are two kinds of episodes. Under *arrival* the simulator ends an episode
when the robot is at its goal; under *declared stop* it drives on until the policy says that it has
arrived, and is right or wrong. No summary mixes them.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from vn_nav.arrival import ARRIVAL_RADIUS

if TYPE_CHECKING:
    from vn_nav.policy.search.snapshot import Snapshot

HABITAT_RADIUS_M = 1.0  # of Habitat's ImageNav: declared within it, whatever the heading


def _hidden():
    return dataclasses.field(default=None, compare=False, repr=False)


@dataclasses.dataclass(frozen=True)
class Episode:
    """The outcome of one journey to one picture."""

    success: bool
    start_distance: float  # m, geodesic, from start to goal; NaN: nobody knows the ways
    path_length: float  # m really moved
    decisions: int
    collisions: int  # decisions that touched something
    seconds: float  # at the robot's default limits
    stop_distance: float  # m, geodesic, at the end
    stop_heading: float  # rad, unsigned, at the end
    arrival_radius: float = ARRIVAL_RADIUS  # m, see `vn_nav.arrival.radius_of`
    unit: str = 'm'  # of distances and path: 'm'; 'steps' (decisions) on a grid; '': none
    reward: float = 0.0  # undiscounted return
    goal: str = ''
    scene: str = ''  # its name
    declared: bool | None = None  # whether the policy said "arrived"; None: nobody asked it to
    reached: bool = False  # was at the goal at the end of some decision, declared or not
    # Decisions at which the policy's action filter acted, and changed the action; None: no filter.
    filtered: tuple[int, int] | None = None
    # Whether it ended where the picture that it was shown was taken, as the crow flies; None: it
    # was shown its goal, or no picture.
    at_shown: bool | None = None
    # What a map shows; no figure depends on it.
    trajectory: np.ndarray | None = _hidden()  # [K,3] x, y [m], yaw [rad]: start and decisions
    contacts: np.ndarray | None = _hidden()  # [C,2] where the robot touched something [m]
    goal_pose: tuple[float, float, float] | None = _hidden()  # x, y, yaw; None: no such place
    # What a policy that searches knew before its last move, in a frame that begins at the start.
    search: Snapshot | None = _hidden()


def path_efficiency(episode: Episode) -> float:
    """S * l / max(p, l): the episode's share in SPL (Anderson et al. 2018).

    l is the geodesic start distance less the radius of the task's goals, p the metres really
    moved; on a grid both are steps, and the goal has no radius. NaN where nobody knows the
    shortest way.
    """
    if math.isnan(episode.start_distance):
        return math.nan  # nobody knows the shortest way
    radius = episode.arrival_radius if episode.unit == 'm' else 0.0
    shortest = max(episode.start_distance - radius, 0.0)
    longest = max(episode.path_length, shortest)
    return float(episode.success) * (shortest / longest if longest > 0 else 1.0)


def within_habitats_radius(episode: Episode) -> bool:
    """Whether it is a success by Habitat's rule: declared within 1 m, whatever the heading."""
    return bool(episode.declared) and episode.stop_distance <= HABITAT_RADIUS_M


def habitats_efficiency(episode: Episode) -> float:
    """As `path_efficiency`, by Habitat's rule, and to the goal itself."""
    shortest = episode.start_distance
    longest = max(episode.path_length, shortest)
    return float(within_habitats_radius(episode)) * (shortest / longest if longest > 0 else 1.0)


def bootstrap_interval(values: Sequence[float], *, samples: int = 2000, seed: int = 0
                       ) -> tuple[float, float]:
    """95 % interval of the mean by resampling episodes."""
    sample = np.asarray(values, float)
    rng = np.random.default_rng(seed)
    means = sample[rng.integers(len(sample), size=(samples, len(sample)))].mean(axis=1)
    low, high = np.percentile(means, [2.5, 97.5])
    return float(low), float(high)


def _mean_or_none(values: Sequence[float]) -> float | None:
    mean = float(np.mean(values))
    return None if math.isnan(mean) else mean


def summarise(episodes: Sequence[Episode]) -> dict:
    """All figures over some episodes, ready for JSON.

    `spl` and `start_distance` are None where the simulator knows no ways. On a grid
    `stop_error_steps` stands in place of `stop_error_m`, and `start_distance` counts steps. Stop
    errors and seconds are None where a simulator's actions are no motions.

    Under declared stop there are more: `declared` and `false_stops`, the shares of episodes that
    the policy ended, and that it ended in vain; `reached`, the share in which the robot stood at
    its goal at some time, whether it said so or not; `within_1m` and `spl_within_1m`, success and
    SPL by Habitat's rule (None on a grid); and, where another picture than the goal's was shown,
    `stops_at_shown`, the share that the policy ended at that one. Behind an action filter there
    are two: `filter_acted` and `filter_changed`, the shares of decisions at which it offset a
    logit, and at which another action came out than without it.

    Raises:
        ValueError: no episodes, or episodes of both kinds.
    """
    if not episodes:
        raise ValueError('figures need at least one episode; received none')
    asked = {e.declared is not None for e in episodes}
    if len(asked) > 1:
        raise ValueError('arrival and declared stop are not mixed; received episodes of both')
    units = {e.unit for e in episodes}
    if len(units) > 1:
        raise ValueError('metres and steps are not mixed; received episodes of both')
    (unit,) = units
    success = [float(e.success) for e in episodes]
    decisions = sum(e.decisions for e in episodes)
    figures = {
        'episodes': len(episodes),
        'success': float(np.mean(success)),
        'success_interval': list(bootstrap_interval(success)),
        'spl': _mean_or_none([path_efficiency(e) for e in episodes]),
        'collisions': sum(e.collisions for e in episodes) / max(decisions, 1),
        'contact_free_success': float(np.mean(
            [e.success and e.collisions == 0 for e in episodes])),
        f'stop_error_{unit or "m"}': float(np.mean([e.stop_distance for e in episodes])),
        'stop_error_deg': math.degrees(float(np.mean([e.stop_heading for e in episodes]))),
        'decisions': decisions / len(episodes),
        'decisions_interval': list(bootstrap_interval([e.decisions for e in episodes])),
        'seconds': float(np.mean([e.seconds for e in episodes])),
        'return': float(np.mean([e.reward for e in episodes])),
        'start_distance': _mean_or_none([e.start_distance for e in episodes]),
    }
    if not unit:  # nobody knows where anything is, or how long an action takes
        figures |= dict.fromkeys(('stop_error_m', 'stop_error_deg', 'seconds'))
    if asked == {True}:
        figures |= {
            'declared': float(np.mean([e.declared for e in episodes])),
            'false_stops': float(np.mean([e.declared and not e.success for e in episodes])),
            'reached': float(np.mean([e.reached for e in episodes])),
            'within_1m': None if unit != 'm' else float(
                np.mean([within_habitats_radius(e) for e in episodes])),
            'spl_within_1m': None if unit != 'm' else _mean_or_none(
                [habitats_efficiency(e) for e in episodes]),
        }
        if all(e.at_shown is not None for e in episodes):
            figures['stops_at_shown'] = float(np.mean(
                [bool(e.declared and e.at_shown) for e in episodes]))
    filtered = [e.filtered for e in episodes if e.filtered is not None]
    if len(filtered) == len(episodes):
        figures |= {name: sum(counts[k] for counts in filtered) / max(decisions, 1)
                    for k, name in enumerate(('filter_acted', 'filter_changed'))}
    return figures

"""Place recognition before the policy learns in a place: where pictures were taken, and paths."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Protocol

import cv2
import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from vn_nav.arrival import wrap_angle
from vn_nav.learning.auxiliary import softened
from vn_nav.policy.network import Policy
from vn_nav.policy.places import PathAdvice, PlaceClassifier, heading_cells

BATCH = 128  # pictures
LEARNING_RATE = 1e-3  # of Adam, at the start; falls to a twentieth
# A place cell and a heading stand for poses about so near.
CELL_RADIUS_M, HEADING_WIDTH_RAD = 0.35, np.radians(20)
MAX_JUDGED_PICTURES, MAX_JUDGED_GOALS = 1024, 32  # pictures
MAX_START_PICTURES = 8192  # that paths begin at
PATH_BATCH = 1024  # paths in a step
CELL_SEED = 1  # of the place cells


class Views(Protocol):
    """Pictures of a place with their poses; the simulator's `GraphViews` is one."""

    def draw(self, count: int) -> tuple[np.ndarray, np.ndarray]:
        """The next pictures [K,3,S,S] uint8 and poses [K,3] x, y [m], yaw [rad]."""


def spread_spots(positions: np.ndarray, count: int) -> np.ndarray:
    """[K,2] the middles of K parts that positions [N,2] fall into (k-means)."""
    cv2.setRNGSeed(CELL_SEED)
    enough = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 50, 1e-3)
    # OpenCV's annotations do not know that it makes the labels where there are none.
    _, _, spots = cv2.kmeans(  # type: ignore[call-overload]
        positions.astype(np.float32), count, None, enough, 3, cv2.KMEANS_PP_CENTERS)
    return spots


def fit_places(network: Policy, source: Views, judge: Views, positions: np.ndarray, *,
               minutes: float, say: Callable[[str], None], least: int = 0,
               show: Callable[[float], None] = lambda share: None) -> dict[str, float]:
    """Fit the classifier of a network to a place.

    Cross-entropy with the place cells and headings about the true pose (Banino et al. 2018).

    Args:
        network: with `places`, new ones; only they change.
        source: views to learn from.
        judge: views of other pictures of the place.
        positions: [N,2] m, of all pictures: the place cells are spread over them.
        minutes: wall-clock time.
        say: called with lines about the progress, a few times.
        least: pictures to learn from, however long that takes.
        show: called before every step with the share that is over; it may raise.

    Returns:
        Medians on the other pictures: `metres` and `degrees` off, and `pictures` learned from.
    """
    places, dtype = _places(network), network.compute_dtype
    places.spots.copy_(torch.from_numpy(spread_spots(positions, len(places.spots))))
    learned = places.see_as(network.encoder)
    for layer in learned:
        layer.requires_grad_(True)
    optimiser = torch.optim.Adam([part for layer in learned for part in layer.parameters()],
                                 LEARNING_RATE)
    begun, seen, reports = time.monotonic(), 0, 0
    try:
        while (share := _share((time.monotonic() - begun) / (60 * minutes), seen, least)) < 1:
            show(share)
            for group in optimiser.param_groups:
                group['lr'] = LEARNING_RATE * (1 - 0.95 * share)
            pictures, poses = source.draw(BATCH)
            scores = places.scores(torch.from_numpy(pictures), dtype)
            spot, heading = ((wanted * score).sum(1).mean() for wanted, score in zip(
                _targets(places.spots, torch.from_numpy(poses)), scores, strict=True))
            loss = -(spot + heading)
            optimiser.zero_grad(set_to_none=True)
            loss.backward()
            optimiser.step()
            seen += BATCH
            if share >= (reports + 1) / 3:
                reports += 1
                say(_summary(seen, *errors(network, judge)))
    finally:
        places.requires_grad_(False)
    metres, degrees = errors(network, judge)
    say(_summary(seen, metres, degrees))
    return {'metres': metres, 'degrees': degrees, 'pictures': seen}


def fit_paths(network: Policy, pictures: np.ndarray, goals: np.ndarray, regrets: np.ndarray, *,
              until: float, say: Callable[[str], None], seed: int = 0, least: int = 1,
              show: Callable[[float], None] = lambda share: None) -> dict[str, float]:
    """Teach `PathAdvice` the shortest paths, by what the classifier says of pictures.

    Cross-entropy with `softened` choices. Each picture is recognised once. A second learns from a
    hundred thousand paths.

    Args:
        network: with `places` that are fitted; only `routes` change.
        pictures: [N,3,S,S] uint8 where paths begin; goals: [G,3,S,S] where they end.
        regrets: [G,N,A] decisions that each first action loses.
        until: `time.monotonic()` at which to end.
        say: called with a summary line.
        least: paths to learn from, however long that takes.
        show: called before every step with the share that is over; it may raise.

    Returns:
        `regret`: decisions that the most advised first action loses on average; `ways`: how many
        were learned from.
    """
    here, there = recognise(network, pictures), recognise(network, goals)
    labels, routes = torch.from_numpy(regrets), _routes(network)
    generator = torch.Generator().manual_seed(seed)
    optimiser = torch.optim.Adam(routes.parameters(), LEARNING_RATE)
    begun, seen = time.monotonic(), 0
    limit = max(until - begun, 1e-9)
    while (share := _share((time.monotonic() - begun) / limit, seen, least)) < 1:
        show(share)
        for group in optimiser.param_groups:
            group['lr'] = LEARNING_RATE * (1 - 0.95 * share)
        goal, row = (torch.randint(size, (PATH_BATCH,), generator=generator)
                     for size in labels.shape[:2])
        loss = F.cross_entropy(routes(here[row], there[goal])[1],
                               softened(labels[goal, row].float()))
        optimiser.zero_grad(set_to_none=True)
        loss.backward()
        optimiser.step()
        seen += PATH_BATCH
    some = torch.randperm(len(labels), generator=generator)[:MAX_JUDGED_GOALS]
    lost = _regret(network, here, there[some], labels[some])
    say(f'paths: {seen:,} · the advised action loses {lost:.2f} decisions on average')
    return {'regret': lost, 'ways': seen}


def _places(network: Policy) -> PlaceClassifier:
    assert network.places is not None  # the network was made for a place
    return network.places


def _routes(network: Policy) -> PathAdvice:
    assert network.routes is not None  # the network was made for a place
    return network.routes


def _share(time_share: float, seen: int, least: int) -> float:
    """How much of the learning is over."""
    return min(time_share, seen / least) if least else time_share


@torch.no_grad()
def recognise(network: Policy, pictures: np.ndarray) -> Tensor:
    """What the classifier says of pictures [N,3,S,S], [N,K+16]."""
    places = _places(network)
    return torch.cat([places(part, network.compute_dtype)
                      for part in torch.from_numpy(pictures).split(BATCH)])


@torch.no_grad()
def _regret(network: Policy, here: Tensor, there: Tensor, labels: Tensor) -> float:
    rows, routes = torch.arange(len(here)), _routes(network)
    return float(np.mean([
        float(own[rows, routes(here, goal.expand(len(here), -1))[1].argmax(1)].float()
              .mean()) for goal, own in zip(there, labels, strict=True)]))


@torch.no_grad()
def errors(network: Policy, views: Views) -> tuple[float, float]:
    """Medians of how far off the mean pose is [m], [deg]."""
    pictures, poses = views.draw(MAX_JUDGED_PICTURES)
    found = _places(network).pose(recognise(network, pictures)).numpy()
    off = np.hypot(*(found[:, :2] - poses[:, :2]).T)
    turned = np.abs(wrap_angle(found[:, 2] - poses[:, 2]))
    return float(np.median(off)), float(np.degrees(np.median(turned)))


def _targets(spots: Tensor, poses: Tensor) -> tuple[Tensor, Tensor]:
    """What the classifier should say of poses [N,3]: [N,K] and [N,16]."""
    gap = torch.cdist(poses[:, :2].float(), spots)
    turn = poses[:, 2:].float() - heading_cells()
    turn = torch.atan2(torch.sin(turn), torch.cos(turn))
    return (torch.softmax(-0.5 * (gap / CELL_RADIUS_M)**2, dim=1),
            torch.softmax(-0.5 * (turn / HEADING_WIDTH_RAD)**2, dim=1))


def _summary(seen: int, metres: float, degrees: float) -> str:
    return (f'places: {seen:,} pictures · on others: {metres:.2f} m, {degrees:.0f} deg off '
            '(medians)')

"""How well a policy of the architecture search sees, and drives, in a sequence of photographs.

    python bench/photographs.py FOLDER --checkpoint models/search
    python bench/photographs.py FOLDER --cameras known width level grey --no-drive
    python bench/photographs.py FOLDER --episodes 60 --json photographs.json
    python bench/photographs.py FOLDER --features sift xfeat --no-drive --every 6
    python bench/photographs.py FOLDER --verify sift --every 6

The folder is described in `photo_sequence.py`. Reports, for each way to take a photograph for the
policy's camera (`CAMERAS`):

- co-visibility: the AUC over all ordered pairs of every third photograph. Positive is a pair of
  which the first shows `POSE_OVERLAP` of the second or more, by depth, negative one that shares
  nothing either way; in all and by bands of the overlap;
- relative pose of pairs with an overlap of a quarter or more: median errors;
- arrival: AUC against all other pairs, and against those that are nearly there;
- place recognition: the sequence in ten stretches; for each photograph of one, does the likeliest
  of all other stretches truly overlap;
- driving in the graph of the photographs (`vn_sim_bridge.recorded`): the right picture, the wrong
  one, random moves. Success is arrival, by the rule of the image task.

`--told METRES` drives with perfect recognition instead: where the goal stands, the robot is told
whenever that is so near and within its field of view, walls aside. What is left is planner and
graph.

With `--verify sift` also of local features of the full photographs, and of network and features
together, which then drive as well (`vn_nav.policy.search.verification`). `--from K` leaves out the
first K photographs: settings of the features were chosen on every sixth from the first on.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import math
import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from photo_features import FEATURES, matched
from photo_sequence import Camera, Sequence

from vn_nav.arrival import ARRIVAL_RADIUS
from vn_nav.arrival import arrived as is_arrived
from vn_nav.co_visibility import relative_pose
from vn_nav.errors import UserError
from vn_nav.evaluation import evaluator
from vn_nav.evaluation.metrics import summarise
from vn_nav.learning.auxiliary import POSE_OVERLAP
from vn_nav.learning.sight_figures import (
    RING_RADIUS,
    RING_SIDE,
    RING_TURN,
    angle_between,
    auc,
)
from vn_nav.lens import squeezed_pose, zoom_of
from vn_nav.policy.checkpoint import load_checkpoint
from vn_nav.policy.search.driver import sights_of
from vn_nav.policy.search.eyes import Placed
from vn_nav.policy.search.lens import in_metres
from vn_nav.policy.search.local_features import SIDE, compare, extract
from vn_nav.policy.search.look import BINS, COLUMNS, Look, Recognition, column_bearings
from vn_nav.policy.search.network import SearchPolicy
from vn_nav.policy.search.torch_eyes import TorchEyes
from vn_nav.policy.search.verification import evidence, verified
from vn_nav.policy.search.views import NONE, VERIFY
from vn_nav.resources import share_file
from vn_nav.robot import RobotSpec
from vn_sim_bridge.recorded.image_graph import build_graph
from vn_sim_bridge.teach_place import make_env

EVERY = 3
BANDS = {'tenth': (POSE_OVERLAP, 0.25), 'quarter': (0.25, 0.5), 'half': (0.5, 1.01)}
STRETCHES = 10
BATCH = 1000  # pairs
NEAR = 0.3  # m: nearer, a bearing means nothing
SURE = 30  # matches
FIGURES = ('auc', *(f'auc_{band}' for band in BANDS), 'called', 'called_apart', 'posed',
           'bearing_deg', 'heading_deg', 'position_m', 'arrived_auc', 'arrived_ring_auc', 'sure',
           'sure_far', 'recognised', 'recognisable')


class Pairs(NamedTuple):
    """Ordered pairs of K of the photographs, without those of a photograph and itself."""

    chosen: np.ndarray  # [K] numbers of the photographs
    first: np.ndarray  # [P] places in `chosen`
    second: np.ndarray
    overlap: np.ndarray  # [P] of the second that the first shows
    apart: np.ndarray  # [P] bool: they share nothing, either way
    truth: np.ndarray  # [P,4] as of `relative_pose`


def pairs_of(sequence: Sequence, every: int, first: int = 0) -> Pairs:
    """All pairs of some of a sequence."""
    chosen = np.arange(first, len(sequence), every)
    overlap = sequence.overlaps(chosen)
    one, other = np.nonzero(~np.eye(len(chosen), dtype=bool))
    own, back = overlap[one, other], overlap[other, one]
    return Pairs(chosen, one, other, own, (own == 0) & (back == 0),
                 sequence.relative(chosen[one], chosen[other]))


def cameras_of(sequence: Sequence) -> dict[str, tuple[Camera, bool]]:
    """By name: how the photographs are taken, and whether the lens is told to the policy."""
    across, upright = sequence.fov, sequence.upright_fov
    square = Camera(upright, cut=True, upright=False)
    return {
        'as before': (square, False),  # the square of the shorter side, read as the known lens
        'square': (square, True),
        'width': (Camera(across, upright=False), True),  # as `policy_node` does
        'upright': (Camera(across), True),
        'known': (Camera(math.radians(90)), True),  # small in a picture of the known lens
        'level': (Camera(across, pitch=0.0), True),
        'level 70': (Camera(math.radians(70), pitch=0.0), True),
        'level 90': (Camera(math.radians(90), pitch=0.0), True),
        'slope 70': (Camera(math.radians(70), pitch=math.radians(10)), True),
        **{shown: (Camera(across, upright=False, shown=shown), True)
           for shown in ('standard', 'equal', 'grey')},
    }


@torch.inference_mode()
def look(network: SearchPolicy, images: np.ndarray, pairs: Pairs, zoom: float) -> Look:
    """What the network says of pairs, in metres; of ranges nothing."""
    pictures = torch.from_numpy(images)
    goals = network.encoder.encode_goals(pictures, network.compute_dtype)
    seen = network.encoder.see(pictures, network.compute_dtype)
    parts = []
    for begin in range(0, len(pairs.first), BATCH):
        own, other = (torch.from_numpy(part[begin:begin + BATCH])
                      for part in (pairs.first, pairs.second))
        said = network.recogniser(network.encoder.meet(seen[own], goals[other], None)[1])
        ranges = np.full((len(own), COLUMNS, BINS), -math.log(BINS), np.float32)
        placed = Placed.of(Recognition(*(part.numpy() for part in said)))
        parts.append(in_metres(Look(ranges, *placed), column_bearings(network.config.view),
                               zoom)._replace(ranges=ranges[:, :1, :1]))
    return Look(*(np.concatenate(part) for part in zip(*parts, strict=True)))


def judge(pairs: Pairs, score: np.ndarray, position: np.ndarray | None = None,
          heading: np.ndarray | None = None, called: np.ndarray | None = None,
          arrived: np.ndarray | None = None) -> dict[str, float]:
    """`FIGURES` of pairs with a score [P] that is high where the pictures overlap.

    Args:
        pairs: the pairs; score: [P].
        position, heading: [P,2] of the second in the frame of the first; nan: not known.
        called: [P] bool: whether they are said to overlap.
        arrived: [P] score of having arrived; None: that of the overlap.
    """
    def against(low: float, high: float) -> float:
        own = (pairs.overlap >= low) & (pairs.overlap < high)
        some = own | pairs.apart
        return auc(score[some], own[some])

    found = {'auc': against(POSE_OVERLAP, 1.01),
             **{f'auc_{name}': against(*band) for name, band in BANDS.items()}}
    sees = pairs.overlap >= 0.25
    if called is not None:
        found |= {'called': float(called[sees].mean()),
                  'called_apart': float(called[pairs.apart].mean())}
    if position is not None and heading is not None:
        posed = np.isfinite(position[:, 0])
        found['posed'] = float(posed[sees].mean())
        sees &= posed
        far = sees & (np.hypot(*pairs.truth[:, :2].T) > NEAR)
        gap = np.hypot(*(position - pairs.truth[:, :2])[sees].T)
        found |= {
            'bearing_deg': _degrees(angle_between(position[far], pairs.truth[far, :2])),
            'heading_deg': _degrees(angle_between(heading[sees], pairs.truth[sees, 2:])),
            'position_m': float(np.median(gap))}
    return found | arrival(pairs, score if arrived is None else arrived) | recognition(
        pairs, score)


def arrival(pairs: Pairs, score: np.ndarray) -> dict[str, float]:
    """How well a score [P] tells arrivals from all else, and from what is nearly one."""
    distance = np.hypot(*pairs.truth[:, :2].T)
    turn = np.abs(np.arctan2(pairs.truth[:, 3], pairs.truth[:, 2]))
    there = is_arrived(distance, turn)
    ring = ~there & (((distance <= RING_RADIUS) & (turn <= RING_SIDE))
                     | ((distance <= ARRIVAL_RADIUS) & (turn <= RING_TURN)))
    near = there | ring
    return {'arrived_auc': auc(score, there), 'arrived_ring_auc': auc(score[near], there[near])}


def sure(pairs: Pairs, count: np.ndarray) -> dict[str, float]:
    """How often a count [P] of matches is `SURE`: of arrivals, and of pairs beyond the ring."""
    distance = np.hypot(*pairs.truth[:, :2].T)
    turn = np.abs(np.arctan2(pairs.truth[:, 3], pairs.truth[:, 2]))
    return {'sure': float((count >= SURE)[is_arrived(distance, turn)].mean()),
            'sure_far': float((count >= SURE)[distance > RING_RADIUS].mean())}


def recognition(pairs: Pairs, score: np.ndarray) -> dict[str, float]:
    """Share of the photographs whose best match in other stretches overlaps, and could."""
    count = len(pairs.chosen)
    scores, overlaps = np.full((count, count), -np.inf), np.zeros((count, count))
    scores[pairs.first, pairs.second] = score
    overlaps[pairs.first, pairs.second] = pairs.overlap
    stretch = np.arange(count) * STRETCHES // count
    same = stretch[:, None] == stretch[None]
    best = np.where(same, -np.inf, scores).argmax(1)
    right = overlaps[np.arange(count), best] >= POSE_OVERLAP
    can = (np.where(same, 0, overlaps) >= POSE_OVERLAP).any(1)
    return {'recognised': float(right.mean()), 'recognisable': float(can.mean())}


def judge_verified(sequence: Sequence, pairs: Pairs, said: Look) -> dict[str, dict[str, float]]:
    """Rows of local features alone, and of what the network says with them."""
    pitch = camera_pitch(sequence, None)
    features = [extract(sequence.images[k], sequence.upright_fov) for k in pairs.chosen]
    found = [compare(features[one], features[other], pitch)
             for one, other in zip(pairs.first, pairs.second, strict=True)]
    logits = np.array([evidence(own) for own in found])
    turns = np.array([own.heading for own in found])
    rows = {'features alone': judge(
        pairs, logits[:, 0], np.array([own.position for own in found]),
        np.column_stack([np.cos(turns), np.sin(turns)]), logits[:, 0] > 0, logits[:, 1])}
    both = [verified(sight, own) for sight, own in zip(sights_of(said), found, strict=True)]
    shown = np.array([sight.co_visible for sight in both])
    rows['verified'] = judge(
        pairs, shown, np.array([sight.position for sight in both]),
        np.array([sight.heading for sight in both]), shown > 0.5,
        np.array([sight.arrived for sight in both]))
    return rows


def camera_pitch(sequence: Sequence, wanted: float | None) -> float:
    """Of the camera of a robot that took the sequence [rad down]."""
    return float(np.median(sequence.poses[:, 3])) if wanted is None else wanted


class Told:
    """Eyes that see a goal wherever it stands ahead within some metres; ranges as of a network.

    Args:
        network: in whose place they are.
        zoom: of the lens, which what they say is squeezed by, see `vn_nav.lens`.
        metres: how far they see.

    Attributes:
        truth: [N,4] of the goals as the robots see them, before each look.
    """

    def __init__(self, network: SearchPolicy, zoom: float, fov: float, metres: float):
        self.config, self.taught, self.rules = network.config, None, network.rules
        self.compute_dtype, self._network = network.compute_dtype, network
        self._zoom, self._fov, self._metres = zoom, fov, metres
        self.truth = np.zeros((0, 4))

    def look(self, image: torch.Tensor, goal_maps: torch.Tensor) -> Look:
        """As `SearchPolicy.look`."""
        x, y = self.truth[:, :2].T
        gap = np.hypot(x, y)
        sees = (gap <= self._metres) & ((np.abs(np.arctan2(y, x)) <= self._fov / 2)
                                        | (gap <= ARRIVAL_RADIUS))
        said = torch.from_numpy(squeezed_pose(self.truth, np.full(len(x), self._zoom))).float()
        sure = torch.full((len(x),), 0.1)
        shown = torch.from_numpy(np.where(sees, 5.0, -3.0)).float()
        return self._network.look(image, goal_maps)._replace(
            position=said[:, :2], position_sigma=sure, heading=said[:, 2:], heading_sigma=sure,
            co_visible=shown, arrived=shown)


class ToldActor(evaluator.PolicyActor):
    """A policy with such eyes."""

    def __init__(self, env, network: SearchPolicy, metres: float):
        super().__init__(env, network, 'greedy', 0)
        fov = env.robot.camera_fov
        self._eyes = Told(network, max(zoom_of(fov, network.config.view), 1.0), fov, metres)
        assert self.policy.search is not None  # by its architecture
        self.policy.search.eyes = TorchEyes(self._eyes)  # type: ignore[arg-type]

    def __call__(self, observation: dict, reset: np.ndarray) -> np.ndarray:
        """Actions."""
        self._eyes.truth = relative_pose(self.env.simulator.poses,
                                         self.env.goal_poses[observation['goal_index']])
        return super().__call__(observation, reset)


def drive(sequence: Sequence, network: SearchPolicy, camera: Camera, told: bool, episodes: int,
          decisions: int, verify: str = NONE, told_metres: float | None = None
          ) -> dict[str, dict]:
    """Rows of episodes in the graph of the photographs."""
    every = np.arange(len(sequence))
    images = sequence.pictures(camera, network.config.size if verify == NONE else SIDE, every)
    pitch = camera_pitch(sequence, camera.pitch)
    spec = RobotSpec()
    robot = dataclasses.replace(spec, camera_fov=camera.fov if told else network.config.view,
                                camera_pitch=pitch).with_actions(network.config.actions)
    graph = build_graph(images, sequence.poses[:, :3], np.zeros(len(sequence), np.int64), robot,
                        world_version='recorded', name='bag:photographs')
    for line in graph.words:
        print(line, file=sys.stderr, flush=True)
    env = make_env(graph, robot, min(episodes, evaluator.ENVIRONMENTS), stop=evaluator.ARRIVAL,
                   max_decisions=decisions, odometry='drift')
    rows = evaluator.make_actors(env, network, 'greedy', (
        evaluator.WRONG, evaluator.RANDOM, evaluator.SHORTEST), evaluator.STOP_THRESHOLD, 0,
        verify=verify)
    if told_metres is not None:
        rows = {f'told within {told_metres:g} m': (ToldActor(env, network, told_metres), 'right')}
    found = {}
    for name, (actor, shown) in rows.items():
        env.set_shown_goal(shown)
        found[name] = summarise(evaluator.run_episodes(env, actor, episodes, seed=0, robot=robot))
        print(f'{name}: {found[name]["success"]:.2f}', file=sys.stderr, flush=True)
    env.close()
    return found


def _degrees(angles: np.ndarray) -> float:
    return float(np.degrees(np.median(angles)))


def print_table(rows: dict[str, dict[str, float]]) -> None:
    """Rows of `FIGURES` as Markdown."""
    names = [name for name in FIGURES if any(name in row for row in rows.values())]
    lines = [f'| | {" | ".join(names)} |', f'|---|{"---|" * len(names)}']
    for title, row in rows.items():
        cells = [f'{row[name]:.3g}' if name in row else '-' for name in names]
        lines.append(f'| {title} | {" | ".join(cells)} |')
    print('\n'.join(lines), flush=True)


def run(options: argparse.Namespace) -> None:
    """All reports."""
    torch.set_num_threads(1)
    network = load_checkpoint(options.checkpoint).network
    if not isinstance(network, SearchPolicy):
        raise UserError('photographs are judged by a policy of the architecture search',
                        str(options.checkpoint), 'give another checkpoint')
    sequence = Sequence(options.folder)
    cameras = cameras_of(sequence)
    for name in options.cameras:
        if name not in cameras:
            raise UserError(f'a camera is one of {", ".join(cameras)}', name, 'choose some')
    pairs = pairs_of(sequence, options.every, options.first)
    seen = pairs.overlap >= POSE_OVERLAP
    print(f'{len(sequence)} photographs, {math.degrees(sequence.fov):.0f} x '
          f'{math.degrees(sequence.upright_fov):.0f} deg; {len(pairs.first):,} pairs, '
          f'{seen.mean():.0%} overlap, {pairs.apart.mean():.0%} share nothing\n', flush=True)
    rows = {}
    for name in options.cameras:
        camera, told = cameras[name]
        images = sequence.pictures(camera, network.config.size, pairs.chosen)
        zoom = zoom_of(camera.fov, network.config.view) if told else 1.0
        said = look(network, images, pairs, zoom)
        rows[name] = judge(pairs, said.co_visible, said.position, said.heading,
                           said.co_visible > 0, said.arrived)
        if options.verify != NONE:
            rows |= {f'{name}, {title}': row
                     for title, row in judge_verified(sequence, pairs, said).items()}
    for name in options.features:
        for kind, counts in matched(name, sequence, pairs.chosen).items():
            score = counts[pairs.first, pairs.second]
            rows[f'{name}, {kind}'] = judge(pairs, score) | sure(pairs, score)
    print_table(rows)
    result = {'checkpoint': str(options.checkpoint), 'pairs': len(pairs.first), 'sight': rows}
    if options.drive:
        camera, told = cameras[options.cameras[0]]
        result['drive'] = drive(sequence, network, camera, told, options.episodes,
                                options.decisions, options.verify, options.told)
        print(f'\n| driving, {options.cameras[0]}, verify {options.verify} '
              '| success | SPL | decisions |\n|---|---|---|---|')
        for name, row in result['drive'].items():
            print(f'| {name} | {row["success"]:.2f} | {row["spl"]:.2f} | {row["decisions"]:.0f} |')
    text = json.dumps(result)
    if options.json:
        options.json.write_text(text)
    print(f'\n{text}')


def main() -> int:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__.split('\n')[0])
    parser.add_argument('folder', type=Path)
    parser.add_argument('--checkpoint', type=Path, default=share_file('models/search'))
    parser.add_argument('--cameras', nargs='+', default=['width'], metavar='CAMERA',
                        help='the first one drives')
    parser.add_argument('--every', type=int, default=EVERY, help='photographs: every so many')
    parser.add_argument('--from', type=int, default=0, dest='first', help='the first of them')
    parser.add_argument('--verify', choices=VERIFY, default=NONE)
    parser.add_argument('--told', type=float, metavar='METRES')
    parser.add_argument('--features', nargs='+', choices=FEATURES, default=(),
                        help='judge local features of the photographs as well')
    parser.add_argument('--no-drive', dest='drive', action='store_false')
    parser.add_argument('--episodes', type=int, default=60)
    parser.add_argument('--decisions', type=int, default=100, help='of an episode, at most')
    parser.add_argument('--json', type=Path, metavar='FILE')
    try:
        run(parser.parse_args())
    except UserError as error:
        print(error, file=sys.stderr)
        return 2
    return 0


if __name__ == '__main__':
    sys.exit(main())

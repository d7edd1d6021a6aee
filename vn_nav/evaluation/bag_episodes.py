"""Episodes out of a bag that the sim bridge's topics were recorded into.

Nothing is taken from the bridge's own summaries: decisions, collisions, success, declared stops
and the metres driven are counted from `reward`, `collision`, `episode_end` and
`ground_truth/odom`.
"""

from __future__ import annotations

import bisect
import dataclasses
import json
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from vn_msgs_py.images import decode_rgb
from vn_msgs_py.motion import odometry_to_array
from vn_nav.bags.storage.reader import Record, read_bag
from vn_nav.errors import UserError
from vn_nav.evaluation.bag_searches import PlacedSearch, read_searches
from vn_nav.evaluation.metrics import Episode

TOPICS = ('scene', 'episode', 'reward', 'collision', 'episode_end', 'ground_truth/odom',
          'goal_image', 'image_raw')
# The bridge publishes an outcome just before the next episode, and then stands still for a tick of
# 50 ms: what comes this long after an episode's beginning still belongs to the one before.
GRACE = 5_000_000  # ns


@dataclasses.dataclass
class RecordedEpisode:
    """One journey as the bag shows it."""

    facts: dict  # of the `episode` topic: index, goal, room, start, start_distance, limits
    episode: Episode
    trajectory: np.ndarray  # [K,3] x, y, yaw in the map
    goal_picture: np.ndarray | None  # [H,W,3] uint8
    # Number of the decision, from 1: the camera picture [H,W,3] uint8 that it was made on.
    pictures: dict[int, np.ndarray]
    # Likewise, for some decisions: what a policy that searches knew at that picture.
    searches: dict[int, PlacedSearch]


@dataclasses.dataclass
class Drive:
    """All episodes in one scene."""

    scene: dict
    episodes: list[RecordedEpisode]


def drives_from_bag(folder: str | Path, *, pictures: bool = False,
                    policies: Sequence[str] = ()) -> list[Drive]:
    """Every scene of a bag with its finished episodes, in order.

    Args:
        folder: of the bag.
        pictures: also decode goal and camera pictures.
        policies: names of nodes that published their map, if they search.

    Raises:
        UserError: no readable bag, or one without the bridge's topics.
    """
    records: dict[str, list[Record]] = {name: [] for name in TOPICS}
    for record in read_bag(folder, TOPICS if pictures else TOPICS[:6]):
        records[record.topic].append(record)
    scenes = [(r.stamp, json.loads(r.message.data)) for r in records['scene']]
    begins = [(r.stamp, json.loads(r.message.data)) for r in records['episode']]
    if not scenes or not begins:
        raise UserError('the bag holds the topics scene and episode', str(folder),
                        'record the sim bridge with recorder_node')
    order = [stamp for stamp, _ in begins]

    def owner(stamp: int) -> int:
        """The episode that a message published at `stamp` belongs to."""
        return max(0, bisect.bisect_left(order, stamp - GRACE) - 1)

    count = len(begins)
    rewards: list[list[float]] = [[] for _ in range(count)]
    touched: list[list[bool]] = [[] for _ in range(count)]
    ends: list[list[int]] = [[] for _ in range(count)]
    judged_at: list[list[int]] = [[] for _ in range(count)]
    for topic, lists in (('reward', rewards), ('collision', touched), ('episode_end', ends)):
        for record in records[topic]:
            lists[owner(record.stamp)].append(record.message.data)
            if topic == 'reward':
                judged_at[owner(record.stamp)].append(record.stamp)
    # Poses and pictures carry the simulated time, which tells exactly where they belong.
    begun_at = [facts['stamp'] for _, facts in begins]

    def owner_by_stamp(seconds: float) -> int:
        return max(0, bisect.bisect_right(begun_at, seconds + 1e-6) - 1)

    poses: list[list[np.ndarray]] = [[] for _ in range(count)]
    posed_at: list[list[int]] = [[] for _ in range(count)]
    truth: list[list[np.ndarray]] = [[] for _ in range(count)]
    for record in records['ground_truth/odom']:
        values = odometry_to_array(record.message)
        poses[owner_by_stamp(values[6])].append(values[:3])
        truth[owner_by_stamp(values[6])].append(values)
        posed_at[owner_by_stamp(values[6])].append(record.stamp)
    goal_pictures: list[np.ndarray | None] = [None] * count
    views: list[dict[int, np.ndarray]] = [{} for _ in range(count)]
    for record in records['goal_image']:
        goal_pictures[owner_by_stamp(_seconds(record.message))] = decode_rgb(record.message)
    for record in records['image_raw']:
        k = owner_by_stamp(_seconds(record.message))
        # The first picture since the last judgement; at rest others follow while the policy
        # thinks.
        number = bisect.bisect_right(judged_at[k], record.stamp) + 1
        if number not in views[k]:
            views[k][number] = decode_rgb(record.message)
    firsts = [own[0] if own else np.full(7, np.nan) for own in truth]
    searches = read_searches(folder, policies, begun_at, firsts)
    drives = [Drive(scene, []) for _, scene in scenes]
    for k, (stamp, facts) in enumerate(begins):
        place = max(0, bisect.bisect_right([s for s, _ in scenes], stamp + GRACE) - 1)
        if not ends[k]:
            continue  # cut off: no figure counts it
        trajectory = np.array(poses[k]).reshape(-1, 3)
        episode = _measure(facts, trajectory, rewards[k], touched[k], ends[k],
                           drives[place].scene['tick'])
        if drives[place].scene.get('stop') == 'declared':
            # A decision is judged just before its last pose is published, which is the pose of
            # the tick before: the robot has come to rest.
            last = [max(0, bisect.bisect_left(posed_at[k], at) - 1) for at in judged_at[k]]
            episode = dataclasses.replace(
                episode, declared=ends[k][-1] == 1,
                reached=_reached(trajectory[last], facts['goal_pose'], drives[place].scene))
        # After the last episode of all, a robot that stands still goes on to see.
        seen = {number: view for number, view in views[k].items() if number <= len(rewards[k])}
        drives[place].episodes.append(RecordedEpisode(
            facts, episode, trajectory, goal_pictures[k], seen,
            {bisect.bisect_right(judged_at[k], search.recorded) + 1: search
             for search in searches[k]}))
    return drives


def _seconds(message) -> float:
    return message.header.stamp.sec + message.header.stamp.nanosec * 1e-9


def _reached(poses: np.ndarray, goal: list, scene: dict) -> bool:
    """Was one of the poses [K,3] at the goal? In a straight line, as `stop_distance`."""
    there = np.hypot(*(poses[:, :2] - goal[:2]).T) <= scene['arrival']['radius']
    turn = np.abs((poses[:, 2] - goal[2] + math.pi) % (2 * math.pi) - math.pi)
    return bool((there & (turn <= math.radians(scene['arrival']['heading_deg']))).any())


def _measure(facts: dict, trajectory: np.ndarray, rewards: list, touched: list,
             ends: list, tick: float) -> Episode:
    steps = np.hypot(*np.diff(trajectory[:, :2], axis=0).T) if len(trajectory) > 1 else [0.0]
    goal = facts['goal_pose']
    last = trajectory[-1] if len(trajectory) else np.full(3, np.nan)
    turn = (last[2] - goal[2] + math.pi) % (2 * math.pi) - math.pi
    return Episode(
        success=ends[-1] == 1 and sum(rewards) > 0,
        start_distance=math.nan if (way := facts['start_distance']) is None else way,
        path_length=float(np.sum(steps)), decisions=len(rewards), collisions=int(sum(touched)),
        # At the speed of the recorded base; straight-line distance: a bag has no floor map.
        seconds=tick * len(trajectory), stop_distance=math.dist(last[:2], goal[:2]),
        stop_heading=float(abs(turn)), reward=float(sum(rewards)), goal=facts['room'])

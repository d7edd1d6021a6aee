"""Local features of full pictures, and how they verify what the network of search sees."""

import dataclasses
import math

import cv2
import numpy as np
import pytest
import torch

from vn_nav.errors import UserError
from vn_nav.observation import OUTSIDE_GREY
from vn_nav.policy.runtime import PolicyRuntime
from vn_nav.policy.search.local_features import (
    NOTHING,
    SIDE,
    Features,
    compare,
    extract,
)
from vn_nav.policy.search.searcher import Sight
from vn_nav.policy.search.verification import evidence, verified
from vn_nav.policy.search.views import FeaturePairs, View, check_verify

FOV = math.radians(70)
SIZE = 256
SEARCH = 'models/search'


class Room:
    """Two textured walls at different depths, drawn by a pinhole camera at a planar pose."""

    WALLS = ((4.0, -4.0, 4.0), (2.4, 0.3, 1.6))  # m ahead, from and to [m] left

    def __init__(self, seed: int):
        random = np.random.default_rng(seed)
        self._textures = []
        for _ in self.WALLS:
            noise = np.zeros((512, 1024))
            for cell in (4, 8, 16, 32):
                noise += cell**0.5 * cv2.resize(random.standard_normal(
                    (512 // cell, 1024 // cell)), (1024, 512), interpolation=cv2.INTER_CUBIC)
            self._textures.append(cv2.normalize(noise, None, 0, 255, cv2.NORM_MINMAX))

    def view(self, x: float, y: float, yaw: float, pitch: float = 0.0) -> np.ndarray:
        """What a camera sees, [SIZE,SIZE,3] uint8."""
        slope = (np.arange(SIZE) + 0.5 - SIZE / 2) / (SIZE / 2) * math.tan(FOV / 2)
        right, down = np.meshgrid(slope, slope)
        c, s = math.cos(yaw), math.sin(yaw)
        level = math.cos(pitch) - math.sin(pitch) * down
        down = math.sin(pitch) + math.cos(pitch) * down
        forward, left = c * level + s * right, s * level - c * right
        picture = np.zeros((SIZE, SIZE))
        for texture, (depth, low, high) in zip(self._textures, self.WALLS, strict=True):
            way = (depth - x) / forward
            at, up = y + way * left, -way * down
            wall = cv2.remap(texture, ((at + 4) * 128).astype(np.float32),
                             ((up + 2) * 128).astype(np.float32), cv2.INTER_LINEAR,
                             borderMode=cv2.BORDER_REFLECT)
            seen = (forward > 0) & (at >= low) & (at <= high)
            picture[seen] = wall[seen]
        return np.repeat(picture.astype(np.uint8)[..., None], 3, 2)


@pytest.fixture(scope='module')
def room():
    return Room(1)


def features(room: Room, *pose: float) -> Features:
    return extract(room.view(*pose), FOV)


@pytest.mark.parametrize('there', [(0.5, 0.0, 0.0), (0.3, -0.4, 0.25), (-0.4, 0.3, -0.3)])
def test_a_motion_is_recovered(room, there):
    found = compare(features(room, 0, 0, 0), features(room, *there))
    assert found.rich and found.inliers > 40 and found.matches >= found.inliers / 2
    bearing = math.atan2(found.position[1], found.position[0])
    assert bearing == pytest.approx(math.atan2(there[1], there[0]), abs=math.radians(8))
    assert found.heading == pytest.approx(there[2], abs=math.radians(2))
    length = float(np.hypot(*found.position)) / math.hypot(*there[:2])
    assert 0.4 < length < 1.6  # the walls are about as far as things are as a rule


def test_a_turn_on_the_spot_is_short(room):
    for turn in (0.0, 0.2):
        found = compare(features(room, 0, 0, 0), features(room, 0, 0, turn))
        assert found.inliers > 40
        assert found.heading == pytest.approx(turn, abs=math.radians(1))
        assert np.hypot(*found.position) < 0.05


def test_a_camera_that_looks_down_is_turned_back(room):
    pitch = math.radians(40)
    one, other = (features(room, *pose, pitch) for pose in ((0, 0, 0), (0.2, 0.3, 0.3)))
    level, told = compare(one, other), compare(one, other, pitch)
    assert abs(told.heading - 0.3) < math.radians(2)
    bearing = math.atan2(told.position[1], told.position[0])
    assert bearing == pytest.approx(math.atan2(0.3, 0.2), abs=math.radians(8))
    assert abs(level.heading - 0.3) > math.radians(3)  # it matters


def test_another_room_shares_nothing(room):
    other = Room(2)
    for pose in ((0, 0, 0), (0.5, 0.2, 0.3)):
        found = compare(features(room, 0, 0, 0), features(other, *pose))
        assert found.rich and found.inliers == 0 and np.isnan(found.heading)
        # Noise is like noise: it may be in view, but nobody has arrived.
        co_visible, arrived = evidence(found)
        assert co_visible < 0.5 and arrived < -2
    same = evidence(compare(features(room, 0, 0, 0), features(room, 0.2, 0, 0.1)))
    assert same[0] > 3 and same[1] > 1


def test_plain_pictures_say_nothing(room):
    plain = extract(np.full((SIZE, SIZE, 3), 90, np.uint8), FOV)
    assert len(plain.rays) == 0
    assert compare(features(room, 0, 0, 0), plain) is NOTHING


def test_where_a_camera_does_not_reach_there_is_no_feature(room):
    picture = room.view(0, 0, 0)
    picture[:80] = picture[-80:] = OUTSIDE_GREY
    found = extract(picture, FOV)
    down = found.rays[:, 1] / found.pixel
    assert len(found.rays) > 50 and np.abs(down).max() < SIZE / 2 - 80


def test_a_large_picture_is_made_smaller(room):
    picture = cv2.resize(room.view(0, 0, 0), (4 * SIZE, 4 * SIZE))
    found = extract(picture, FOV)
    assert found.pixel == pytest.approx(2 * math.tan(FOV / 2) / SIDE, rel=0.01)
    # It lies to the same picture, smaller, as that lies to itself.
    both = compare(found, features(room, 0, 0, 0))
    assert both.inliers > 40 and abs(both.heading) < math.radians(1)


def sight(**options) -> Sight:
    return dataclasses.replace(
        Sight(np.ones((32, 24)), np.array([2.0, 1.0]), 0.5, np.array([0.0, 1.0]), 0.5, 0.5),
        **options)


def test_features_raise_what_the_network_missed(room):
    found = compare(features(room, 0, 0, 0), features(room, 0.3, 0.1, 0.1))
    said = verified(sight(co_visible=0.1, arrived=0.1), found)
    assert said.co_visible > 0.8 and said.arrived > 0.6
    assert said.position == pytest.approx(found.position)
    assert math.atan2(said.heading[1], said.heading[0]) == pytest.approx(found.heading)


def test_features_veto_what_the_network_took_for_the_goal(room):
    found = compare(features(room, 0, 0, 0), features(Room(2), 0, 0, 0))
    before = sight(co_visible=0.9, arrived=0.98)
    said = verified(before, found)
    assert said.arrived < 0.2 and said.co_visible < 0.65
    assert (said.position == before.position).all() and said.sigma > before.sigma


def test_without_features_nothing_changes():
    before = sight()
    assert verified(before, NOTHING) is before


def test_goals_are_looked_at_once(room, monkeypatch):
    images = np.stack([room.view(0, 0, 0.1 * k).transpose(2, 0, 1) for k in range(3)])
    pairs = FeaturePairs(FOV)
    first = pairs.of(images, images, np.array([0, 0, 2]))
    assert first[0].goal is first[1].goal and first[0].goal is not first[2].goal
    second = pairs.of(images, images, np.array([0, 2, 2]))
    assert second[0].goal is first[0].goal and second[1].goal is first[2].goal
    changed = pairs.of(images, images.copy(), np.array([0, 0, 2]))
    assert changed[0].goal is not first[0].goal


def test_a_runtime_verifies_with_full_pictures_alone(room):
    torch.set_num_threads(1)
    full = View(room.view(0, 0, 0), FOV)
    elsewhere = View(Room(2).view(0, 0, 0), FOV)
    found = {}
    for verify in ('none', 'sift'):
        policy = PolicyRuntime(SEARCH, verify=verify)
        small, zoom = policy.prepare(full.picture, FOV)
        for name, goal, view in (('without', None, None), ('same', full, full),
                                 ('other', elsewhere, full)):
            policy.set_goal(small, goal)  # the network is shown the same whatever the features
            action = policy.act(small, np.zeros(3), None, zoom, view)
            found[verify, name] = action, policy.arrival
    without = found['none', 'without']
    assert without == found['none', 'same'] == found['none', 'other'] == found['sift', 'without']
    assert found['sift', 'same'][1] > 0.9 and found['sift', 'other'][1] < 0.2


@pytest.mark.parametrize(('verify', 'searches', 'says'), [
    ('surf', True, 'none, sift'), ('sift', False, 'another architecture')])
def test_what_cannot_verify_is_refused(verify, searches, says):
    with pytest.raises(UserError, match=says):
        check_verify(verify, searches)
    check_verify('none', False)

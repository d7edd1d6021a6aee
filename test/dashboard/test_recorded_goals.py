"""Goals out of a recorded drive."""

import itertools
import math

import cv2
import numpy as np
import pytest
from small_bags import FIXTURE, drive, write

from vn_nav.dashboard.pictures import jpeg
from vn_nav.dashboard.recorded_goals import APART_M, APART_RAD, read_goals
from vn_nav.errors import UserError


def test_goals_lie_apart_along_the_drive_and_show_what_was_seen():
    found = read_goals(FIXTURE)
    assert found.name == 'house_drive' and len(found.goals) >= 3
    for one, two in itertools.combinations(found.goals, 2):
        turn = abs((two.pose[2] - one.pose[2] + math.pi) % (2 * math.pi) - math.pi)
        assert math.dist(one.pose[:2], two.pose[:2]) >= APART_M or turn >= APART_RAD
        assert not np.array_equal(one.picture, two.picture)
    ways = [np.hypot(*(found.path - goal.pose[:2]).T).min() for goal in found.goals]
    assert max(ways) < 1e-6, 'each lies on the path'
    small = cv2.imdecode(np.frombuffer(found.goals[0].thumbnail, np.uint8), cv2.IMREAD_COLOR)
    assert min(small.shape[:2]) <= 160


@pytest.mark.parametrize('most', [1, 2, 5])
def test_of_a_long_drive_there_are_only_so_many(tmp_path, most):
    write(tmp_path / 'long.mcap', drive(seconds=20.0, speed=1.0))
    found = read_goals(tmp_path / 'long.mcap', most)
    assert 1 <= len(found.goals) <= most
    assert found.path[-1, 0] - found.path[0, 0] > 15, 'the path is all of it'


def test_a_bag_without_pictures_is_refused(tmp_path):
    write(tmp_path / 'blind.mcap', [m for m in drive() if 'image' not in m[0]])
    with pytest.raises(UserError, match='image'):
        read_goals(tmp_path / 'blind.mcap')


def test_a_picture_is_made_smaller_never_larger():
    wide = np.zeros((300, 600, 3), np.uint8)
    wide[..., 0] = 200
    small = cv2.imdecode(np.frombuffer(jpeg(wide, 100), np.uint8), cv2.IMREAD_COLOR)
    assert small.shape[:2] == (100, 200) and small[50, 100, 2] > 180
    same = cv2.imdecode(np.frombuffer(jpeg(wide, 1000), np.uint8), cv2.IMREAD_COLOR)
    assert same.shape == wide.shape

"""Curricula: by frames as in the thesis, and by success."""

import numpy as np
import pytest

from vn_nav.learning.curriculum import Curriculum, FrameCurriculum
from vn_nav.learning.rollout import Episode


def episode(env, number, success):
    return Episode(env, number, success, float(success), 5, 0)


def test_the_frame_curriculum_follows_the_thesis():
    """0.3 until 5e6 of 4e7 frames, 1.0 from 1e7 on (thesis, 4.5 and 5.7)."""
    curriculum = FrameCurriculum()
    taus = []
    for frames in (0, 4.9e6, 7.5e6, 1e7, 4e7):
        curriculum.update([], np.zeros(1), frames / 4e7)
        taus.append(curriculum.tau)
    assert taus == pytest.approx([0.3, 0.3, 0.65, 1.0, 1.0])
    assert not curriculum.update([], np.zeros(1), 1.0)
    first = FrameCurriculum(begin=2.5, end=5.0)  # the thesis's first 2e6 frames
    assert not first.update([], np.zeros(1), 1.0) and first.tau == 0.3
    other = FrameCurriculum()
    other.load_state_dict(curriculum.state_dict())
    assert other.tau == 1.0


def test_success_raises_the_difficulty_once_every_environment_has_had_its_say():
    curriculum = Curriculum(2, start=0.5, threshold=0.75, step=0.3, window=4)
    present = np.array([3, 3])
    quick = [episode(0, number, True) for number in range(4)]
    assert not curriculum.update(quick, present, 0.0)  # the second environment is still at it
    assert curriculum.update([episode(1, 0, True)], present, 0.0)
    assert curriculum.tau == 0.8 and np.isnan(curriculum.success)
    # Episodes 0 to 3 began at the old difficulty.
    assert not curriculum.update([episode(e, 3, True) for e in (0, 1)] * 4, present, 0.0)
    assert np.isnan(curriculum.success)
    later = [episode(e, 4, True) for e in (0, 1)] * 2
    assert curriculum.update(later, np.array([4, 4]), 0.0) and curriculum.tau == 1.0


def test_three_of_four_are_not_enough_for_a_threshold_of_three_quarters():
    curriculum = Curriculum(1, start=0.5, threshold=0.75, step=0.1, window=4)
    ends = [episode(0, number, number > 0) for number in range(4)]
    assert not curriculum.update(ends, np.array([4]), 0.0)
    assert curriculum.success == 0.75 and curriculum.tau == 0.5
    assert curriculum.update([episode(0, 4, True)], np.array([5]), 0.0)


def test_a_saved_curriculum_goes_on():
    curriculum = Curriculum(2, start=0.5, window=3)
    curriculum.update([episode(0, 0, True), episode(0, 1, False)], np.array([2, 0]), 0.0)
    other = Curriculum(2, window=3)
    other.load_state_dict(curriculum.state_dict())
    assert other.state_dict() == curriculum.state_dict()
    for part in (curriculum, other):
        part.update([episode(1, 0, True)], np.array([2, 1]), 0.0)
    assert other.state_dict() == curriculum.state_dict() and other.success == 2 / 3

"""A goal is accepted once, whatever comes while its picture is being prepared."""

import math
import threading
import time

import pytest
from inside_node import Inside
from ros_harness import write_checkpoint
from sensor_msgs.msg import CameraInfo, Image

from vn_msgs_py.camera import fill_camera_info
from vn_nav.nodes.camera_pictures import CameraPictures
from vn_nav.policy.goal_record import Code, Status

pytestmark = pytest.mark.ros


@pytest.fixture
def inside(tmp_path):
    parts = Inside(write_checkpoint(tmp_path / 'policy', size=36), 'stop_and_go')
    yield parts
    parts.close()


class Slow:
    """Preparing a goal waits until it may go on."""

    def __init__(self, monkeypatch):
        self.begun, self.goes_on = threading.Event(), threading.Event()
        prepare = CameraPictures.goal

        def slow(own, message, other=None):
            self.begun.set()
            assert self.goes_on.wait(20.0)
            return prepare(own, message, other)
        monkeypatch.setattr(CameraPictures, 'goal', slow)


def show(inside, picture=None):
    """Another goal, as by the topic."""
    with inside.wake:
        inside.navigator.new_goal()
        inside.worker.show_goal(picture or inside.picture())


def test_a_camera_that_is_heard_of_meanwhile_leaves_a_goal_new(inside, monkeypatch):
    """It is cut again for that camera; it counts as a goal, and its limits are in force."""
    slow, goal = Slow(monkeypatch), inside.navigator.goal
    assert (goal.number, goal.status) == (1, Status.ACTIVE)
    show(inside)
    assert slow.begun.wait(20.0)
    camera = fill_camera_info(CameraInfo(), 36, 36, math.radians(100))
    inside.worker.set_camera(inside.worker.pictures.read_camera(camera))
    slow.goes_on.set()
    inside.until(lambda: inside.navigator.goal_ready)
    assert (goal.number, goal.status) == (2, Status.ACTIVE)
    # Heard of later, the camera changes what is shown of it, and it is the same goal.
    camera = fill_camera_info(CameraInfo(), 36, 36, math.radians(120))
    inside.worker.set_camera(inside.worker.pictures.read_camera(camera))
    inside.navigator.step(time.monotonic(), 0.05, None, 0.0)  # the hold of a new goal ends
    inside.look(1.0)  # the worker takes the goal first
    assert (goal.number, goal.status) == (2, Status.ACTIVE)


@pytest.mark.parametrize('usable', [True, False])
def test_a_goal_that_is_dropped_while_it_is_prepared_is_nobodys(inside, monkeypatch, usable):
    """An action goal that cannot be used came meanwhile: nothing drives to the one before."""
    slow, goal = Slow(monkeypatch), inside.navigator.goal
    show(inside, None if usable else Image(height=1, width=1, encoding='no such'))
    assert slow.begun.wait(20.0)
    inside.inputs.refuse_goal('neither a picture nor a path')
    slow.goes_on.set()
    inside.worker.show_frame(inside.picture(), 1.0, time.monotonic())
    inside.until(lambda: inside.worker._frame is None)
    assert (goal.number, goal.status, goal.code) == (2, Status.FAILED, Code.GOAL_REFUSED)
    assert 'neither' in goal.message and not inside.navigator.goal_ready
    assert not inside.navigator.step(time.monotonic(), 0.05, None, 1.0).any()


def test_what_is_wrong_with_a_goal_is_not_said_of_the_next(inside, monkeypatch):
    slow, goal = Slow(monkeypatch), inside.navigator.goal
    show(inside, Image(height=1, width=1, encoding='no such'))
    assert slow.begun.wait(20.0)
    show(inside)
    slow.goes_on.set()
    inside.until(lambda: inside.navigator.goal_ready)
    assert (goal.number, goal.status, goal.code) == (2, Status.ACTIVE, Code.NONE)

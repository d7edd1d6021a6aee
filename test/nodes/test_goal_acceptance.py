"""A goal is accepted once, whatever comes while its picture is being prepared."""

import math
import threading
import time

import pytest
from inside_node import Inside
from ros_harness import write_checkpoint
from sensor_msgs.msg import CameraInfo

from vn_msgs_py.camera import fill_camera_info
from vn_nav.nodes.camera_pictures import CameraPictures
from vn_nav.policy.goal_record import Status

pytestmark = pytest.mark.ros


@pytest.fixture
def inside(tmp_path):
    parts = Inside(write_checkpoint(tmp_path / 'policy', size=36), 'stop_and_go')
    yield parts
    parts.close()


def test_a_camera_that_is_heard_of_meanwhile_leaves_a_goal_new(inside, monkeypatch):
    """It is cut again for that camera; it counts as a goal, and its limits are in force."""
    preparing, goes_on = threading.Event(), threading.Event()
    prepare = CameraPictures.goal

    def slow(self, message, other=None):
        preparing.set()
        assert goes_on.wait(20.0)
        return prepare(self, message, other)
    monkeypatch.setattr(CameraPictures, 'goal', slow)
    goal = inside.navigator.goal
    assert (goal.number, goal.status) == (1, Status.ACTIVE)
    with inside.wake:
        inside.navigator.new_goal()
        inside.worker.show_goal(inside.picture())
    assert preparing.wait(20.0)
    camera = fill_camera_info(CameraInfo(), 36, 36, math.radians(100))
    inside.worker.set_camera(inside.worker.pictures.read_camera(camera))
    goes_on.set()
    inside.until(lambda: inside.navigator.goal_ready)
    assert (goal.number, goal.status) == (2, Status.ACTIVE)
    # Heard of later, the camera changes what is shown of it, and it is the same goal.
    camera = fill_camera_info(CameraInfo(), 36, 36, math.radians(120))
    inside.worker.set_camera(inside.worker.pictures.read_camera(camera))
    inside.navigator.step(time.monotonic(), 0.05, None, 0.0)  # the hold of a new goal ends
    inside.look(1.0)  # the worker takes the goal first
    assert (goal.number, goal.status) == (2, Status.ACTIVE)

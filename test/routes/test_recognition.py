"""What the shipped eyes make of a route in a house that they have not seen."""

import numpy as np
import pytest
from joystick_drive import drive
from paths import ROOT

from vn_nav.observation import preprocess
from vn_nav.policy.backend import load_backend
from vn_nav.routes.follower import RouteFollower
from vn_nav.routes.recognition import RouteEyes


@pytest.mark.slow
def test_a_robot_finds_itself_among_the_pictures_of_a_drive():
    poses, pictures = drive(60.0, rooms=3, house=12_001, size=84)
    backend = load_backend(ROOT / 'models' / 'search', 0)
    small = np.stack([preprocess(np.ascontiguousarray(own.transpose(1, 2, 0)),
                                 backend.config.size) for own in pictures])
    every = np.arange(0, len(small), 6)
    eyes = RouteEyes(backend.eyes, small[every])
    near = 0
    others = np.arange(3, len(small), 12)
    for k in others:
        follower = RouteFollower(len(every), 0)
        follower.begin(lambda rows, k=k: eyes.look(small[k], rows))
        here = follower.here
        near += here is not None and np.hypot(*(poses[every[here], :2] - poses[k, :2])) < 1.0
    assert near >= 0.8 * len(others), (near, len(others))

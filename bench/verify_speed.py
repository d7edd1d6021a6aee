"""How long a decision of `models/search` takes, with and without verification.

    python bench/verify_speed.py PICTURE OTHER --fov 40

Two pictures of one camera, resized to 640 x 480: one is the goal, the other what the robot sees.
Medians of processor time, one thread: features, comparison, and the whole decision.
"""

from __future__ import annotations

import argparse
import functools
import math
import sys
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

from vn_nav.policy.runtime import PolicyRuntime
from vn_nav.policy.search.local_features import compare
from vn_nav.policy.search.views import VERIFY, View
from vn_nav.resources import share_file

WARM, TIMES = 2, 15
SHAPE = 640, 480


def median_ms(call: Callable[[], object]) -> float:
    """Processor time of a call [ms]."""
    spent = []
    for _ in range(WARM + TIMES):
        begun = time.process_time()
        call()
        spent.append(1e3 * (time.process_time() - begun))
    return float(np.median(spent[WARM:]))


def main() -> int:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__.split('\n')[0])
    parser.add_argument('picture', type=Path)
    parser.add_argument('other', type=Path)
    parser.add_argument('--fov', type=float, default=60.0, help='of the shorter side [deg]')
    parser.add_argument('--checkpoint', type=Path, default=share_file('models/search'))
    options = parser.parse_args()
    cv2.setNumThreads(1)
    own, goal = (View(cv2.cvtColor(cv2.resize(cv2.imread(str(path)), SHAPE), cv2.COLOR_BGR2RGB),
                      math.radians(options.fov)) for path in (options.picture, options.other))
    here, there = own.features(), goal.features()
    print(f'{len(here.rays)} and {len(there.rays)} features: {median_ms(own.features):.1f} ms; '
          f'comparison {median_ms(lambda: compare(here, there)):.1f} ms')
    for verify in VERIFY:
        policy = PolicyRuntime(options.checkpoint, verify=verify, stop_threshold=1.0)
        policy.set_goal(policy.prepare(goal.picture, goal.fov)[0], goal)
        picture, zoom = policy.prepare(own.picture, own.fov)
        act = functools.partial(policy.act, picture, np.zeros(3), None, zoom, own)
        print(f'a decision, verify {verify}: {median_ms(act):.1f} ms')
    return 0


if __name__ == '__main__':
    sys.exit(main())

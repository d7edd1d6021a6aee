"""Steps/s of AI2-THOR's client with the test peer in Unity's place: `python -m bench.thor`.

It says what client, pipes and our side cost, not what Unity costs.
"""

import argparse
import json
import os
import resource
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from vn_nav.robot import DRIVE_ACTIONS
from vn_sim_bridge.navigation.env import NavigationEnv
from vn_sim_bridge.navigation.env_config import EnvConfig
from vn_sim_bridge.thor.client import BUILD

PEER = Path(__file__).resolve().parents[1] / 'test' / 'simulators' / 'thor_peer.py'


def use_peer(folder):
    """Let the client run the peer; a build that the user names stays."""
    if BUILD not in os.environ:
        path = Path(folder) / 'unity'
        path.write_text(f'#!/bin/sh\nexec {sys.executable} {PEER} "$@"\n')
        path.chmod(0o755)
        os.environ[BUILD] = str(path)


def measure(num_envs, size, seconds):
    """A row: starting, resetting, stepping."""
    begun = time.perf_counter()
    env = NavigationEnv(EnvConfig(scenes=('thor:FloorPlan227',), num_envs=num_envs, size=size,
                                  actions=DRIVE_ACTIONS, max_decisions=300,
                                  privileged=('depth', 'segmentation')))
    started = time.perf_counter()
    env.reset(seed=0)
    reset = time.perf_counter() - started
    rng, steps, first = np.random.default_rng(0), 0, time.perf_counter()
    while time.perf_counter() - first < seconds:
        env.step(rng.integers(0, len(DRIVE_ACTIONS), num_envs))
        steps += num_envs
    row = {'num_envs': num_envs, 'size': size, 'start_s': round(started - begun, 2),
           'reset_s': round(reset, 3), 'steps_per_s': round(
               steps / (time.perf_counter() - first), 1),
           'memory_MB': resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024}
    env.close()
    return row | {'engine_MB': resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss // 1024}


def main():
    """Print a row for each number of environments."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--envs', type=int, nargs='+', default=[1, 16])
    parser.add_argument('--size', type=int, default=84)
    parser.add_argument('--seconds', type=float, default=10)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        use_peer(folder)
        for num_envs in args.envs:
            print(json.dumps(measure(num_envs, args.size, args.seconds)), flush=True)


if __name__ == '__main__':
    main()

"""Steps a second of a training over ROS topics, in lock-step, compared with the in-process one.

The simulator runs in a process of its own behind topics (`sim_bridge_node`, time:=lock_step, the
quick base); the same preset learns from it and, in turns, from one environment in this process.
One JSON line a figure: driving alone (no learning), and with learning. The peer of both is the
in-process environment.

    python bench/ros_train.py [--preset fast] [--rounds 5] [--updates 2]
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from common import pin, report

from vn_nav.learning.distributed import Processes
from vn_nav.learning.over_ros import config_over_ros
from vn_nav.learning.presets import ENVIRONMENT, preset
from vn_nav.learning.training import Training
from vn_nav.nodes.isolation import profile_environment
from vn_nav.resources import share_file
from vn_nav.robot import DRIVE_ACTIONS, load_robot
from vn_nav.scenes import house_scenes
from vn_sim_bridge.navigation.env import NavigationEnv
from vn_sim_bridge.navigation.env_config import EnvConfig

HOUSE, ROOMS = 7, 5
BASE = share_file('config/robots/demo_base.yaml')
ROBOT = load_robot(BASE).with_actions(DRIVE_ACTIONS)


def start_bridge() -> subprocess.Popen:
    """The simulated robot as a process."""
    command = [sys.executable, '-m', 'vn_sim_bridge.bridge_node', '--ros-args']
    for name, value in {'house': HOUSE, 'rooms': ROOMS, 'robot': str(BASE),
                        'time': 'lock_step'}.items():
        command += ['-p', f'{name}:={json.dumps(value)}']
    return subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
                            env=os.environ | {'OMP_NUM_THREADS': '1'})


def begun(env, config, folder: Path) -> Training:
    """A training past its first update."""
    training = Training(env, config, folder, {}, Processes())
    training.start(resume=False, init=None, pairs=None)
    training.update()
    return training


def measure(training: Training, updates: int) -> tuple[float, float]:
    """Steps a second of some updates: while collecting, and altogether."""
    frames, start = training.frames, time.perf_counter()
    collecting = sum(training.update()['collect_seconds'] for _ in range(updates))
    frames = training.frames - frames
    return frames / collecting, frames / (time.perf_counter() - start)


def main():
    """Measure in turns."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--preset', default='fast')
    parser.add_argument('--rounds', type=int, default=5)
    parser.add_argument('--updates', type=int, default=2, help='a round')
    arguments = parser.parse_args()
    # What rclpy reads when it is imported; the bridge inherits it.
    os.environ |= profile_environment()
    os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'SYSTEM_DEFAULT'
    os.environ.setdefault('ROS_DOMAIN_ID', str(40 + os.getpid() % 60))
    from vn_nav.nodes.ros_env import RosEnv
    pin(2)
    world = ENVIRONMENT[arguments.preset]
    bridge = start_bridge()
    try:
        with RosEnv(ROBOT, 84, lock_step=True) as over_ros, tempfile.TemporaryDirectory() as out:
            config, _ = config_over_ros(preset(arguments.preset), world, over_ros.offers, True)
            over_ros.listen(config.privileged)
            inside = NavigationEnv(EnvConfig(
                scenes=house_scenes((HOUSE,), ROOMS), num_envs=1,
                privileged=config.privileged), ROBOT)
            ways = {name: begun(env, config, Path(out) / name)
                    for name, env in (('ros', over_ros), ('inside', inside))}
            rows = {name: [] for name in ways}
            for _ in range(arguments.rounds):
                for name, training in ways.items():
                    rows[name].append(measure(training, arguments.updates))
    finally:
        bridge.send_signal(signal.SIGINT)
        bridge.wait(20)
    conditions = (f'preset {arguments.preset}, one robot x {config.rollout_length} steps, house '
                  f'{HOUSE} with {ROOMS} rooms, 84 x 84, robot {ROBOT.name}, two cores')
    both = {name: np.transpose(values) for name, values in rows.items()}
    for k, what in enumerate(('driving', 'with learning')):
        report(f'training over ROS in lock-step, {what}', both['ros'][k], conditions,
               unit='steps/s', peer='NavigationEnv in the same process, one environment',
               peer_values=both['inside'][k])


if __name__ == '__main__':
    main()

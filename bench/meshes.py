"""Steps a second in scenes of meshes: RGB, depth and labels of 84 pixels; reset time, memory.

python bench/meshes.py gltf:flat.glb procthor:house.json

A step is a decision of every robot and its pictures. Robots turn and drive at random. Run it alone
on a core: taskset -c 0.
"""

import argparse
import json
import time

import numpy as np

from vn_nav.cli.world import machine
from vn_sim_bridge.navigation.env import NavigationEnv
from vn_sim_bridge.navigation.env_config import EnvConfig


def resident_mb() -> float:
    """Memory of this process [MB]."""
    with open('/proc/self/status') as status:
        return next(int(line.split()[1]) / 1024 for line in status if line.startswith('VmRSS'))


def measure(scene: str, robots: int, seconds: float) -> dict:
    """Figures of one scene and number of robots."""
    before, begun = resident_mb(), time.perf_counter()
    env = NavigationEnv(EnvConfig(scenes=(scene,), num_envs=robots, size=84,
                                  privileged=('depth', 'segmentation')))
    opened = time.perf_counter() - begun
    env.reset(seed=0)
    begun = time.perf_counter()
    env.reset(seed=1)
    reset = time.perf_counter() - begun
    rng, count, begun = np.random.default_rng(0), 0, time.perf_counter()
    worked = time.process_time()
    while (spent := time.perf_counter() - begun) < seconds:
        env.step(rng.integers(0, len(env.action_names), robots))
        count += robots
    figures = {'name': scene.rpartition('/')[2], 'value': round(count / spent), 'unit': 'steps/s',
               'steps/s of CPU time': round(count / (time.process_time() - worked)),
               'environments': robots, 'open s': round(opened, 2),
               'reset ms': round(1000 * reset / robots, 1),
               'memory MB': round(resident_mb() - before),
               'conditions': f'RGB, depth, labels, 84 x 84; {machine()}'}
    env.close()
    return figures


def main():
    """Each scene with 1 and 16 robots."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('scenes', nargs='+')
    parser.add_argument('--seconds', type=float, default=10.0)
    arguments = parser.parse_args()
    for scene in arguments.scenes:
        measure(scene, 1, 0.1)  # compiles what is not compiled yet
        for robots in (1, 16):
            print(json.dumps(measure(scene, robots, arguments.seconds)), flush=True)


if __name__ == '__main__':
    main()

"""Decisions per second of NavigationEnv compared with the bare renderer, and its memory.

python bench/env.py
"""

import argparse
import os
import subprocess
import sys

import numpy as np
from common import ROUNDS, frames_per_second, pin, report

from vn_nav.scenes import house_scenes
from vn_sim_bridge.navigation.env import NavigationEnv
from vn_sim_bridge.navigation.env_config import EnvConfig
from vn_sim_bridge.render.randomisation import load_randomisation
from vn_sim_bridge.render.rasterizer import Rasterizer

ENVS = 64
MEMORY = f"""
from vn_nav.scenes import house_scenes
from vn_sim_bridge.navigation.env import NavigationEnv
from vn_sim_bridge.navigation.env_config import EnvConfig
import numpy as np
env = NavigationEnv(EnvConfig(scenes=house_scenes(range(16), 6), num_envs={ENVS}))
env.reset(seed=0)
for _ in range(50):
    env.step(np.zeros({ENVS}, np.int64))
for line in open('/proc/self/status'):
    if line.startswith('VmHWM'):
        print(int(line.split()[1]) / 1024)
"""


def main():
    """Step environments and draw the very same poses, in turns."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--rounds', type=int, default=ROUNDS)
    arguments = parser.parse_args()
    pin(1)
    rows = {
        'one house': {'scenes': ('house:7?rooms=6',)},
        '16 houses': {'scenes': house_scenes(range(16), 6)},
        '16 houses, randomised': {'scenes': house_scenes(range(16), 6),
                                  'randomisation': load_randomisation('standard')},
        'object goal': {'scenes': ('house:7?rooms=6',), 'task': 'object', 'objects': 4},
        'room goal': {'scenes': ('house:7?rooms=6',), 'task': 'room'},
        'collect': {'scenes': ('house:7?rooms=6',), 'task': 'collect', 'objects': 10},
    }
    rng = np.random.default_rng(0)
    actions = rng.integers(0, 4, (1000, ENVS))
    steppers, renders = {}, {}
    for name, options in rows.items():
        env = NavigationEnv(EnvConfig(num_envs=ENVS, **options))
        env.reset(seed=0)
        turn = iter(range(1 << 62))

        def step(env=env, turn=turn):
            env.step(actions[next(turn) % 1000])

        renderer = Rasterizer([house.scene for house in env.places], 84)
        buffers = []

        def render(env=env, renderer=renderer, buffers=buffers):
            cameras = np.column_stack([env.simulator.poses[:, :2], np.ones(ENVS),
                                       env.simulator.poses[:, 2:]])
            out = renderer.render(env.place_index, cameras, np.pi / 2, buffers[0] if buffers
                                  else None)
            buffers[:] = [out]
        for _ in range(20):
            step()
            render()
        steppers[name], renders[name] = step, render
    values, bare = {n: [] for n in rows}, {n: [] for n in rows}
    for _ in range(arguments.rounds):
        for name in rows:
            values[name].append(frames_per_second(steppers[name], ENVS))
            bare[name].append(frames_per_second(renders[name], ENVS))
    for name in rows:
        report(f'NavigationEnv.step: {name}', values[name],
               f'{ENVS} environments, six rooms, 84 x 84, one thread, random actions',
               peer='renderer on the same poses', peer_values=bare[name])
    memory = subprocess.run([sys.executable, '-c', MEMORY], capture_output=True, text=True,
                            check=True, env=os.environ | {'OMP_NUM_THREADS': '1'}).stdout
    report('NavigationEnv: peak memory of the process', [float(memory)],
           f'{ENVS} environments over 16 houses of six rooms', unit='MB')


if __name__ == '__main__':
    main()

"""Every job for a machine with a GPU: rendering and environment rates on the device.

    pip install -e '.[gpu]' && python bench/gpu/run.py --out bench/gpu/results.jsonl

Prints one JSON line a figure, with the hardware's name; `--device cpu` runs the same kernels
slowly, to try the script. Training on the device follows with the learner.
"""

import argparse
import json
import time
from pathlib import Path

import numpy as np
import torch
import warp as wp

from vn_nav.cli import machine
from vn_sim_bridge.env import EnvConfig, NavigationEnv
from vn_sim_bridge.warp_env import WarpNavigationEnv

ROUNDS = 7


def rate(step, frames: int, device: str, seconds: float) -> list[float]:
    """Frames a second, round by round, after a warm-up; the device finishes before the clock."""
    step()
    wp.synchronize_device(device)
    values = []
    for _ in range(ROUNDS):
        begun, count = time.perf_counter(), 0
        while time.perf_counter() - begun < seconds:
            step()
            wp.synchronize_device(device)
            count += frames
        values.append(count / (time.perf_counter() - begun))
    return values


def agreement(device: str) -> dict:
    """How far the device's pictures are from the Numba renderer's, on the same episodes."""
    config = EnvConfig(houses=(1, 2, 3), rooms=6, num_envs=48)
    host, other = NavigationEnv(config), WarpNavigationEnv(config, device=device)
    host.reset(seed=0)
    other.reset(seed=0)
    rng = np.random.default_rng(0)
    for _ in range(20):
        actions = rng.integers(0, len(host.action_names), 48)
        mine, *_, facts = host.step(actions)
        theirs, *_, device_facts = other.step(torch.from_numpy(actions).to(
            wp.device_to_torch(device)))
    labels = host.backend.observe().labels
    gap = np.abs(mine['image'].astype(int) - theirs['image'].cpu().numpy().astype(int))
    return {'labels_equal': float((labels == device_facts['segmentation'].cpu().numpy()).mean()),
            'rgb_within_2': float((gap <= 2).mean()),
            'largest_pose_difference': float(np.abs(
                facts['pose'] - device_facts['pose'].cpu().numpy()).max())}


def main():
    """Measure all sizes; what does not fit into the memory is said and left out."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--device', default='cuda:0')
    parser.add_argument('--out', type=Path, help='also append the lines here')
    parser.add_argument('--envs', type=int, nargs='+',
                        default=[64, 256, 1024, 4096, 16384])
    parser.add_argument('--sizes', type=int, nargs='+', default=[84, 174])
    parser.add_argument('--seconds', type=float, default=1.0, help='of a round')
    arguments = parser.parse_args()
    device = wp.get_device(arguments.device)
    hardware = device.name if device.is_cuda else machine()

    def say(name, value, unit, conditions, **more):
        line = json.dumps({'name': name, 'value': value, 'unit': unit, 'peer': None,
                           'peer_value': None, 'ratio': None,
                           'conditions': f'{conditions}; {hardware}', **more})
        print(line, flush=True)
        if arguments.out:
            with open(arguments.out, 'a') as file:
                file.write(line + '\n')

    say('agreement with the Numba renderer', None, '', '48 environments, 84 x 84',
        **agreement(arguments.device))
    for size in arguments.sizes:
        for envs in arguments.envs:
            conditions = f'{size} x {size}, {envs} environments, 16 houses of six rooms'
            try:
                env = WarpNavigationEnv(EnvConfig(houses=tuple(range(16)), rooms=6, num_envs=envs,
                                                  size=size), device=arguments.device)
                env.reset(seed=0)
                actions = torch.randint(0, len(env.action_names), (envs,),
                                        device=wp.device_to_torch(arguments.device))
                frames = rate(lambda: env.step(actions), envs, arguments.device,  # noqa: B023
                              arguments.seconds)
                draw = rate(env._observe, envs, arguments.device, arguments.seconds)
            except (RuntimeError, MemoryError) as error:
                say('environment on the device', None, 'frames/s', f'{conditions}: {error}')
                continue
            for name, values in (('renderer on the device, RGB + depth + labels', draw),
                                 ('environment on the device', frames)):
                say(name, round(float(np.median(values))), 'frames/s', conditions,
                    range=[round(min(values)), round(max(values))])


if __name__ == '__main__':
    main()

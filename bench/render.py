"""Frames per second of the CPU renderer: RGB, depth and labels of a generated house.

Prints one JSON line a figure. Run: python bench/render.py
"""

import argparse
import json
import math
import time

import numpy as np

from vn_nav.cli import machine
from vn_sim_bridge.env import EnvConfig, NavigationEnv
from vn_sim_bridge.houses.procedural import generate_house
from vn_sim_bridge.render.rasterizer import Rasterizer

ROUNDS = 9
BATCH = 64


def frames_per_second(draw, batch):
    """Median and range over rounds, warm."""
    draw()
    rates = []
    for _ in range(ROUNDS):
        begun = time.perf_counter()
        draw()
        rates.append(batch / (time.perf_counter() - begun))
    return float(np.median(rates)), min(rates), max(rates)


def report(name, rates, conditions):
    """One JSON line."""
    value, low, high = rates
    print(json.dumps({'name': name, 'value': round(value), 'unit': 'frames/s',
                      'range': [round(low), round(high)], 'peer': None, 'peer_value': None,
                      'ratio': None, 'conditions': conditions}))


def main():
    """Draw from random free places of a six-room house, and step an environment."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--house', type=int, default=7)
    parser.add_argument('--threads', type=int, nargs='+', default=[1, 2])
    arguments = parser.parse_args()
    house = generate_house(arguments.house, rooms=6)
    rng = np.random.default_rng(0)
    cells = house.floor.centres()
    cameras = np.column_stack([cells[rng.integers(len(cells), size=BATCH)], np.ones(BATCH),
                               rng.uniform(-math.pi, math.pi, BATCH), np.zeros(BATCH)])
    index = np.zeros(BATCH, int)
    for threads in arguments.threads:
        for size in (84, 174):
            renderer = Rasterizer([house.scene], size, threads=threads)
            out = renderer.render(index, cameras, math.radians(90))
            report('renderer, RGB + depth + labels', frames_per_second(
                lambda: renderer.render(index, cameras, math.radians(90), out), BATCH),  # noqa: B023
                f'{size} x {size}, {threads} thread(s), batch {BATCH}, {len(house.rooms)} rooms, '
                f'{house.scene.triangle_count} triangles, {machine()}')
    env = NavigationEnv(EnvConfig(houses=(arguments.house,), rooms=6, num_envs=BATCH))
    env.reset(seed=0)
    actions = rng.integers(0, 4, (40, BATCH))

    def step():
        for row in actions:
            env.step(row)
    report('NavigationEnv.step', frames_per_second(step, BATCH * len(actions)),
           f'84 x 84, 1 thread, {BATCH} environments, random actions, {machine()}')


if __name__ == '__main__':
    main()

"""Builds many houses and checks each: distinct, every free cell reachable, a goal in every room.

python bench/houses.py --count 10000
"""

import argparse
import hashlib
import json
import time

import numpy as np

from vn_nav.cli.world import machine
from vn_sim_bridge.floor.floor_map import main_component
from vn_sim_bridge.houses import procedural
from vn_sim_bridge.houses.procedural import MAX_ROOMS, generate_house


def main():
    """Seeds from 0 on, with 1 to 12 rooms in turn."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--count', type=int, default=10_000)
    parser.add_argument('--plain', action='store_true',
                        help='leave out light and goals, which come last and change no geometry')
    arguments = parser.parse_args()
    if arguments.plain:
        procedural.light_baker = lambda *_: None
        procedural.choose_goals = lambda *_: []
    seen, triangles, goals, wings, begun = set(), [], 0, 0, time.perf_counter()
    for seed in range(arguments.count):
        house = generate_house(seed, rooms=1 + seed % MAX_ROOMS)
        scene = house.scene
        seen.add(hashlib.sha256(scene.vertices.tobytes() + scene.face_colour.tobytes()).digest())
        triangles.append(scene.triangle_count)
        wings += any(obstacle.label == 'outside' for obstacle in house.obstacles)
        assert np.array_equal(main_component(house.floor.free), house.floor.free), seed
        goals += {goal.room for goal in house.goals} == {room.name for room in house.rooms}
        if (seed + 1) % 500 == 0 or seed + 1 == arguments.count:
            seconds = time.perf_counter() - begun
            print(json.dumps({
                'name': 'houses', 'value': len(seen), 'unit': 'distinct houses', 'peer': None,
                'peer_value': None, 'ratio': None,
                'conditions': f'{seed + 1} seeds, 1 to {MAX_ROOMS} rooms; {machine()}',
                'every room has a goal': goals, 'not rectangular': wings,
                'triangles': [min(triangles), round(np.mean(triangles)), max(triangles)],
                'seconds a house': round(seconds / (seed + 1), 3)}), flush=True)


if __name__ == '__main__':
    main()

"""Many houses of ProcTHOR: making an environment of them, and reading any one of a file.

    python bench/many_scenes.py
    python bench/many_scenes.py --houses 200 --room 50 --lines 2000

Small houses of two rooms, made here, each with numbers that nobody reads, 15 kB of text: else a
packed file of them is next to nothing.
"""

import argparse
import copy
import gzip
import json
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / 'test'))
from common import pin, report  # noqa: E402
from procthor_houses import small_house  # noqa: E402

from vn_nav.robot import RobotSpec  # noqa: E402
from vn_sim_bridge.meshes.house_file import HouseFile  # noqa: E402
from vn_sim_bridge.navigation.env import NavigationEnv  # noqa: E402
from vn_sim_bridge.navigation.env_config import EnvConfig  # noqa: E402
from vn_sim_bridge.simulator import Setup  # noqa: E402
from vn_sim_bridge.simulators import open_simulator  # noqa: E402

ROUNDS = 5
ROBOT = RobotSpec()
READS = 200  # houses that are read in a round
NUMBERS = 800  # of a house that nobody reads


def write(path: Path, count: int) -> list[bytes]:
    """So many houses that differ by where the bed stands; the lines of the file."""
    lines = []
    for number in range(count):
        house = copy.deepcopy(small_house())
        house['objects'][0]['position']['x'] = 5.0 + 2.0 * number / count
        house['metadata']['numbers'] = np.random.default_rng(number).random(NUMBERS).tolist()
        lines.append(json.dumps(house).encode())
    with gzip.open(path, 'wb') as file:
        file.write(b'\n'.join(lines) + b'\n')
    return lines


def environment(path: Path, houses: int, room: int) -> None:
    """Seconds until an environment of so many houses has its goals; memory holds a few."""
    seconds, loads = [], 0
    for _ in range(ROUNDS):
        begun = time.perf_counter()
        simulator = open_simulator([f'procthor:{path}?index=0-{houses - 1}'],
                                   Setup(1, ROBOT, EnvConfig().size))
        simulator.cache.budget = room * simulator.cache.get(0).size
        NavigationEnv(EnvConfig(num_envs=1), ROBOT, simulator=simulator)
        seconds.append(time.perf_counter() - begun)
        loads = simulator.cache.loads
        simulator.close()
    report('an environment of many houses', seconds,
           f'{houses} small houses, room for {room}; read {loads} times', unit='s')


def reads(path: Path, lines: list[bytes]) -> None:
    """Milliseconds a house in any order, beside reading from the file's start each time."""
    begun = time.perf_counter()
    file = HouseFile(path)
    assert file.has(len(lines) - 1)
    report('pass through a file of houses', [time.perf_counter() - begun],
           f'{len(lines)} small houses, {path.stat().st_size / 1e6:.1f} MB packed', unit='s')
    near, begin = [], []
    for number in range(ROUNDS):
        order = np.random.default_rng(number).integers(len(lines), size=READS)
        begun = time.perf_counter()
        for index in order:
            assert file.text(index) == lines[index]
        near.append(1000 * (time.perf_counter() - begun) / READS)
        begun = time.perf_counter()
        for index in order[:READS // 10]:
            with gzip.open(path) as packed:
                for _ in range(index):
                    packed.readline()
                assert packed.readline().rstrip(b'\n') == lines[index]
        begin.append(1000 * (time.perf_counter() - begun) / (READS // 10))
    report('a house of a file', near, f'{len(lines)} small houses, any order', unit='ms',
           peer="read from the file's start", peer_values=begin)


def main() -> None:
    """One JSON line a figure; the peer's ratio is ours over its, of times: less is better."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--houses', type=int, default=200, help='of the environment')
    parser.add_argument('--room', type=int, default=50, help='houses that memory has room for')
    parser.add_argument('--lines', type=int, default=2000, help='houses of the file')
    arguments = parser.parse_args()
    pin(1)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / 'train.jsonl.gz'
        lines = write(path, max(arguments.lines, arguments.houses))
        reads(path, lines)
        environment(path, arguments.houses, arguments.room)


if __name__ == '__main__':
    main()

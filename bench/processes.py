"""What one update costs in one process and in two that train together, and what averaging costs.

    python bench/processes.py

Preset `fast` without picture pairs, fp32, 84 px, 64 environments x 32 steps a process, house 7
with six rooms. One process and two by turns, each started by torchrun, one thread a process; then
gloo's all-reduce of so many bytes. Processor time says what the work costs, also on a machine that
others use. One JSON line a figure.
"""

import argparse
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import torch
import torch.distributed as dist
from common import report

from vn_nav.learning.distributed import Processes
from vn_nav.learning.presets import ENVIRONMENT, preset
from vn_nav.learning.training import Training
from vn_sim_bridge.navigation.env import NavigationEnv
from vn_sim_bridge.navigation.env_config import PRIVILEGED, EnvConfig

WARM_UP = 2  # updates
NETWORKS = {'one number': 1, "5.6 MB (fast's gradient)": 1_410_000,
            "19.3 MB (thesis's gradient)": 4_830_000}  # fp32


def clocked(work) -> tuple[float, float]:
    """Seconds by the wall clock and by this process's processors."""
    wall, own = time.perf_counter(), time.process_time()
    work()
    return time.perf_counter() - wall, time.process_time() - own


def worker(updates: int, reduces: int) -> None:
    """One process of a training; the first one prints what all measured."""
    torch.set_num_threads(1)
    config = preset('fast', bf16=False, overlap=False, threads=1, pair_minutes=0.0)
    world = dict(ENVIRONMENT['fast'])
    with Processes.join() as processes, tempfile.TemporaryDirectory() as folder:
        env = NavigationEnv(EnvConfig(
            scenes=('house:7?rooms=6',), num_envs=world.pop('envs'),
            privileged=tuple(sorted(set(config.privileged) & set(PRIVILEGED))), **world),
            threads=1)
        training = Training(env, config, Path(folder), {}, processes)
        training.start(resume=False, init=None, pairs=None)
        for _ in range(WARM_UP):
            training.update()
        frames = training.frames
        times = [clocked(training.update) for _ in range(updates)]
        found = {'frames': (training.frames - frames) / updates,
                 'updates': processes.gather(times), 'reduces': {}}
        if processes.count > 1:
            for name, size in NETWORKS.items():
                tensor = torch.zeros(size)
                dist.all_reduce(tensor)
                found['reduces'][name] = [clocked(lambda t=tensor: dist.all_reduce(t))
                                          for _ in range(reduces)]
    if processes.leads:
        print(json.dumps(found), flush=True)


def run(count: int, *options) -> dict:
    """The figures of a training by so many processes."""
    done = subprocess.run(
        [sys.executable, '-m', 'torch.distributed.run', '--standalone', '--nproc-per-node',
         str(count), __file__, '--worker', *map(str, options)], capture_output=True, text=True)
    if done.returncode:
        sys.exit(done.stderr)
    return json.loads(done.stdout.splitlines()[-1])


def main() -> None:
    """Measure in turns."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--rounds', type=int, default=3)
    parser.add_argument('--updates', type=int, default=7, help='a round')
    parser.add_argument('--reduces', type=int, default=100, help='a round')
    parser.add_argument('--worker', action='store_true', help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    options = '--updates', arguments.updates, '--reduces', arguments.reduces
    if arguments.worker:
        worker(arguments.updates, arguments.reduces)
        return
    found = {1: [], 2: []}
    for _ in range(arguments.rounds):
        for count, rows in found.items():
            rows.append(run(count, *options))
    for count, rows in found.items():
        frames = np.mean([row['frames'] for row in rows])
        conditions = f'preset fast, fp32, {count} process(es), {frames:,.0f} frames an update'
        times = np.concatenate([row['updates'] for row in rows], axis=1)  # process, update, clock
        for rank in range(count):
            report(f'processor time of an update, process {rank + 1} of {count}',
                   times[rank, :, 1], conditions, unit='s')
        report(f'training by {count} process(es)', frames / times[..., 0].max(0), conditions)
    for name in NETWORKS:
        wall, own = 1000 * np.concatenate([row['reduces'][name] for row in found[2]]).T
        report(f'all-reduce of {name}', wall, 'gloo, two processes, wall clock', unit='ms')
        report(f'all-reduce of {name}', own, 'gloo, two processes, processor time', unit='ms')


if __name__ == '__main__':
    main()

"""Steps/s of any simulator with 1 and 16 environments, its reset time and its memory.

    python bench/simulators.py                                        # a scene of every simulator
    python bench/simulators.py --scene dmlab:maze?seed=3 --scene house:7

84 px RGB, depth and labels, as far as there are any; random actions, one drawing thread. Each
figure comes from a process of its own. Memory is that of all its processes, shared pages split
among them. Simulators that pay reset within `spawn`; all others place their robots.
"""

import argparse
import json
import subprocess
import sys
import time
from pathlib import Path

from simulator_scenes import SCENES, scene

ENVS = (1, 16)
WARM = 20  # steps before the clock starts


def memory_mb() -> float:
    """Of this process and all below it: proportional set size."""
    parents = {}
    for folder in Path('/proc').iterdir():
        if folder.name.isdigit():
            try:
                words = (folder / 'stat').read_text().rpartition(')')[2].split()
            except OSError:  # it has ended
                continue
            parents[int(folder.name)] = int(words[1])
    ours = {int(Path('/proc/self').resolve().name)}
    while more := {child for child, parent in parents.items() if parent in ours} - ours:
        ours |= more
    total = 0
    for process in ours:
        try:
            rollup = Path(f'/proc/{process}/smaps_rollup').read_text()
        except OSError:
            continue
        total += sum(int(line.split()[1]) for line in rollup.splitlines()
                     if line.startswith('Pss:'))
    return total / 1024


def measure(name: str, envs: int, seconds: float) -> dict:
    """Figures of one scene with so many environments."""
    import numpy as np

    from vn_nav.cli.world import make_env
    begun = time.perf_counter()
    env = make_env((name,), envs, privileged=('depth', 'segmentation'), may_lack=())
    opened = time.perf_counter() - begun
    begun = time.perf_counter()
    env.reset(seed=0)
    resets = [time.perf_counter() - begun]
    for seed in range(1, 4):
        begun = time.perf_counter()
        env.reset(seed=seed)
        resets.append(time.perf_counter() - begun)
    actions = np.random.default_rng(0).integers(0, len(env.action_names), (1000, envs))
    for step in range(WARM):
        env.step(actions[step])
    begun, count = time.perf_counter(), 0
    while (spent := time.perf_counter() - begun) < seconds:
        env.step(actions[count % 1000])
        count += 1
    found = {'told': ('rgb', *env.config.privileged), 'steps/s': count * envs / spent,
             'open s': opened, 'reset ms': 1000 * float(np.median(resets)) / envs,
             'MB': memory_mb()}
    env.close()
    return found


def main():
    """Rows of a table in Markdown, and one line of JSON each."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--scene', action='append', help='default: one of every simulator')
    parser.add_argument('--files', type=Path, default=Path('runs/simulators/files'),
                        help='folder for scenes that are made here')
    parser.add_argument('--seconds', type=float, default=10.0)
    parser.add_argument('--envs', type=int, help=argparse.SUPPRESS)  # in a process of its own
    arguments = parser.parse_args()
    if arguments.envs:
        print(json.dumps(measure(arguments.scene[0], arguments.envs, arguments.seconds)))
        return
    from vn_nav.cli.world import machine
    print('| scene | steps/s, 1 environment | 16 environments | opening 1 / 16 | reset of one | '
          'memory 1 / 16 |\n|---|---|---|---|---|---|', flush=True)
    for name in arguments.scene or [scene(name, arguments.files) for name in SCENES]:
        one, many = (json.loads(subprocess.run(
            [sys.executable, __file__, '--scene', name, '--envs', str(envs), '--seconds',
             str(arguments.seconds)], stdout=subprocess.PIPE, text=True,
            check=True).stdout.splitlines()[-1]) for envs in ENVS)
        print(json.dumps({'scene': name, '1': one, '16': many, 'machine': machine()}),
              file=sys.stderr, flush=True)
        print(f'| `{name}`: {", ".join(one["told"])} | {one["steps/s"]:,.0f} | '
              f'{many["steps/s"]:,.0f} | {one["open s"]:.1f} / {many["open s"]:.1f} s | '
              f'{many["reset ms"]:.1f} ms | {one["MB"]:,.0f} / {many["MB"]:,.0f} MB |', flush=True)


if __name__ == '__main__':
    main()

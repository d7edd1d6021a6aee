"""The table of presets: how fast each learns one task, several seeds, two runs side by side.

    python bench/learning.py                          # all runs: about six hours on two cores
    python bench/learning.py --presets fast --seeds 0 # some of them

A house of two rooms (one room is half solved at random), 84 x 84, 300 decisions at most, one
thread a run. Every run is limited by its wall-clock time, and its schedules end with it; one that
has held the table's highest success for a tenth of that time has nothing left to show, and ends. A
run that was interrupted goes on; one that has ended is not repeated. Curves go to
docs/curves/table/, thinned; `vn_nav compare` makes the table and the figure from them.
"""

from __future__ import annotations

import argparse
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

from vn_nav.errors import UserError
from vn_nav.report.curves import HOLD_SHARE, THRESHOLDS, reached, read_runs, thin

ROOT = Path(__file__).resolve().parent.parent
CURVES = ROOT / 'docs' / 'curves' / 'table'
MINUTES = {'a2c': 30, 'unreal': 90, 'thesis': 90, 'fast': 30}
HOUSE, ROOMS = 3, 2


def command(preset: str, seed: int, folder: Path, minutes: float) -> list[str]:
    """The training of one cell of the table."""
    command = [sys.executable, '-m', 'vn_nav.cli', 'train', '--preset', preset,
             '--house', str(HOUSE), '--rooms', str(ROOMS), '--seed', str(seed),
             '--minutes', str(minutes), '--frames', '1e9', '--max-decisions', '300',
             '--no-tensorboard', '--out', str(folder)]
    return command + (['--resume'] if folder.exists() else [])


def is_over(folder: Path, minutes: float) -> bool:
    """Whether a run has used its time, or has held the highest success for a tenth of it."""
    try:
        run, = read_runs([folder])
    except UserError:  # it has hardly begun
        return False
    now = run.columns['minutes'][-1]
    there = reached(run, max(THRESHOLDS))
    return now >= 0.999 * minutes or there is not None and now >= there[1] + HOLD_SHARE * minutes


def write_table(curves: Path) -> None:
    """Table and figure of a folder of curves, into that folder."""
    subprocess.run([sys.executable, '-m', 'vn_nav.cli', 'compare',
                    *(str(folder.relative_to(ROOT)) for folder in sorted(curves.iterdir())
                      if folder.is_dir()),
                    '--out', str(curves / 'table.html'), '--json', str(curves / 'table.json')],
                   check=True, cwd=ROOT)


def main():
    """Run what is missing, two at a time, each pinned to a core of its own."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--presets', nargs='+', choices=tuple(MINUTES), default=list(MINUTES))
    parser.add_argument('--seeds', type=int, nargs='+', default=[0, 1, 2])
    parser.add_argument('--minutes', type=float, help='instead of the usual limits, to try it')
    parser.add_argument('--runs', type=Path, default=ROOT / 'runs' / 'table')
    arguments = parser.parse_args()
    waiting = [(preset, seed) for seed in arguments.seeds for preset in arguments.presets]
    cores = sorted(os.sched_getaffinity(0))[:2]
    running: dict[int, tuple[subprocess.Popen, Path, float]] = {}
    arguments.runs.mkdir(parents=True, exist_ok=True)
    while waiting or running:
        for core in cores:
            if core in running:
                process, folder, minutes = running[core]
                if process.poll() is None:
                    if is_over(folder, minutes):
                        process.send_signal(signal.SIGINT)
                        process.wait()
                    else:
                        continue
                del running[core]
                if process.returncode:
                    raise SystemExit(f'{folder.name} ended with {process.returncode}: see its log')
                thin(folder, CURVES / folder.name)
            if waiting:
                preset, seed = waiting.pop(0)
                folder = arguments.runs / f'{preset}-seed{seed}'
                minutes = arguments.minutes or MINUTES[preset]
                if is_over(folder, minutes):
                    thin(folder, CURVES / folder.name)
                    continue
                print(f'core {core}: {folder.name}, {minutes:g} minutes', flush=True)
                with open(arguments.runs / f'{folder.name}.log', 'a') as log:
                    running[core] = subprocess.Popen(
                        ['taskset', '-c', str(core), *command(preset, seed, folder, minutes)],
                        stdout=log, stderr=subprocess.STDOUT, cwd=ROOT,
                        env=os.environ | {'OMP_NUM_THREADS': '1'}), folder, minutes
        time.sleep(10)
    write_table(CURVES)


if __name__ == '__main__':
    main()

"""Learning in the thesis's simulators: 20 minutes of one core each, beside the controls.

    python bench/simulator_learning.py                       # two at a time: about 70 minutes
    python bench/simulator_learning.py --tasks grid suncg
    python bench/simulator_learning.py --figures             # chart and table of what has ended

One seed, preset `fast`, 84 x 84, one thread; simulator and learner share a core. Then
`vn_nav evaluate` with random actions, the shortest path, wrong and blank goals. A run that was
interrupted goes on. Curves and figures go to docs/curves/simulators/, the chart to
docs/images/learning.png.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from pathlib import Path

import cv2
import numpy as np
from simulator_scenes import ROOT, scene

from vn_nav.cli.world import machine
from vn_nav.evaluation.evaluator import ARRIVAL, RANDOM, SHORTEST
from vn_nav.report.chart import Series, legend, panel, to_picture
from vn_nav.report.curves import average, read_runs, thin

CURVES = ROOT / 'docs' / 'curves' / 'simulators'
CHART = ROOT / 'docs' / 'images' / 'learning.png'
MINUTES, EPISODES = 20, 50  # episodes of a row, at least
HOUSE3D = ['--robot', 'config/robots/house3d.yaml']
# Task: title, what is drawn, options of the training, of the training and the evaluation.
TASKS = {
    'dmlab_arena': ('DeepMind Lab, arena: return', 'return', [], []),
    'dmlab_house': ('DeepMind Lab, house: success', 'success', [], []),
    'grid': ('Grid of house 7, five goals: success', 'success',
             ['--progress-reward', '0.5', '--set', 'pair_minutes=0'], []),
    'suncg': ('House 7 in SUNCG format, rooms: success', 'success',
              ['--task', 'room', '--randomisation', 'none', '--actions',
               'forward,backward,left,right,rotate_left,rotate_right'], HOUSE3D),
    'thor': ('AI2-THOR client over the peer: success', 'success',
             ['--set', 'pair_minutes=0'], []),
}
WIDTH, HEIGHT, EDGE = 340, 210, 56  # of a panel [pixels], and the room left of it


def commands(task: str, folder: Path, files: Path) -> list[list[str]]:
    """Training and evaluation of one task."""
    _, _, training, both = TASKS[task]
    place = scene(task, files)
    vn_nav = [sys.executable, '-m', 'vn_nav.cli']
    return [
        [*vn_nav, 'train', '--preset', 'fast', '--scene', place, '--size', '84', '--minutes',
         str(MINUTES), '--frames', '1e9', '--threads', '1', '--seed', '0', '--no-tensorboard',
         *training, *both, '--out', str(folder), *(['--resume'] if folder.exists() else [])],
        [*vn_nav, 'evaluate', str(folder / 'checkpoint'), '--scene', place, *both,
         '--episodes', str(EPISODES), '--json', str(folder / 'evaluation.json')]]


def run(task: str, runs: Path, core: int):
    """Start what is left to do of a task on a core; None: nothing."""
    folder = runs / task
    if (folder / 'evaluation.json').exists():
        return None
    both = ' && '.join(' '.join(f"'{part}'" for part in command)
                       for command in commands(task, folder, runs / 'files'))
    with open(runs / f'{task}.log', 'a') as log:
        return subprocess.Popen(['taskset', '-c', str(core), 'sh', '-c', both], stdout=log,
                                stderr=subprocess.STDOUT, cwd=ROOT,
                                env=os.environ | {'OMP_NUM_THREADS': '1'})


def keep(task: str, runs: Path) -> None:
    """Curve and figures of a run that has ended, into the repository."""
    thin(runs / task, CURVES / task)
    figures = json.loads((runs / task / 'evaluation.json').read_text())
    text = json.dumps({'machine': machine(), **figures}, indent=1)
    (CURVES / task / 'evaluation.json').write_text(text.replace(str(ROOT) + '/', '') + '\n')


def rows(task: str) -> dict[str, dict]:
    """What was measured in a task: the policy and its controls, by name."""
    splits = json.loads((CURVES / task / 'evaluation.json').read_text())['splits']
    (split,) = splits.values()
    return split['rows'][ARRIVAL]


def table(tasks: list[str]) -> None:
    """A line for each task and row, in Markdown."""
    print('| task | frames | row | success | SPL | collisions | decisions | return |\n'
          '|---|---|---|---|---|---|---|---|')
    for task in tasks:
        frames = read_runs([CURVES / task])[0].columns['frames'][-1]
        for k, (name, figures) in enumerate(rows(task).items()):
            words = [f'{task} | {frames:,.0f}' if k == 0 else ' | ', name]
            words += ['-' if figures[key] is None else f'{figures[key]:{form}}' for key, form in (
                ('success', '.2f'), ('spl', '.2f'), ('collisions', '.1%'), ('decisions', '.0f'),
                ('return', '.2f'))]
            print('| ' + ' | '.join(words) + ' |')


def chart(tasks: list[str]) -> None:
    """A panel for each task: the curve over minutes, random actions, the shortest path."""
    names = [('fast, while learning (dashed: inside the curriculum)', 'c0'),
             ('random actions', 'c1'), ('shortest path', 'c2')]
    across = 2
    shapes, used = legend(names, EDGE, 12, across * (WIDTH + EDGE))
    for k, task in enumerate(tasks):
        title, metric, *_ = TASKS[task]
        curve = average(read_runs([CURVES / task], metric), 'minutes', metric)
        series = [Series(names[0][0], 'c0', curve.x, curve.mean, curve.low, curve.high,
                         curve.full)]
        for (name, colour), row in zip(names[1:], (RANDOM, SHORTEST), strict=True):
            if row in (measured := rows(task)):
                flat = np.full(2, measured[row][metric])
                series.append(Series(name, colour, np.array([curve.x[0], curve.x[-1]]), flat,
                                     flat, flat, np.ones(2, bool)))
        left = EDGE + (k % across) * (WIDTH + EDGE)
        top = 40 + used + (k // across) * (HEIGHT + 70)
        top_value = max(1.0, max(float(s.high.max()) for s in series) * 1.05)
        low_value = min(0.0, min(float(s.low.min()) for s in series) * 1.05)
        shapes += panel((left, top, left + WIDTH, top + HEIGHT), series,
                        title=f'{title}, over minutes', y_range=(low_value, top_value), log=False)
    lines = -(-len(tasks) // across)
    picture = to_picture(shapes, EDGE + across * (WIDTH + EDGE), 50 + used + lines * (HEIGHT + 70))
    cv2.imwrite(str(CHART), cv2.cvtColor(picture, cv2.COLOR_RGB2BGR))


def main():
    """Run what is missing, each on a core of its own."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--tasks', nargs='+', choices=TASKS, default=list(TASKS))
    parser.add_argument('--runs', type=Path, default=ROOT / 'runs' / 'simulators')
    parser.add_argument('--figures', action='store_true', help='only chart and table')
    arguments = parser.parse_args()
    runs = arguments.runs.resolve()
    runs.mkdir(parents=True, exist_ok=True)
    waiting = [] if arguments.figures else list(arguments.tasks)
    running = {}
    while waiting or running:
        for core in sorted(os.sched_getaffinity(0))[:2]:
            if core in running:
                task, process = running[core]
                if process.poll() is None:
                    continue
                del running[core]
                if process.returncode:
                    raise SystemExit(f'{task} ended with {process.returncode}: see its log')
                keep(task, runs)
            while waiting and core not in running:
                task = waiting.pop(0)
                if (process := run(task, runs, core)) is None:
                    keep(task, runs)
                else:
                    print(f'core {core}: {task}', flush=True)
                    running[core] = task, process
        time.sleep(5)
    done = [task for task in TASKS if (CURVES / task / 'evaluation.json').exists()]
    chart(done)
    table(done)


if __name__ == '__main__':
    main()

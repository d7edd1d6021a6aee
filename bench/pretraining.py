"""What pre-training from bags gains: frames to 90 % success, from scratch and after it.

    python bench/pretraining.py --runs runs/pretraining                # everything, one core
    python bench/pretraining.py --runs runs/pretraining --seeds 0      # a part of it
    python bench/pretraining.py --no-curriculum --minutes 4            # goals anywhere at once

The task of `bench/learning.py`: the preset `fast` in a house of two rooms. Three ways to begin,
none of them with the picture pairs of the simulator that `fast` otherwise learns from first:

- **scratch**;
- **images**: `vn_nav pretrain` of the heads depth, segmentation and goal segmentation on 20,000
  pictures from random poses of that house (`vn_nav collect`; thesis, 5.7);
- **cloning**: the same pictures and ten simulated minutes of joystick over ROS in that house,
  recorded by `recorder_node`: all heads, goal poses by hindsight, and cloning.

The weights are pre-trained once, the reinforcement has several seeds. What was interrupted goes
on, what has ended is not repeated. Curves go to docs/curves/pretraining/, those without the
curriculum, whose own steps take most of the frames of this house, to another folder.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

from learning import HOUSE, ROOMS, ROOT, is_over, write_table

from vn_nav.report.curves import thin

CURVES = ROOT / 'docs' / 'curves' / 'pretraining'
WHOLE = CURVES.with_name('pretraining-whole')  # of the curves without a curriculum
PICTURES = 20_000  # thesis, 5.7
IMAGE_HEADS = 'depth,segmentation,goal_segmentation'
SCRATCH, IMAGES, CLONING = ARMS = ('scratch', 'images', 'cloning')
MINUTES = 20.0  # of a reinforcement run at most


def call(*arguments: str, log: Path) -> None:
    """A command of the project or of the bench; its failure ends this program."""
    print(*arguments[:4], '...', flush=True)
    with open(log, 'a') as file:
        done = subprocess.run([sys.executable, *arguments], stdout=file, stderr=subprocess.STDOUT,
                              cwd=ROOT, env=os.environ | {'OMP_NUM_THREADS': '1'})
    if done.returncode:
        raise SystemExit(f'{" ".join(arguments)} ended with {done.returncode}: see {log}')


def pretrain(runs: Path, epochs: int) -> dict[str, Path]:
    """The bags and what is learned from them; the weights to begin with, by arm."""
    seen, drive, done = runs / 'seen', runs / 'joystick' / 'bag', runs / 'pretrain.json'
    took = json.loads(done.read_text()) if done.is_file() else {}

    def once(name: str, out: Path, *arguments: str) -> None:
        if name not in took:
            begun = time.monotonic()
            shutil.rmtree(out, ignore_errors=True)
            call(*arguments, log=runs / f'{name}.log')
            took[name] = round((time.monotonic() - begun) / 60, 2)
            done.write_text(json.dumps(took, indent=2) + '\n')

    once('collect', seen, '-m', 'vn_nav.cli', 'collect', '--house', str(HOUSE), '--rooms',
         str(ROOMS), '--pictures', str(PICTURES), '--out', str(seen))
    # The camera of the standard robot, and odometry that is right.
    once('joystick', drive.parent, 'bench/teach_and_drive.py', '--stage', 'record', '--out',
         str(drive.parent), '--house', str(HOUSE), '--rooms', str(ROOMS), '--camera-height', '1.0',
         '--drift', '0', '--size', '84')
    first = {IMAGES: ([seen], '--heads', IMAGE_HEADS, '--no-cloning'), CLONING: ([seen, drive],)}
    for arm, (bags, *arguments) in first.items():
        once(arm, runs / arm, '-m', 'vn_nav.cli', 'pretrain', *map(str, bags), '--out',
             str(runs / arm), '--epochs', str(epochs), '--cache', str(runs / 'decoded'),
             *arguments)
    print('minutes:', took, flush=True)
    return {arm: runs / arm / 'checkpoint' for arm in first}


def train(runs: Path, arm: str, seed: int, init: Path | None, minutes: float,
          curriculum: bool) -> None:
    """One run of reinforcement; with a curriculum until it has held the highest success."""
    folder = runs / f'{arm}-seed{seed}'

    def over() -> bool:
        # Without a curriculum the first episodes to end are successful, and show nothing.
        return is_over(folder, minutes) if curriculum else (folder / 'over').is_file()
    if not over():
        arguments = [sys.executable, '-m', 'vn_nav.cli', 'train', '--preset', 'fast',
                 '--house', str(HOUSE), '--rooms', str(ROOMS), '--seed', str(seed),
                 '--minutes', str(minutes), '--frames', '1e9', '--max-decisions', '300',
                 '--pair-minutes', '0', '--no-tensorboard', '--out', str(folder),
                 *(() if curriculum else ('--set', 'start_difficulty=1.0'))]
        arguments += ['--resume'] if folder.exists() else ['--init', str(init)] if init else []
        print(f'{folder.name}, {minutes:g} minutes at most', flush=True)
        with open(runs / f'{folder.name}.log', 'a') as log:
            process = subprocess.Popen(arguments, stdout=log, stderr=subprocess.STDOUT, cwd=ROOT,
                                       env=os.environ | {'OMP_NUM_THREADS': '1'})
        while process.poll() is None:
            time.sleep(5)
            if over():
                process.send_signal(signal.SIGINT)
                process.wait()
        if process.returncode:
            raise SystemExit(f'{folder.name} ended with {process.returncode}: see its log')
        (folder / 'over').touch()
    thin(folder, (CURVES if curriculum else WHOLE) / folder.name)


def main():
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__.split('\n')[0])
    parser.add_argument('--runs', type=Path, default=ROOT / 'runs' / 'pretraining')
    parser.add_argument('--seeds', type=int, nargs='+', default=[0, 1, 2])
    parser.add_argument('--arms', nargs='+', choices=ARMS, default=ARMS)
    parser.add_argument('--epochs', type=int, default=30, help='thesis, table 5.1')
    parser.add_argument('--minutes', type=float, default=MINUTES, help='of a run at most')
    parser.add_argument('--curriculum', action=argparse.BooleanOptionalAction, default=True)
    options = parser.parse_args()
    runs = options.runs.resolve()
    runs.mkdir(parents=True, exist_ok=True)
    first = pretrain(runs, options.epochs)
    where = runs if options.curriculum else runs / WHOLE.name
    where.mkdir(exist_ok=True)
    for seed in options.seeds:
        for arm in options.arms:
            train(where, arm, seed, first.get(arm), options.minutes, options.curriculum)
    write_table(CURVES if options.curriculum else WHOLE)


if __name__ == '__main__':
    main()

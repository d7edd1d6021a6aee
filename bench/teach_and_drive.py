"""Teach and drive: a house that no model has seen, ten minutes with a joystick, then pictures.

    python bench/teach_and_drive.py --out teach_and_drive                  # all three stages
    python bench/teach_and_drive.py --out teach_and_drive --stage record   # or one at a time
    python bench/teach_and_drive.py --out teach_and_drive --stage teach --minutes 30
    python bench/teach_and_drive.py --out teach_and_drive --stage drive --rows before after
    python bench/teach_and_drive.py --out teach_and_drive --stage drive --without-ros --seed 7
    # A policy that searches, in three houses, where it has to say that it has arrived.
    python bench/teach_and_drive.py --out three --house 12000 12001 10000 --minutes 5 \
      --checkpoint models/search --stop declared --without-ros --rows before after 'wrong picture'

- **record**: `sim_bridge_node` with a house of the split "unseen look", a camera at another height
  than the policy's and drifting odometry; a joystick (`vn_sim_bridge.robot.joystick`) that
  publishes Twist; `recorder_node`. Writes `bag`, `robot.yaml`, `record.json`, a map (`record.png`)
  and views out of the bag (`views.png`); `vn_nav bag doctor` has to find no error.
- **teach**: `vn_nav teach` on that bag alone, for so many minutes. Writes `taught`.
- **drive**: episodes over ROS from random starts to pictures out of the bag, of which
  `ground_truth/odom` says where they were taken: `goals`. Rows: the policy before and after, the
  policy after with the pictures of other places, and random actions in the same robot without ROS,
  all from the same starts. Counted from the bags. Writes `result.json`, prints a table.

The joystick's robot has no motion noise: in the simulator no odometry sees that noise (2 deg a
turn of 30 deg: 44 deg in ten minutes of turning around). `--drift` stands in its place, as a base
with encoders and a gyro has it. Several houses have a folder each, and `result.json` is of all.
"""

from __future__ import annotations

import argparse
import shutil
import sys
import time
from pathlib import Path

from drive_episodes import DRIVE_SEED, ROWS, drive
from record_drive import record, run_command, write_figures

from vn_nav.cli.world import machine
from vn_nav.errors import UserError
from vn_nav.evaluation.evaluator import ARRIVAL
from vn_nav.evaluation.metrics import summarise
from vn_nav.nodes.processes import ProcessFailure
from vn_nav.report.tables import print_rows
from vn_nav.resources import share_file
from vn_sim_bridge.navigation.env_config import STOPS

STAGES = ('record', 'teach', 'drive')


def teach(options) -> None:
    """`vn_nav teach` on the bag alone."""
    shutil.rmtree(options.out / 'taught', ignore_errors=True)
    begun = time.monotonic()
    arguments = ['teach', str(options.out / 'bag'), '--checkpoint', str(options.checkpoint),
                 '--robot', str(options.out / 'robot.yaml'), '--out', str(options.out / 'taught'),
                 '--minutes', str(options.minutes)]
    run_command(*arguments)
    write_figures(options.out / 'teach.json', {
        'wall_minutes': round((time.monotonic() - begun) / 60, 2),
        'minutes': options.minutes, 'machine': machine(),
        'command': ' '.join(['vn_nav', *arguments])})


def together(options, houses: dict[int, dict]) -> None:
    """Figures of all houses: of as many episodes each."""
    rows = {row: summarise([episode for own in houses.values() for episode in own[row]])
            for row in options.rows}
    write_figures(options.out / 'result.json', {
        'stop': options.stop, 'houses': list(houses), 'rows': rows, 'machine': machine(),
        'checkpoint': str(options.checkpoint), 'seed': options.seed})
    print_rows({options.stop: rows}, f'houses {", ".join(map(str, houses))}')


def main() -> int:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__.split('\n')[0])
    parser.add_argument('--out', type=Path, required=True, help='folder for everything')
    parser.add_argument('--stage', choices=STAGES, help='only this one')
    parser.add_argument('--checkpoint', type=Path, default=share_file('models/anywhere'))
    parser.add_argument('--house', type=int, nargs='+', default=[12_000],
                        help='12000 on: unseen look')
    parser.add_argument('--rooms', type=int, default=5)
    parser.add_argument('--camera-height', type=float, default=0.6, help='m')
    parser.add_argument('--randomisation', default='standard')
    parser.add_argument('--drift', type=float, default=1.0, help='odometry_drift of the bridge')
    parser.add_argument('--size', type=int, default=144, help='side of the pictures [pixels]')
    parser.add_argument('--simulated-minutes', type=float, default=10.0, help='of joystick')
    parser.add_argument('--spacing', type=float, default=1.0, help='of the places visited [m]')
    parser.add_argument('--no-turns', dest='turns', action='store_false',
                        help='do not turn around at the places')
    parser.add_argument('--minutes', type=float, default=30.0, help='of teaching')
    parser.add_argument('--episodes', type=int, default=50)
    parser.add_argument('--goals', type=int, default=50, help='pictures of the bag')
    parser.add_argument('--without-ros', action='store_true', help='drive in the same robot '
                        'without ROS: five times as fast')
    parser.add_argument('--seed', type=int, default=DRIVE_SEED, help='of starts and goals')
    parser.add_argument('--stop', choices=STOPS, default=ARRIVAL, help='what ends an episode')
    parser.add_argument('--rows', nargs='+', choices=ROWS, default=ROWS)
    options = parser.parse_args()
    driven: dict[int, dict] = {}
    try:
        for house in options.house:
            own = argparse.Namespace(**{**vars(options), 'house': house})
            if len(options.house) > 1:
                own.out = options.out / f'house_{house}'
            for stage in STAGES:
                if options.stage in (None, stage):
                    done = {'record': record, 'teach': teach, 'drive': drive}[stage](own)
                    if done is not None:
                        driven[house] = done
        if len(driven) > 1:
            together(options, driven)
    except (UserError, ProcessFailure) as error:
        print(f'{error}; logs are in {options.out / "logs"}', file=sys.stderr)
        return 1
    return 0


if __name__ == '__main__':
    sys.exit(main())

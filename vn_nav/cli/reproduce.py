"""`vn_nav reproduce`: an experiment of the thesis, run again."""

from __future__ import annotations

import argparse
import os
from pathlib import Path

from vn_nav.cli.interruption import ended_as_by_ctrl_c
from vn_nav.experiments.experiment import experiment_names


def add_options(parser: argparse.ArgumentParser) -> None:
    """Options of `vn_nav reproduce`."""
    parser.add_argument('names', nargs='+', metavar='NAME', help=f'{", ".join(experiment_names())}'
                        ', or a file of your own (vn_nav/experiments/experiment.py)')
    parser.add_argument('--full', action='store_true', help="the thesis's frames, which take days "
                        'without a GPU; default: a size for two cores')
    parser.add_argument('--out', type=Path, default=Path('runs/reproduce'), help='folder of the '
                        'runs; what is there goes on')
    parser.add_argument('--results', type=Path, metavar='DIR', help='what stays of the runs: '
                        'curves, figures, pages (default: OUT/results)')
    parser.add_argument('--seeds', type=int, nargs='+', default=[0, 1, 2])
    parser.add_argument('--arms', nargs='+', default=[], metavar='ARM', help='only these of an '
                        'experiment')
    parser.add_argument('--scene', action='append', default=[], help='instead of the '
                        "experiment's: a copy of the thesis's own; may be given several times")
    parser.add_argument('--frames', type=float, help="of a run instead of the size's, to try it")
    parser.add_argument('--jobs', type=int, default=len(os.sched_getaffinity(0)), help='runs side '
                        'by side, one core each')
    parser.add_argument('--device', default='cpu', help='of the trainings, cpu or cuda:0')
    parser.add_argument('--page', action='store_true', help='run nothing: write chart, table and '
                        'page of what has ended')


def run(args: argparse.Namespace) -> int:
    """`vn_nav reproduce NAME`.

    Raises:
        UserError: an unknown experiment or arm; a command that failed.
    """
    from vn_nav.cli.world import SAY, machine
    from vn_nav.errors import UserError
    from vn_nav.experiments.experiment import load_experiment
    from vn_nav.experiments.reproduction import Reproduction
    from vn_nav.report.experiment_page import write_results
    cores = sorted(os.sched_getaffinity(0))
    if not 1 <= args.jobs <= len(cores):
        raise UserError(f'1 to {len(cores)} runs go side by side here', args.jobs,
                        'correct --jobs')
    size = 'full' if args.full else 'quick'
    wanted = [Reproduction(
        load_experiment(name), size, args.out, args.results or args.out / 'results',
        seeds=args.seeds, arms=args.arms, scenes=args.scene, device=args.device,
        frames=int(args.frames) if args.frames else None, machine=machine(args.device))
        for name in args.names]
    with ended_as_by_ctrl_c():  # runs save and end, then
        for own in wanted:
            if not args.page:
                own.run(cores[:args.jobs], SAY)
            if write_results(own.experiment, size, own.kept) is None:
                raise UserError('a page is of runs that have ended', str(own.kept),
                                'run the experiment without --page')
            print(own.kept / 'page.html')
    return 0

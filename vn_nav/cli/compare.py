"""`vn_nav compare`: learning curves of several runs."""

from __future__ import annotations

import argparse
from pathlib import Path

from vn_nav.cli.options import check_folders


def add_options(parser: argparse.ArgumentParser) -> None:
    """Options of `vn_nav compare`."""
    parser.add_argument('runs', nargs='+', type=Path, metavar='RUN', help='folder with '
                        'metrics.csv; NAME-seed1, NAME-seed2, ... are seeds of one curve')
    parser.add_argument('--out', type=Path, default=Path('compare.html'),
                        help='page (.html) or picture (.svg, .png)')
    parser.add_argument('--metric', default='success', help='a column of metrics.csv')
    parser.add_argument('--labels', nargs='+', metavar='LABEL', help='a name for each run; equal '
                        'names are seeds of one curve')
    parser.add_argument('--band', choices=('range', 'std'), default='range', help='over seeds: '
                        'from the smallest to the largest, or one standard deviation each way')
    parser.add_argument('--log', action='store_true', help='logarithmic frames and minutes')
    parser.add_argument('--json', type=Path, metavar='FILE', help='also write the table here')


def run(args: argparse.Namespace) -> int:
    """`vn_nav compare`."""
    from vn_nav.report.compare import compare
    check_folders(args.out, args.json)
    compare(args.runs, args.out, metric=args.metric, labels=args.labels, band=args.band,
            log=args.log, json_file=args.json)
    return 0

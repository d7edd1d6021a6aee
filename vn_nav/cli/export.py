"""`vn_nav export`: a checkpoint as ONNX."""

from __future__ import annotations

import argparse
from pathlib import Path


def add_options(parser: argparse.ArgumentParser) -> None:
    """Options of `vn_nav export`."""
    parser.add_argument('checkpoint', type=Path)
    parser.add_argument('--onnx', type=Path, required=True, metavar='FOLDER',
                        help='for the models and what the robot needs with them')


def run(args: argparse.Namespace) -> int:
    """`vn_nav export`."""
    from vn_nav.policy.checkpoint import load_checkpoint
    from vn_nav.policy.export import export_onnx
    for path in export_onnx(load_checkpoint(args.checkpoint), args.onnx):
        print(f'{path}: {path.stat().st_size / 1e6:.1f} MB')
    return 0

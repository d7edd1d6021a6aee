"""`vn_nav export`: a checkpoint as ONNX."""

from __future__ import annotations

import argparse
from pathlib import Path


def add_options(parser: argparse.ArgumentParser) -> None:
    """Options of `vn_nav export`."""
    parser.add_argument('checkpoint', type=Path)
    parser.add_argument('--onnx', type=Path, metavar='FOLDER', help='for the models and what the '
                        'robot needs with them; default: the folder onnx in that of the '
                        'checkpoint, which policy_node then runs by ONNX Runtime')


def run(args: argparse.Namespace) -> int:
    """`vn_nav export`."""
    from vn_nav.policy.checkpoint import load_checkpoint
    from vn_nav.policy.checkpoint_info import EXPORT
    from vn_nav.policy.export import export_onnx
    folder = args.onnx or args.checkpoint / EXPORT
    for path in export_onnx(load_checkpoint(args.checkpoint), folder):
        print(f'{path}: {path.stat().st_size / 1e6:.1f} MB')
    return 0

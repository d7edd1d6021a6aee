"""The `vn_nav` command: its commands, their parser, and what ends it."""

from __future__ import annotations

import argparse
import importlib
import os
import select
import signal
import sys
from typing import TextIO

from vn_nav import __version__
from vn_nav.errors import UserError

# A module of this package for each, with `add_options(parser)`; and `run(args)`, its exit code,
# unless it has actions of its own.
COMMANDS = {
    'demo': 'watch the shipped policy drive over ROS 2',
    'train': 'train a policy',
    'collect': 'record pictures from random poses as a bag, for pre-training',
    'pretrain': 'pre-train a policy on recorded bags',
    'drive-trial': 'drive on a base that slips and is late, beside an ideal one, over ROS 2',
    'teach': 'learn the place where a bag was driven, in its pictures',
    'evaluate': 'measure a checkpoint',
    'robustness': 'measure what a checkpoint bears: noise, light, other cameras, latency, ...',
    'film': 'film an episode of a policy that searches, with its map',
    'compare': "plot several runs' learning curves",
    'reproduce': 'run an experiment of the thesis again',
    'publish': 'measure a run and write it as a checkpoint to ship',
    'export': 'write a checkpoint as ONNX',
    'route': 'take a route out of a bag, and name places on it',
    'goal': 'drive to a place of a route, by its name',
    'doctor': 'check a live ROS 2 graph before a robot drives, and say what to type',
    'bag': 'check and repair recorded drives',
    'simulators': 'list the simulators, and what each can do',
    'house': 'look at an embedded house',
}


def build_parser(command: str | None = None) -> argparse.ArgumentParser:
    """The command line.

    Args:
        command: whose options are wanted; None: all. Those of training take torch along, which
            a look into a bag must not wait for.
    """
    parser = argparse.ArgumentParser(
        prog='vn_nav', description='Visual navigation for ROS 2: show a robot a picture, and it '
        'drives to where the picture was taken.')
    parser.add_argument('--version', action='version', version=f'vn_nav {__version__}')
    commands = parser.add_subparsers(dest='command', required=True, metavar='COMMAND')
    for name, about in COMMANDS.items():
        own = commands.add_parser(name, help=about)
        if command in (None, name):
            module = importlib.import_module(f'vn_nav.cli.{name.replace("-", "_")}')
            if hasattr(module, 'run'):
                own.set_defaults(run=module.run)
            module.add_options(own)
    return parser


def _has_reader(stream: TextIO) -> bool:
    """Whether someone can still read what is written: not so after `| head`."""
    poll = select.poll()
    poll.register(stream.fileno(), 0)
    return not any(event & select.POLLERR for _, event in poll.poll(0))


def main(argv: list[str] | None = None) -> int:
    """Entry point: 2 and one line on standard error for bad input."""
    arguments = sys.argv[1:] if argv is None else argv
    # The first argument that is no option is the command: no option before it takes a value.
    command = next((part for part in arguments if not part.startswith('-')), '')
    args = build_parser(command).parse_args(arguments)
    try:
        code = args.run(args)
        sys.stdout.flush()
        return code
    except BrokenPipeError:
        if _has_reader(sys.stdout):
            raise
        # As `| head` does; what is still buffered goes nowhere, or Python's end would complain.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 128 + signal.SIGPIPE
    except UserError as error:
        print(f'vn_nav: {error}', file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return 130

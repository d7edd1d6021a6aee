"""Options that several commands share, and what becomes of them."""

from __future__ import annotations

import argparse
import ast
import dataclasses
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from vn_nav.errors import UserError


def add_place_options(parser: argparse.ArgumentParser) -> None:
    """How pictures become a place."""
    from vn_nav.bags.mapping.recorded_place import MAX_GOALS
    parser.add_argument('--topics', type=Path, metavar='YAML',
                        help='names of the topics in the bag')
    parser.add_argument('--margin', type=float, metavar='M',
                        help='around the driven path that counts as free [m]; default 0.3')
    parser.add_argument('--straighten', action=argparse.BooleanOptionalAction, default=True,
                        help='correct odometry by loop closure: by the places that the drive '
                        'shows twice (docs/bags.md)')
    parser.add_argument('--pictures', metavar='A-B[,C-D]', help='numbers of the pictures to '
                        'learn from; several ranges: you vouch that their odometry has one frame')
    parser.add_argument('--goals', type=int, default=MAX_GOALS,
                        help='pictures to drive to, at most')
    parser.add_argument('--cache', type=Path, metavar='DIR', help='folder of decoded '
                        'bags; default: `decoded` in the folder of a run, or none')


def given_place_options(args: argparse.Namespace) -> list[str]:
    """Names of those that differ from their default."""
    from vn_nav.bags.mapping.recorded_place import MAX_GOALS
    given = {'--topics': args.topics, '--margin': args.margin, '--cache': args.cache,
             '--pictures': args.pictures,
             '--no-straighten': None if args.straighten else True,
             '--goals': None if args.goals == MAX_GOALS else args.goals}
    return [name for name, value in given.items() if value is not None]


def place_options(args: argparse.Namespace):
    """The `PlaceOptions` of a command line.

    Raises:
        UserError: values that no drive is a place with.
    """
    from vn_nav.bags.mapping.recorded_place import PlaceOptions
    from vn_nav.bags.roles import Topics, load_topics
    return PlaceOptions(topics=load_topics(args.topics) if args.topics else Topics(),
                        margin=args.margin, loop_closure=args.straighten,
                        pictures=args.pictures or '', goals=args.goals)


def parse_changes(texts: Sequence[str]) -> dict[str, Any]:
    """Numbers of `TrainConfig` by name, of the texts NAME=VALUE.

    Raises:
        UserError: a text of another form, or an unknown name.
    """
    from vn_nav.learning.presets import TrainConfig
    known = {field.name: field.default for field in dataclasses.fields(TrainConfig)}
    changes: dict[str, Any] = {}
    for text in texts:
        name, equals, value = text.partition('=')
        if not equals or name not in known:
            raise UserError('--set takes NAME=VALUE with a number of TrainConfig', text,
                            f'the names are {", ".join(sorted(known))}')
        try:
            changes[name] = ast.literal_eval({'true': 'True', 'false': 'False'}.get(value, value))
        except (ValueError, SyntaxError):
            changes[name] = value
        if isinstance(known[name], str):
            changes[name] = value  # a text, whatever it looks like
    return changes


def check_folders(*files: Path | None) -> None:
    """Refuse files whose folder does not exist."""
    for file in files:
        if file is not None and not file.absolute().parent.is_dir():
            raise UserError('a file is written into a folder that exists', str(file),
                            'make the folder, or choose another place')


def command_line() -> str:
    """This command as somebody would repeat it."""
    return 'vn_nav ' + shlex.join(part for part in sys.argv[1:] if part != '--resume')

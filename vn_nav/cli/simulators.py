"""`vn_nav simulators`: what there is, what each can do, what is missing here."""

from __future__ import annotations

import argparse
import dataclasses
import textwrap

from vn_nav.cli import simulators_dump
from vn_nav.errors import UserError


def add_options(parser: argparse.ArgumentParser) -> None:
    """The actions of `vn_nav simulators`; none: the list."""
    actions = parser.add_subparsers(dest='action', metavar='ACTION')
    action = actions.add_parser('install', help='install what a simulator needs')
    action.add_argument('name', help='of the simulator: dmlab')
    action.add_argument('--system', action='store_true',
                        help='also Debian packages; only as root')
    action.set_defaults(run=_install)
    simulators_dump.add_action(actions)


def _install(args: argparse.Namespace) -> int:
    """`vn_nav simulators install NAME`."""
    from vn_sim_bridge.simulators import install
    print(install(args.name, system=args.system))
    return 0


def run(args: argparse.Namespace) -> int:
    """`vn_nav simulators`: what there is, what each can do, what is missing here."""
    from vn_sim_bridge.simulators import missing, simulator_class, table

    def say(label: str, text: str) -> None:
        print(textwrap.fill(text, 79, initial_indent=f'  {label:<8}', subsequent_indent=' ' * 10,
                            break_long_words=False, break_on_hyphens=False))

    for name, entry in table().items():
        print(textwrap.shorten(f'{name}: {entry.about}', 79))
        say('scene', entry.scene)
        if lacking := missing(entry):
            say('missing', f'{", ".join(lacking)}: {entry.install}')
            continue
        try:
            kind = simulator_class(name)
        except UserError as error:  # an entry point that leads nowhere
            say('missing', str(error))
            continue
        can = [field.name.replace('_', ' ') for field in
               dataclasses.fields(kind.capabilities) if getattr(kind.capabilities, field.name)]
        say('can', ', '.join(can))
        if kind.splits:
            say('splits', ', '.join(f'{split} ({len(scenes):,})'
                                    for split, scenes in kind.splits.items()))
        say('version', kind.version)
    return 0

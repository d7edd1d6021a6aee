"""What `vn_nav bag` does: options and output."""

from __future__ import annotations

import argparse
import dataclasses
import json
import math
from pathlib import Path

from vn_nav.errors import UserError


def add_bag_commands(parser: argparse.ArgumentParser) -> None:
    """The actions of `vn_nav bag`."""
    actions = parser.add_subparsers(dest='action', required=True, metavar='ACTION')

    doctor = actions.add_parser(
        'doctor', help='say what is wrong with a recorded drive, and what to do about it')
    doctor.add_argument('bag', type=Path, help='rosbag2 folder or MCAP file')
    doctor.add_argument('--checkpoint', type=Path, metavar='DIR',
                        help='policy that the camera has to suit')
    doctor.add_argument('--robot', type=Path, metavar='YAML',
                        help='robot whose camera it has to be (without --checkpoint)')
    doctor.add_argument('--topics', type=Path, metavar='YAML',
                        help='names in the bag, such as image: /camera/color/image_raw')
    doctor.add_argument('--json', type=Path, metavar='FILE', help='also write the figures here')
    doctor.set_defaults(run=run_doctor)

    recover = actions.add_parser(
        'recover', help='write what is whole in a damaged bag as a new one')
    recover.add_argument('bag', type=Path, help='rosbag2 folder or MCAP file; it is only read')
    recover.add_argument('out', type=Path, help='new folder, or new file that ends in .mcap')
    recover.add_argument('--strict', action='store_true',
                         help='exit code 2 if something was lost')
    recover.set_defaults(run=run_recover)


def run_doctor(args) -> int:
    """`vn_nav bag doctor`: 0 where the bag can be used, 1 where it cannot."""
    from vn_nav.bags.doctor import diagnose
    from vn_nav.bags.drive import load_topics
    if args.json is not None and not args.json.absolute().parent.is_dir():
        raise UserError('a file is written into a folder that exists', str(args.json),
                        'make the folder, or choose another place')
    diagnosis = diagnose(args.bag, topics=load_topics(args.topics) if args.topics else None,
                         fov=_field_of_view(args.checkpoint, args.robot))
    _print(diagnosis)
    if args.json is not None:
        figures = {**dataclasses.asdict(diagnosis), 'usable': diagnosis.usable}
        try:
            args.json.write_text(json.dumps(figures, indent=2) + '\n')
        except OSError as error:
            raise UserError('the figures can be written', f'{args.json}: {error.strerror}',
                            'free some space, or choose another place') from error
    return 0 if diagnosis.usable else 1


def run_recover(args) -> int:
    """`vn_nav bag recover`: 0, with what was lost told; if strict, 2 where something was."""
    from vn_nav.bags.recover import recover
    recovered = recover(args.bag, args.out)
    print('\n'.join(recovered.lines()))
    return 2 if args.strict and recovered.lost else 0


def _field_of_view(checkpoint: Path | None, robot: Path | None) -> float | None:
    """What the camera has to see [rad]; None: nobody has said."""
    if checkpoint is not None:
        from vn_nav.policy.checkpoint import load_checkpoint
        return math.radians(load_checkpoint(checkpoint).info['camera_fov_deg'])
    if robot is not None:
        from vn_nav.robot import load_robot
        return load_robot(robot).camera_fov
    return None


def _print(diagnosis) -> None:
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text
    console = Console()
    if not console.is_terminal:
        console.width = 200  # a file or a pipe has no width of its own
    topics = Table(title=Text(f'{diagnosis.bag}: {diagnosis.seconds:.1f} s'))
    for heading in ('topic', 'type', 'messages', 'Hz', 'worst gap', 'MB', 'stamps', 'pictures'):
        topics.add_column(heading, justify='left' if heading in ('topic', 'type', 'pictures')
                          else 'right')
    for t in diagnosis.topics:
        topics.add_row(Text(t.topic), Text(t.type.replace('/msg/', '/')), str(t.count),
                       '' if t.rate is None else f'{t.rate:.3g}',
                       '' if t.worst_gap is None else f'{t.worst_gap:.2f} s',
                       f'{t.bytes / 1e6:.2f}', _stamps(t), Text(', '.join(t.pictures)))
    console.print(topics)
    for finding in diagnosis.findings:
        where = finding.topic or 'the bag'
        times = '' if finding.count == 1 else f', {finding.count} times'
        first = '' if finding.when is None else f' (at {finding.when:.2f} s{times})'
        style = 'bold red' if finding.severity == 'error' else 'yellow'
        console.print(Text.assemble((f'{finding.severity}: ', style), f'{where} '
                                    f'{finding.what}{first}; {finding.remedy}'))
    if not diagnosis.findings:
        console.print(Text.assemble(('ok: ', 'green'), 'nothing is wrong with it'))


def _stamps(figures) -> str:
    if figures.unordered is None:
        return ''
    faults = [f'{count} {words}' for count, words in ((figures.unordered, 'back'),
                                                      (figures.repeated, 'twice')) if count]
    return ', '.join(faults) or 'in order'

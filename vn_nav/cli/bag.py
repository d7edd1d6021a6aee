"""`vn_nav bag`: check, repair, show, export and drive along recorded drives."""

from __future__ import annotations

import argparse
import dataclasses
import json
import math
from pathlib import Path

from vn_nav.errors import UserError


def add_options(parser: argparse.ArgumentParser) -> None:
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

    show = actions.add_parser('show', help='write a page about a recorded drive')
    _add_drive(show)
    show.add_argument('--out', type=Path, default=Path('report.html'), metavar='HTML',
                      help='the page; default: report.html')
    show.add_argument('--checkpoint', type=Path, metavar='DIR',
                      help='policy to ask what it would have done')
    show.set_defaults(run=run_show)

    export = actions.add_parser('export', help='write a recorded drive as another kind of data')
    _add_drive(export)
    export.add_argument('--lerobot', type=Path, required=True, metavar='OUT',
                        help='new folder: a LeRobot dataset, version 3.0')
    export.add_argument('--fps', type=int, default=10, help='frames a second; default: 10')
    export.set_defaults(run=run_export)

    drive = actions.add_parser(
        'drive', help='let a policy see a recorded drive, and record what it would have done')
    _add_drive(drive)
    drive.add_argument('--checkpoint', type=Path, required=True, metavar='DIR', help='the policy')
    drive.add_argument('--compare', type=Path, metavar='DIR', help='another one, to compare with')
    drive.add_argument('--out', type=Path, metavar='FOLDER', help='new: the second bag; with '
                       '--compare both, and the comparison; default: BAG_shadow')
    drive.add_argument('--goal', type=Path, metavar='PICTURE', help='where the bag shows none; '
                       'default: the last picture of each episode')
    drive.add_argument('--decoding', choices=('sample', 'greedy'),
                       help='default: as the checkpoint was measured')
    ranges = drive.add_mutually_exclusive_group()
    ranges.add_argument('--scan-topic', metavar='TOPIC', default='', help='LaserScan of the bag '
                        'that the map of a policy which searches takes, as policy_node does')
    ranges.add_argument('--depth-topic', metavar='TOPIC', default='', help='the same of depth '
                        'pictures, with camera_info beside them')
    for name, what in (('x', 'ahead of the centre of the robot [m]'), ('y', 'to the left [m]'),
                       ('yaw', 'heading [rad]')):
        drive.add_argument(f'--scan-{name}', type=float, default=0.0, metavar=name.upper(),
                           help=f'where that sensor sits: {what}; default: 0')
    drive.set_defaults(run=run_drive)


def _add_drive(parser: argparse.ArgumentParser) -> None:
    parser.add_argument('bag', type=Path, help='rosbag2 folder or MCAP file')
    parser.add_argument('--topics', type=Path, metavar='YAML',
                        help='names in the bag, such as image: /camera/color/image_raw')
    parser.add_argument('--robot', type=Path, metavar='YAML',
                        help='that drove; default: the standard robot')


def run_doctor(args) -> int:
    """`vn_nav bag doctor`: 0 where the bag can be used, 1 where it cannot."""
    return 0 if examine(args).usable else 1


def examine(args):
    """Print what is wrong with a bag, and write it as JSON where that is wanted.

    Args:
        args: bag, checkpoint, robot, topics and json, as options of `vn_nav bag doctor`.

    Returns:
        The `Diagnosis`.
    """
    from vn_nav.bags.doctor.checks import diagnose
    from vn_nav.bags.roles import load_topics
    if args.json is not None and not args.json.absolute().parent.is_dir():
        raise UserError('a file is written into a folder that exists', str(args.json),
                        'make the folder, or choose another place')
    fov, any_lens = _camera(args.checkpoint, args.robot)
    diagnosis = diagnose(args.bag, topics=load_topics(args.topics) if args.topics else None,
                         fov=fov, any_lens=any_lens)
    _print(diagnosis)
    if args.json is not None:
        figures = {**dataclasses.asdict(diagnosis), 'usable': diagnosis.usable}
        try:
            args.json.write_text(json.dumps(figures, indent=2) + '\n')
        except OSError as error:
            raise UserError('the figures can be written', f'{args.json}: {error.strerror}',
                            'free some space, or choose another place') from error
    return diagnosis


def run_recover(args) -> int:
    """`vn_nav bag recover`: 0, with a list of what was lost; if strict, 2 where something was."""
    from vn_nav.bags.doctor.recover import recover
    recovered = recover(args.bag, args.out)
    print('\n'.join(recovered.lines()))
    return 2 if args.strict and recovered.lost else 0


def run_show(args) -> int:
    """`vn_nav bag show`."""
    from vn_nav.bags.report.page import show_page
    from vn_nav.bags.report.show import show
    from vn_nav.files import write_file
    from vn_nav.robot import DRIVE_ACTIONS, RobotSpec, load_robot
    if not args.out.absolute().parent.is_dir():
        raise UserError('a file is written into a folder that exists', str(args.out),
                        'make the folder, or choose another --out')
    robot = load_robot(args.robot) if args.robot else RobotSpec()
    checkpoint = None
    if args.checkpoint:
        from vn_nav.policy.checkpoint import load_checkpoint
        checkpoint = load_checkpoint(args.checkpoint)
        robot = robot.with_actions(checkpoint.config.actions, checkpoint.config.moves)
    elif args.robot is None:
        robot = robot.with_actions(DRIVE_ACTIONS)
    shown = show(args.bag, topics=_topics(args.topics), robot=robot, checkpoint=checkpoint)
    try:
        write_file(args.out, show_page(str(args.bag), shown, str(args.checkpoint)).encode())
    except OSError as error:
        raise UserError('the page can be written', f'{args.out}: {error.strerror}',
                        'free some space, or choose another --out') from error
    print(f'page {args.out}')
    return 0


def run_export(args) -> int:
    """`vn_nav bag export`."""
    from vn_nav.bags.export.lerobot import export
    from vn_nav.robot import RobotSpec, load_robot
    robot = load_robot(args.robot) if args.robot else RobotSpec()
    print(export(args.bag, args.lerobot, topics=_topics(args.topics), robot=robot.name,
                 fps=args.fps))
    return 0


def run_drive(args) -> int:
    """`vn_nav bag drive`: 0; 130 after SIGINT or SIGTERM, with what was recorded until then."""
    from vn_nav.cli.bag_drive import run
    from vn_nav.measured_ranges import RangeSource
    out = args.out or Path(f'{args.bag.resolve().stem}_shadow')
    return run(args.bag, args.checkpoint, out, other=args.compare, robot=args.robot,
               topics=_topics(args.topics), goal=args.goal, decoding=args.decoding,
               source=RangeSource(args.scan_topic, args.depth_topic,
                                  (args.scan_x, args.scan_y, args.scan_yaw)))


def _topics(path: Path | None):
    from vn_nav.bags.roles import Topics, load_topics
    return load_topics(path) if path else Topics()


def _camera(checkpoint: Path | None, robot: Path | None) -> tuple[float | None, bool]:
    """What the camera has to see [rad], and whether less will do; None: nobody has said."""
    if checkpoint is not None:
        from vn_nav.policy.checkpoint_info import SEARCH, read_config
        whole, info = read_config(checkpoint)
        return (math.radians(info['camera_fov_deg']),
                whole['network'].get('architecture') == SEARCH)
    if robot is not None:
        from vn_nav.robot import load_robot
        return load_robot(robot).camera_fov, False
    return None, False


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
    for note in diagnosis.notes:
        console.print(Text(f'note: {note}'))
    if not diagnosis.findings:
        console.print(Text.assemble(('ok: ', 'green'), 'nothing is wrong with it'))


def _stamps(figures) -> str:
    if figures.unordered is None:
        return ''
    kinds = (figures.unordered, 'back'), (figures.repeated, 'twice')
    faults = [f'{count} {what}' for count, what in kinds if count]
    return ', '.join(faults) or 'in order'

"""`vn_nav doctor`: check a live ROS 2 graph, or a bag, before a robot drives with it."""

from __future__ import annotations

import argparse
import dataclasses
import json
import math
from pathlib import Path

from vn_nav.cli.options import check_folders
from vn_nav.errors import UserError

MAX_SECONDS = 600.0


def add_options(parser: argparse.ArgumentParser) -> None:
    """Options of `vn_nav doctor`."""
    parser.description = ('Listen to a live ROS 2 graph for some seconds and say what is wrong, '
                          'and what to type. Exit code 0: no error, 1: errors (with --strict also '
                          'warnings), 2: bad usage; as `vn_nav bag doctor`.')
    parser.add_argument('--bag', type=Path, metavar='BAG', help='look at a recorded drive instead '
                        '(`vn_nav bag doctor`); needs no ROS')
    parser.add_argument('--checkpoint', type=Path, metavar='DIR',
                        help='policy that camera and robot have to suit')
    parser.add_argument('--robot', type=Path, metavar='YAML', help='the robot; default: standard')
    parser.add_argument('--topics', type=Path, metavar='YAML',
                        help='names of the topics, such as image: /camera/color/image_raw')
    parser.add_argument('--namespace', default='', metavar='/NS', help='of the robot')
    parser.add_argument('--seconds', type=float, default=5.0, metavar='S',
                        help='of listening; default: 5')
    parser.add_argument('--set', action='append', default=[], metavar='NAME=VALUE',
                        help='a parameter that policy_node is going to have; of one that runs its '
                        'own are read')
    parser.add_argument('--base-check', action='store_true', help='THE ROBOT MOVES: it turns '
                        'left by some 20 deg (70, if it has no time-out), and the doctor says how '
                        'long it goes on without commands')
    parser.add_argument('--strict', action='store_true', help='exit code 1 for warnings too')
    parser.add_argument('--html', type=Path, metavar='FILE', help='also write a page')
    parser.add_argument('--json', type=Path, metavar='FILE', help='also write what was found')


def run(args: argparse.Namespace) -> int:
    """`vn_nav doctor`: 0, or 1 where something is wrong."""
    check_folders(args.html, args.json)
    return _bag(args) if args.bag is not None else _graph(args)


def _bag(args: argparse.Namespace) -> int:
    """The one implementation is `vn_nav bag doctor`; here it gets a page."""
    from vn_nav.bags.doctor.figures import ERROR
    from vn_nav.cli.bag import examine
    from vn_nav.doctor.page import bag_page
    given = [name for name, value in (('--namespace', args.namespace), ('--set', args.set),
                                      ('--base-check', args.base_check)) if value]
    if given:
        raise UserError('a bag is looked at without a graph', ', '.join(given), 'leave it out')
    diagnosis = examine(args)
    _write(args.html, bag_page(diagnosis).encode())
    wrong = [f for f in diagnosis.findings if args.strict or f.severity == ERROR]
    return 1 if wrong else 0


def _graph(args: argparse.Namespace) -> int:
    from vn_nav.bags.roles import Topics, load_topics
    from vn_nav.doctor.camera_checks import Policy
    from vn_nav.doctor.checks import examine
    from vn_nav.doctor.page import graph_page
    from vn_nav.doctor.seen import ERROR, WARNING
    from vn_nav.robot import load_robot
    if not (math.isfinite(args.seconds) and 0 < args.seconds <= MAX_SECONDS):
        raise UserError(f'--seconds lies between 0 and {MAX_SECONDS:g}', args.seconds,
                        'give a few seconds')
    policy = Policy.read(args.checkpoint) if args.checkpoint else None
    robot = load_robot(args.robot) if args.robot else None
    topics = load_topics(args.topics) if args.topics else Topics()
    settings = _settings(args.set)
    try:
        from vn_nav.nodes.graph_doctor import Look, look
    except ModuleNotFoundError as error:
        raise UserError('a live graph is looked at with ROS 2', str(error),
                        'source /opt/ros/jazzy/setup.bash, or look at a bag with --bag') from error
    graph = look(Look(args.seconds, args.namespace, topics, settings, args.base_check))
    findings = examine(graph, policy, robot)
    _print(graph, findings)
    _write(args.html, graph_page(graph, findings).encode())
    if args.json is not None:
        figures = {'findings': [dataclasses.asdict(finding) for finding in findings],
                   'graph': dataclasses.asdict(graph)}
        _write(args.json, (json.dumps(figures, indent=2) + '\n').encode())
    wrong = {ERROR, WARNING} if args.strict else {ERROR}
    return 1 if any(finding.severity in wrong for finding in findings) else 0


def _settings(texts: list[str]) -> dict[str, object]:
    import yaml
    settings = {}
    for text in texts:
        name, equals, value = text.partition('=')
        if not equals:
            raise UserError('--set takes NAME=VALUE', text, 'as in max_frame_age=0.5')
        try:
            settings[name] = yaml.safe_load(value)
        except yaml.YAMLError as error:
            raise UserError('--set takes NAME=VALUE', text, 'as in max_frame_age=0.5') from error
    return settings


def _write(path: Path | None, data: bytes) -> None:
    from vn_nav.files import write_file
    if path is None:
        return
    try:
        write_file(path, data)
    except OSError as error:
        raise UserError('the file can be written', f'{path}: {error.strerror}',
                        'free some space, or choose another place') from error


def _print(graph, findings) -> None:
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    from vn_nav.doctor.page import topic_rows
    from vn_nav.doctor.seen import ORDER
    console = Console()
    if not console.is_terminal:
        console.width = 200  # a file or a pipe has no width of its own
    headings, rows = topic_rows(graph)
    shown = Table(title=Text(f'nodes: {len(graph.nodes)}; listened for {graph.seconds:.1f} s'))
    for heading in headings:
        shown.add_column(heading)
    for row in rows:
        shown.add_row(*map(Text, row))
    console.print(shown)
    styles = {'error': 'bold red', 'warning': 'yellow', 'ok': 'green'}
    for finding in reversed(findings):  # the worst last: it stays on the screen
        where = f'{finding.topic} ' * bool(finding.topic)
        console.print(Text.assemble(
            (f'{finding.severity}: ', styles[finding.severity]),
            f'{finding.check}: {where}{finding.seen}'))
        if finding.fix:
            console.print(Text(f'    fix: {finding.fix}'))
    counts = {severity: sum(f.severity == severity for f in findings) for severity in ORDER}
    console.print(Text(f'errors: {counts["error"]}, warnings: {counts["warning"]}'))

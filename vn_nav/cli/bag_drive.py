"""`vn_nav bag drive`: what a policy would have done along a recorded drive."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import numpy as np

from vn_nav.bags.roles import Topics
from vn_nav.bags.shadow.compare import (
    ARRIVED,
    as_json,
    compare,
    confusion_table,
    figures,
    filter_words,
    markdown,
    read_shadow,
)
from vn_nav.bags.shadow.plan import Plan, make_plan
from vn_nav.errors import UserError
from vn_nav.files import write_file
from vn_nav.goal_picture import read_goal_picture
from vn_nav.measured_ranges import RangeSource
from vn_nav.nodes.isolation import stay_on_this_host
from vn_nav.observation import check_camera
from vn_nav.policy.checkpoint import LoadedCheckpoint, load_checkpoint
from vn_nav.policy.checkpoint_info import SEARCH
from vn_nav.robot import RobotSpec, load_robot


def run(bag: Path, checkpoint: Path, out: Path, *, other: Path | None, robot: Path | None,
        topics: Topics, goal: Path | None, decoding: str | None, source: RangeSource) -> int:
    """Drive along a bag with one policy, or with two and compare them.

    Args:
        bag: the drive.
        checkpoint: the policy.
        out: folder of the second bag; with `other` of `a`, `b`, comparison.json and .md.
        other: the policy to compare with.
        robot: YAML file; None: the standard robot.
        topics: names in the bag.
        goal: picture file where the bag shows none.
        decoding: None: as the checkpoints were measured.
        source: of ranges for the policies' maps, by names in the bag.

    Returns:
        The exit code.

    Raises:
        UserError: see `make_plan` and `vn_nav.nodes.shadow.drive`; actions that differ, a camera
            that does not suit a policy, ranges for one that has no map.
    """
    folders = [checkpoint] if other is None else [checkpoint, other]
    policies = [load_checkpoint(folder) for folder in folders]
    spec = _robot(load_robot(robot) if robot else RobotSpec(), policies)
    picture = None if goal is None else read_goal_picture(goal)
    if out.exists():
        raise UserError('what is recorded has a folder of its own', str(out),
                        'choose another --out, or remove it')
    searches = [policy.config.architecture == SEARCH for policy in policies]
    source.check_policy(searches=all(searches))
    names = {role: name for role, name in (('scan', source.scan), ('depth', source.depth)) if name}
    plan = make_plan(bag, spec, dataclasses.replace(topics, **names), picture,
                     ranges=next(iter(names), ''))
    if plan.camera is not None:
        for policy, any_lens in zip(policies, searches, strict=True):
            check_camera(*plan.camera, math.radians(policy.info['camera_fov_deg']),
                         any_lens=any_lens)
    print(f'{bag}: {_words(plan)}', flush=True)
    outs = [out] if other is None else [out / 'a', out / 'b']
    latencies = []
    for folder, driver, has_map in zip(outs, folders, searches, strict=True):
        driven = _shadow().drive(plan, driver, folder, robot=robot, decoding=decoding,
                                 searches=has_map, mount=source.mount,
                                 say=lambda line: print(line, flush=True))
        left_out = (f'; {plan.unreadable} pictures could not be decoded' if plan.unreadable
                    else '')
        print(f'{folder}: {_told(folder, driven)}{left_out}', flush=True)
        if not driven.complete:
            print('ended by a signal; what was recorded until then is whole')
            return 130
        latencies.append(driven.latencies)
    if other is not None:
        _compare(outs, folders, latencies, out)
    return 0


def _shadow():
    """The module that needs ROS, imported where ROS stays on this host."""
    stay_on_this_host()
    try:
        from vn_nav.nodes import shadow
    except ImportError as error:
        raise UserError('a bag is driven by the real policy node, on ROS 2 Jazzy', str(error),
                        "pip install 'vn_nav[ros]', or source an installed Jazzy") from error
    return shadow


def _robot(robot: RobotSpec, policies: list[LoadedCheckpoint]) -> RobotSpec:
    """The robot with the policies' actions."""
    first, *others = policies
    for policy in others:
        if sorted(policy.config.actions) != sorted(first.config.actions):
            raise UserError('policies that are compared have the same actions: '
                            f'{", ".join(first.config.actions)}',
                            ', '.join(policy.config.actions), 'compare others')
        robot.with_actions(policy.config.actions, policy.config.moves)
    return robot.with_actions(first.config.actions, first.config.moves)


def _words(plan: Plan) -> str:
    """What is in a drive."""
    report, goals = plan.report, plan.goals
    episodes = len({decision.episode for decision in plan.decisions})
    known = [f'{goals.shown} of the bag', f'{goals.hindsight} last pictures of episodes',
             f'{episodes - goals.shown - goals.hindsight} by --goal']
    shown = ', '.join(part for part in known if not part.startswith('0 '))
    return (f'{report.pictures} pictures, {episodes} episodes, {len(plan.decisions)} decisions; '
            f'{report.misfits} motions fit no action; goals: {shown}; commands at '
            f'{plan.rate:.3g} Hz')


def _told(folder: Path, driven) -> str:
    """What a policy would have done."""
    if not driven.latencies:
        return 'no decision'
    shadow = read_shadow(folder)
    same, known = shadow.beside_the_drive
    arrived = sum(answer.choice == ARRIVED for answer in shadow.answers)
    return (f'{len(shadow.answers)} decisions, {same} of {known} as the drive, arrived '
            f'{arrived} times, {len(shadow.commands)} commands; '
            + ('' if shadow.filtered is None
               else f'action filter: {filter_words(shadow.filtered)}; ')
            + ('' if shadow.ranges is None
               else f'measured ranges at {shadow.ranges} of them; ')
            + 'latency '
            f'{np.median(driven.latencies) * 1e3:.0f} ms (p95 '
            f'{np.quantile(driven.latencies, 0.95) * 1e3:.0f})')


def _compare(outs: list[Path], folders: list[Path], latencies: list[list[float]], out: Path
             ) -> None:
    same = folders[0].name == folders[1].name
    one, other = (str(folder) if same else folder.name for folder in folders)
    found = compare(read_shadow(outs[0]), read_shadow(outs[1]), (one, other),
                    (latencies[0], latencies[1]))
    for name, text in (('comparison.json', as_json(found)), ('comparison.md', markdown(found))):
        try:
            write_file(out / name, text.encode())
        except OSError as error:
            raise UserError('the comparison can be written', f'{out / name}: {error.strerror}',
                            'free some space') from error
    _print(found)
    print(f'comparison {out / "comparison.json"} and {out / "comparison.md"}')


def _print(found) -> None:
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text
    console = Console()
    if not console.is_terminal:
        console.width = 200  # a file or a pipe has no width of its own
    table = Table(title=Text(f'{found.a} against {found.b}'), show_header=False)
    for name, value in figures(found):
        table.add_row(name, Text(value))
    headings, lines = confusion_table(found)
    choices = Table(title='choices', title_justify='left')
    for k, heading in enumerate(headings):
        choices.add_column(Text(heading), justify='left' if k == 0 else 'right')
    for line in lines:
        choices.add_row(*map(Text, line))
    console.print(table)
    console.print(choices)

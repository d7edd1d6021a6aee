"""How the commands of two policies differ that were shown the same drive, from their bags."""

from __future__ import annotations

import collections
import dataclasses
import itertools
import json
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from vn_msgs_py.motion import twist_to_array
from vn_nav.bags.storage.stream import messages
from vn_nav.errors import UserError

ARRIVED = 'arrived'
MAX_LISTED_DISAGREEMENTS = 5  # longest disagreements that are listed


class Answer(NamedTuple):
    """What a policy would have done at a picture."""

    time: int  # ns, of recording
    episode: int
    choice: str  # an action's name, or `ARRIVED`
    done: str | None  # what the robot did there; None: none of the policy's actions, or the end


@dataclasses.dataclass
class Shadow:
    """The second bag of a drive."""

    answers: list[Answer]
    commands: dict[int, np.ndarray]  # by time of recording [ns]: [4], the last of that time
    # Of the policy's action filter, as the node's last diagnostics had them: `decisions`, and at
    # how many it `acted` and `changed` the action; None: it has none, or an older node drove.
    filtered: dict[str, int] | None = None
    # Decisions whose map took measured ranges, by the same; None: they were not asked for.
    ranges: int | None = None

    @property
    def beside_the_drive(self) -> tuple[int, int]:
        """Answers that were what the robot did, and those where it did a known action."""
        known = [answer for answer in self.answers if answer.done is not None]
        return sum(answer.choice == answer.done for answer in known), len(known)


@dataclasses.dataclass
class Disagreement:
    """Decisions in a row, within an episode, that differ."""

    episode: int
    begins: float  # s since the first decision
    ends: float
    decisions: int
    a: str  # what it would have done at the first of them
    b: str


@dataclasses.dataclass
class Comparison:
    """How B differs from A. Times are seconds since the first decision, of recording."""

    a: str
    b: str
    decisions: int  # that both made
    alone: dict[str, int]  # that only one made, because a run was ended
    agree: float  # share
    confusion: dict[str, dict[str, int]]  # of A's choices, and B's there
    drive: dict[str, float | None]  # share of answers that were what the robot did
    arrived: dict[str, list[float]]  # times of the statements, of each and of both
    commands: int  # that both gave
    mean_dv: float | None  # m/s
    mean_dw: float | None  # rad/s
    disagreements: int
    first: Disagreement | None
    longest: list[Disagreement]
    latency: dict[str, dict[str, float]]  # s, of each: median, p95
    filtered: dict[str, dict[str, int] | None]  # of each, see `Shadow`


def read_shadow(bag: str | Path) -> Shadow:
    """The answers and commands that `vn_nav bag drive` recorded.

    Raises:
        UserError: no readable bag, or none of that kind.
    """
    names: list[str] = []
    executed: dict[int, tuple[int, str | None]] = {}  # episode, and what was done before
    choices: dict[int, str] = {}
    commands: dict[int, np.ndarray] = {}
    filtered: dict[str, int] | None = None
    ranges: int | None = None
    episode = -1
    for record in messages(bag, [f'shadow/{name}' for name in (
            'action', 'action_names', 'arrived', 'cmd_vel', 'diagnostics', 'executed_action',
            'goal_image')]):
        time = record.log_time
        match record.topic.rpartition('/')[2]:
            case 'action_names':
                names = json.loads(record.message.data)
            case 'goal_image':
                episode += 1
            case 'executed_action':
                executed[time] = episode, json.loads(record.message.data)['action']
            case 'action':
                choices[time] = names[record.message.data]
            case 'arrived' if record.message.data:
                choices[time] = ARRIVED
            case 'diagnostics':
                said = _said(record.message)
                filtered = _filtered(said) or filtered
                ranges = int(said['ranges_used']) if 'ranges_used' in said else ranges
            case 'cmd_vel':
                commands[time] = twist_to_array(record.message)
    if not executed:
        raise UserError('a bag to compare is one that `vn_nav bag drive` has written', str(bag),
                        'give --checkpoint and --compare to that command')
    following = {one: executed[other][1] for one, other in itertools.pairwise(executed)
                 if executed[one][0] == executed[other][0]}
    answers = [Answer(time, own, choices[time], following.get(time))
               for time, (own, _) in executed.items() if time in choices]
    return Shadow(answers, commands, filtered, ranges)


def _said(diagnostics) -> dict[str, str]:
    return {pair.key: pair.value for status in diagnostics.status for pair in status.values}


def _filtered(said: dict[str, str]) -> dict[str, int] | None:
    """The counts of the action filter, where a node says them."""
    names = 'decisions', 'acted', 'changed'
    if not all(said.get(f'filter_{name}', '').isdecimal() for name in names):
        return None
    return {name: int(said[f'filter_{name}']) for name in names}


def filter_words(counts: dict[str, int] | None) -> str:
    """A short summary of what an action filter did."""
    return 'none' if counts is None else (
        f'acted at {counts["acted"]} of {counts["decisions"]} decisions, changed '
        f'{counts["changed"]}')


def compare(a: Shadow, b: Shadow, labels: tuple[str, str],
            latencies: tuple[Sequence[float], Sequence[float]]) -> Comparison:
    """Compare two policies on one drive.

    Args:
        a, b: what they answered.
        labels: what to call them.
        latencies: of their decisions [s].

    Raises:
        UserError: they have no decision in common.
    """
    other = {answer.time: answer for answer in b.answers}
    pairs = [(answer, other[answer.time]) for answer in a.answers if answer.time in other]
    if not pairs:
        raise UserError('two drives to compare have decisions in common',
                        f'{len(a.answers)} and {len(b.answers)}, none at the same picture',
                        'drive along the same bag with both')
    start = pairs[0][0].time
    confusion: dict[str, collections.Counter] = collections.defaultdict(collections.Counter)
    for one, two in pairs:
        confusion[one.choice][two.choice] += 1
    both = sorted(a.commands.keys() & b.commands.keys())
    apart = np.abs([a.commands[time] - b.commands[time] for time in both]).reshape(-1, 4)
    runs = _disagreements(pairs, start)
    said = [[(answer.time - start) * 1e-9 for answer in answers if answer.choice == ARRIVED]
            for answers in ([p[0] for p in pairs], [p[1] for p in pairs])]
    return Comparison(
        *labels, decisions=len(pairs),
        alone={'a': len(a.answers) - len(pairs), 'b': len(b.answers) - len(pairs)},
        agree=sum(one.choice == two.choice for one, two in pairs) / len(pairs),
        confusion={choice: dict(row) for choice, row in sorted(confusion.items())},
        drive={'a': _share(a), 'b': _share(b)},
        arrived={'a': said[0], 'b': said[1], 'both': sorted(set(said[0]) & set(said[1]))},
        commands=len(both), mean_dv=_mean(np.hypot(*apart[:, :2].T)), mean_dw=_mean(apart[:, 2]),
        disagreements=len(runs), first=runs[0] if runs else None,
        longest=sorted(runs, key=lambda run: (-run.decisions, run.begins))[
            :MAX_LISTED_DISAGREEMENTS],
        latency={name: {'median': float(np.median(own)), 'p95': float(np.quantile(own, 0.95))}
                 for name, own in zip('ab', latencies, strict=True) if own},
        filtered={'a': a.filtered, 'b': b.filtered})


def _disagreements(pairs: list[tuple[Answer, Answer]], start: int) -> list[Disagreement]:
    runs: list[Disagreement] = []
    before: tuple[int, bool] | None = None  # episode of the pair before, and whether it differed
    for one, two in pairs:
        differs = one.choice != two.choice
        now = (one.time - start) * 1e-9
        if differs and before == (one.episode, True):
            runs[-1].ends, runs[-1].decisions = now, runs[-1].decisions + 1
        elif differs:
            runs.append(Disagreement(one.episode, now, now, 1, one.choice, two.choice))
        before = one.episode, differs
    return runs


def _share(shadow: Shadow) -> float | None:
    same, known = shadow.beside_the_drive
    return same / known if known else None


def _mean(values: np.ndarray) -> float | None:
    return float(values.mean()) if len(values) else None


def figures(found: Comparison) -> list[tuple[str, str]]:
    """Names and values of the table."""
    def number(value: float | None, unit: str) -> str:
        return 'no commands' if value is None else f'{value:.3f} {unit}'

    said = found.arrived
    rows = [
        ('decisions', f'{found.decisions}'),
        ('of them the same', f'{found.agree:.1%}'),
        ('as the drive', ', '.join(
            f'{label} ' + ('-' if found.drive[key] is None else f'{found.drive[key]:.1%}')
            for key, label in (('a', found.a), ('b', found.b)))),
        ('mean |dv|', f'{number(found.mean_dv, "m/s")} ({found.commands} commands)'),
        ('mean |dw|', number(found.mean_dw, 'rad/s')),
        ('arrived', f'{found.a} {len(said["a"])}, {found.b} {len(said["b"])}, '
                    f'both {len(said["both"])}'),
        ('latency', ', '.join(
            f'{label} {found.latency[key]["median"] * 1e3:.0f} ms (p95 '
            f'{found.latency[key]["p95"] * 1e3:.0f})'
            for key, label in (('a', found.a), ('b', found.b)) if key in found.latency)),
        *([] if not any(found.filtered.values()) else [('action filter', '; '.join(
            f'{label} {filter_words(found.filtered[key])}'
            for key, label in (('a', found.a), ('b', found.b))))]),
        ('disagreements', f'{found.disagreements} stretches')]
    if any(found.alone.values()):
        rows.insert(1, ('made by one alone', f'{found.a} {found.alone["a"]}, '
                                             f'{found.b} {found.alone["b"]}'))
    if found.first is not None:
        rows.append(('the first', _told(found.first)))
    rows += [('the longest' if k == 0 else '', _told(run)) for k, run in enumerate(found.longest)]
    return rows


def _told(run: Disagreement) -> str:
    when = f'{run.begins:.2f} s' if run.decisions == 1 else f'{run.begins:.2f} to {run.ends:.2f} s'
    more = '' if run.decisions == 1 else f' at the first of {run.decisions} decisions'
    return f'at {when} (episode {run.episode}): {run.a} against {run.b}{more}'


def confusion_table(found: Comparison) -> tuple[list[str], list[list[str]]]:
    """Headings and lines: A's choices, and how often B chose what there."""
    columns = sorted({choice for row in found.confusion.values() for choice in row})
    return ([f'{found.a} \\ {found.b}', *columns],
            [[choice, *(str(row.get(column, '')) for column in columns)]
             for choice, row in found.confusion.items()])


def markdown(found: Comparison) -> str:
    """Both tables."""
    headings, lines = confusion_table(found)
    rows = [['', f'{found.a} against {found.b}'], ['---', '---'], *figures(found), [],
            headings, ['---'] * len(headings), *lines]
    return '\n'.join('| ' + ' | '.join(str(cell).replace('|', '\\|') for cell in row) + ' |'
                     if row else '' for row in rows) + '\n'


def as_json(found: Comparison) -> str:
    """All of it; a figure that there is none of is null."""
    return json.dumps(dataclasses.asdict(found), indent=2) + '\n'

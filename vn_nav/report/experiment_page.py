"""What came out of an experiment: chart, table and page, from the runs that stay."""

from __future__ import annotations

import html
import json
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from vn_nav import __version__
from vn_nav.evaluation.evaluator import ARRIVAL, BLANK, RANDOM, SHORTEST, WRONG
from vn_nav.experiments.experiment import Experiment
from vn_nav.experiments.reproduction import EVALUATION
from vn_nav.files import write_file
from vn_nav.report import tables
from vn_nav.report.chart import to_picture, to_svg
from vn_nav.report.compare import WIDTH, chart
from vn_nav.report.curves import HOLD_SHARE, THRESHOLDS, Run, grouped, reached, read_runs
from vn_nav.report.page import page, table
from vn_nav.report.terminal import print_table

CONTROLS = (RANDOM, SHORTEST)  # in the chart; the same for all arms
OTHER_GOALS = (WRONG, BLANK)  # of an arm
# Figures of the measurements in the table: heading, key, format.
FIGURES = (('success', 'success', '.2f'), ('SPL', 'spl', '.2f'), ('decisions', 'decisions', '.0f'),
           ('return', 'return', '.2f'), ('collisions', 'collisions', '.1%'))
# What a column of metrics.csv is called in measurements, where that is another word.
MEASURED = {'length': 'decisions'}


def write_results(experiment: Experiment, size: str, folder: Path) -> dict[str, Any] | None:
    """Write `curves.png`, `figures.json`, `table.md` and `page.html` of the runs in a folder.

    Args:
        experiment: what was run.
        size: 'quick' or 'full'.
        folder: of the runs that stay, see `reproduction`; gets the files.

    Returns:
        What `figures.json` holds; None: no run has ended.
    """
    found = _measurements(experiment, folder)
    if not found:
        return None
    runs = read_runs([folder / own['run'] for own in found], experiment.metric,
                     [own['arm'] for own in found])
    groups = {arm: own for arm in experiment.arms if (own := grouped(runs).get(arm))}
    controls = _controls(found)
    key = MEASURED.get(experiment.metric, experiment.metric)
    levels = {name: controls[name][key] for name in CONTROLS
              if controls.get(name, {}).get(key) is not None}
    machines = sorted({own['machine'] for own in found})
    result: dict[str, Any] = {
        'experiment': experiment.name, 'size': size,
        'machines': machines,
        'dates': sorted({own['date'] for own in found}),
        'arms': {arm: _figures(experiment, own, [m for m in found if m['arm'] == arm])
                 for arm, own in groups.items()},
        'controls': {name: {key: own.get(key) for _, key, _ in FIGURES}
                     for name, own in controls.items()}}
    headings, lines = _cells(experiment, result)
    # Minutes of several machines do not make one axis.
    shapes, height = chart(groups, experiment.metric, levels=levels,
                           axes=('frames', 'minutes')[:1 if len(machines) > 1 else 2])
    image = cv2.cvtColor(to_picture(shapes, WIDTH, height), cv2.COLOR_RGB2BGR)
    markdown = tables.markdown([headings, ['---'] * len(headings), *lines])
    svg = to_svg(shapes, WIDTH, height, experiment.title)
    commands = '\n'.join(shlex.join(command) for own in found
                         for command in (own['command'], own.get('evaluate_command')) if command)
    body = f"""<h1>{html.escape(experiment.title)}</h1>
<p>{html.escape(experiment.question)}</p>
<p><b>The thesis:</b> {html.escape(experiment.claim)}</p>
<figure>{svg}</figure>
<p class="soft">{html.escape(experiment.metric)}: the trainer's mean over its last 200 episodes.
Lines are means over seeds, bands go from the least to the greatest, and both end where the
shortest of these runs ends. Dashed curves: inside the curriculum, whose episodes start nearer to
the goal. Lines with a name: measured controls.{_marks(experiment)}</p>
{table(headings, [[html.escape(cell) for cell in line] for line in lines])}
<p class="soft">Frames to a value: where the mean over the following tenth of the run holds it.
The other columns are measured after the training, {_starts(found)}, actions sampled; means over
seeds, in brackets the least and the greatest.</p>
<p class="soft">{html.escape(', '.join(result['machines']))}; {html.escape(' to '.join(
        dict.fromkeys((result['dates'][0], result['dates'][-1]))))}; vn_nav {__version__}</p>
<details><summary>Commands</summary><pre>{html.escape(commands)}</pre></details>"""
    for name, data in (('curves.png', cv2.imencode('.png', image)[1].tobytes()),
                       ('figures.json', (json.dumps(result, indent=1) + '\n').encode()),
                       ('table.md', (markdown + '\n').encode()),
                       ('page.html', page(experiment.title, body).encode())):
        write_file(folder / name, data)
    print_table(f'{experiment.name}, {size}', headings, lines)
    return result


def _marks(experiment: Experiment) -> str:
    """What the dashed lines of the chart are, in words."""
    return (f' Dashed lines: {" and ".join(f"{value:g}" for value in THRESHOLDS)}.'
            if experiment.metric == 'success' else '')


def _starts(found: Sequence[dict]) -> str:
    """Where the measured episodes start, in words."""
    taus = sorted({own.get('difficulty', 1.0) for own in found})
    return 'starts anywhere' if taus == [1.0] else (
        f'starts as near as in the training ({", ".join(f"tau {tau:g}" for tau in taus)})')


def _measurements(experiment: Experiment, folder: Path) -> list[dict]:
    """Those of the experiment's runs that have ended, in the order of its arms and seeds."""
    found = [json.loads(path.read_text()) | {'run': path.parent.name}
             for path in sorted(folder.glob(f'*/{EVALUATION}'))]
    arms = list(experiment.arms)
    return sorted((own for own in found if own['arm'] in arms),
                  key=lambda own: (arms.index(own['arm']), own['seed']))


def _rows(measurement: dict) -> dict[str, dict]:
    """Figures of a measurement by row: the policy sampled, greedy, the controls."""
    (split,) = measurement['splits'].values()
    return split['rows'][ARRIVAL]


def _controls(found: Sequence[dict]) -> dict[str, dict]:
    """The rows of the controls: of the first run that has them; other goals, of each arm's."""
    controls: dict[str, dict] = {}
    for own in found:
        rows = _rows(own)
        for name in CONTROLS:
            if name in rows:
                controls.setdefault(name, rows[name])
    several = len({own['arm'] for own in found}) > 1
    for own in found:
        rows = _rows(own)
        for name in OTHER_GOALS:
            if name in rows:
                controls.setdefault(f'{own["arm"]}: {name}' if several else name, rows[name])
    return controls


def _figures(experiment: Experiment, runs: Sequence[Run], measured: Sequence[dict]
             ) -> dict[str, Any]:
    """What is known of an arm; lists have an entry a seed."""
    own = [next(iter(_rows(m).values())) for m in measured]
    ends = [run.columns['frames'] >= (1 - HOLD_SHARE) * run.columns['frames'][-1] for run in runs]
    points = {f'{value:g}': [reached(run, value, experiment.metric, falls=experiment.falls,
                                     in_curriculum=experiment.in_curriculum) for run in runs]
              for value in experiment.reach}
    return {
        'seeds': [m['seed'] for m in measured],
        'frames': [float(run.columns['frames'][-1]) for run in runs],
        'minutes': [float(run.columns['minutes'][-1]) for run in runs],
        'reached': {value: [None if point is None else point[0] for point in found]
                    for value, found in points.items()},
        f'{experiment.metric}_at_the_end': [
            float(np.nanmean(run.columns[experiment.metric][end]))
            for run, end in zip(runs, ends, strict=True)],
        **{key: [row.get(key) for row in own] for _, key, _ in FIGURES}}


def _cells(experiment: Experiment, result: Mapping[str, Any]) -> tuple[list[str], list[list[str]]]:
    """Headings and lines of the table, plain text."""
    sign = 'at most' if experiment.falls else 'at least'
    # Where a simulator pays by its own rules there is no goal to get to.
    figures = [one for one in FIGURES
               if experiment.metric != 'return' or one[1] not in ('success', 'spl')]
    headings = ['', 'seeds', 'frames [k]', 'minutes',
                *(f'frames [k] to {experiment.metric} {sign} {value:g}'
                  for value in experiment.reach),
                f'{experiment.metric} at the end', *(heading for heading, *_ in figures)]
    lines = []
    for arm, own in result['arms'].items():
        line = [arm, str(len(own['seeds'])), spread([v / 1e3 for v in own['frames']], ',.0f'),
                spread(own['minutes'], '.0f')]
        line += [_when(points, own['frames']) for points in own['reached'].values()]
        line.append(spread(own[f'{experiment.metric}_at_the_end'], '.3g'))
        lines.append(line + [spread(own[key], form) for _, key, form in figures])
    for name, own in result['controls'].items():
        lines.append([name, *[''] * (4 + len(experiment.reach)),
                      *(spread([own[key]], form) for _, key, form in figures)])
    return headings, lines


def _when(points: Sequence[float | None], limits: Sequence[float]) -> str:
    """Thousands of frames to a value."""
    got = [point / 1e3 for point in points if point is not None]
    missed = [limit / 1e3 for point, limit in zip(points, limits, strict=True) if point is None]
    if not missed:
        return spread(got, ',.0f')
    never = f'not held by {(1 - HOLD_SHARE) * min(missed):,.0f}'  # later ones cannot hold
    if not got:
        return never
    return f'{", ".join(f"{point:,.0f}" for point in sorted(got))}; {len(missed)} {never}'


def spread(values: Sequence[float | None], form: str) -> str:
    """Mean, and in brackets the least and the greatest; -: not known of all."""
    known = [value for value in values if value is not None]
    if not known or len(known) < len(values):
        return '-'
    mean = f'{sum(known) / len(known):{form}}'
    low, high = f'{min(known):{form}}', f'{max(known):{form}}'
    return (mean if low == high else f'{mean} ({low}-{high})').replace('%', ' %')

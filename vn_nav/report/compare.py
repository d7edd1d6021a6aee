"""`vn_nav compare`: the learning curves of several runs, and when each reached which success."""

from __future__ import annotations

import html
import json
from collections.abc import Mapping, Sequence
from pathlib import Path

import cv2

from vn_nav import __version__
from vn_nav.errors import UserError
from vn_nav.files import write_file
from vn_nav.report.chart import Series, Shape, legend, panel, to_picture, to_svg
from vn_nav.report.curves import THRESHOLDS, Run, average, grouped, read_runs, summary
from vn_nav.report.page import CURVES, page, table
from vn_nav.report.terminal import print_table

WIDTH, PLOT = 1040, 330  # pixels: of the chart, and the height of its panels
PANELS = ((56.0, 500.0), (580.0, 1024.0))  # left and right
SHARES = ('success', 'collisions', 'tau', 'clipped')  # columns between 0 and 1
AXES = {'frames': 'frames (agent decisions)', 'minutes': 'wall-clock minutes'}


def compare(paths: Sequence[Path], out: Path, *, metric: str = 'success',
            labels: Sequence[str] | None = None, band: str = 'range', log: bool = False,
            json_file: Path | None = None) -> None:
    """Draw curves against frames and wall-clock, and print and write the table.

    Args:
        paths: of the runs, see `read_runs`.
        out: .html: page with chart and table; .svg or .png: the chart alone.
        metric: column on the y axis.
        labels: of the runs; equal ones are seeds of one curve.
        band: over seeds: 'range' or 'std'.
        log: logarithmic x axes.
        json_file: also write the table here.

    Raises:
        UserError: see `read_runs`; another kind of file; more curves than colours.
    """
    kind = out.suffix.lower()
    if kind not in ('.html', '.svg', '.png'):
        raise UserError('a comparison is written as .html, .svg or .png', str(out),
                        'give --out another ending')
    groups = grouped(read_runs(paths, metric, labels))
    if len(groups) > CURVES:
        raise UserError(f'a chart has at most {CURVES} curves', len(groups),
                        'compare fewer at a time, or give seeds of one thing one label')
    result = summary(groups)
    shapes, height = chart(groups, metric, band, log)
    if kind == '.png':
        picture = cv2.cvtColor(to_picture(shapes, WIDTH, height), cv2.COLOR_RGB2BGR)
        write_file(out, cv2.imencode('.png', picture)[1].tobytes())
    elif kind == '.svg':
        write_file(out, to_svg(shapes, WIDTH, height, f'{metric} of runs', alone=True).encode())
    else:
        svg = to_svg(shapes, WIDTH, height, f'{metric} of runs')
        write_file(out, _page(svg, groups, result, metric, band).encode())
    if json_file:
        write_file(json_file, json.dumps(result, indent=2).encode())
    _print(result, out)


def chart(groups: dict[str, list[Run]], metric: str, band: str = 'range', log: bool = False,
          levels: Mapping[str, float] | None = None, axes: Sequence[str] = tuple(AXES)
          ) -> tuple[list[Shape], float]:
    """Curves against frames and wall-clock, and the height of the chart [pixels]; `WIDTH` wide.

    Args:
        groups: runs by label.
        metric, band, log: see `compare`.
        levels: names and values of horizontal lines.
        axes: both, or one of them across the whole chart.
    """
    levels = levels or {}
    names = [(f'{label} ({len(runs)} run{"s" * (len(runs) > 1)})', f'c{k}')
             for k, (label, runs) in enumerate(groups.items())]
    shapes, used = legend(names, PANELS[0][0], 12, WIDTH - 16)
    top = 12 + used + 22
    curves = {axis: [average(runs, axis, metric, band=band, log=log) for runs in groups.values()]
              for axis in axes}
    if metric in SHARES:
        y_range = 0.0, 1.0
    else:
        low = min(*(curve.low.min() for own in curves.values() for curve in own),
                  *levels.values())
        high = max(*(curve.high.max() for own in curves.values() for curve in own),
                   *levels.values())
        edge = 0.05 * (high - low) or 1.0
        y_range = low - edge, high + edge
    boxes = PANELS if len(axes) > 1 else ((PANELS[0][0], PANELS[-1][1]),)
    for (axis, own), (left, right) in zip(curves.items(), boxes, strict=True):
        series = [Series(name, colour, c.x, c.mean, c.low, c.high, c.full)
                  for (name, colour), c in zip(names, own, strict=True)]
        shapes += panel((left, top, right, top + PLOT), series,
                        title=f'{metric} over {AXES[axis]}', y_range=y_range, log=log,
                        marks=THRESHOLDS if metric == 'success' else (), levels=levels)
    return shapes, top + PLOT + 56


def cells(result: dict[str, dict]) -> tuple[list[str], list[list[str]]]:
    """Headings and lines of the table, plain text; `result` as of `curves.summary`."""
    headings = ['curve', 'runs']
    for threshold in THRESHOLDS:
        headings += [f'frames to {threshold:.0%} [k]', f'minutes to {threshold:.0%}']
    lines = []
    for label, own in result.items():
        line = [label, str(len(own['runs']))]
        for point in own['reached'].values():
            line += [_when(point['frames'], own['frames'], ',.0f', 1e-3),
                     _when(point['minutes'], own['minutes'], '.1f')]
        lines.append([*line, _ends(own)])
    return [*headings, 'success at the end'], lines


def _when(points: list[float | None], limits: list[float], form: str, unit: float = 1.0) -> str:
    """When runs reached something, or for how long they did not."""
    got = sorted(unit * point for point in points if point is not None)
    missed = [unit * limit for point, limit in zip(points, limits, strict=True) if point is None]
    if not missed:
        return _spread(got, form)
    never = f'not reached within {min(missed):{form}}'
    if not got:
        return never
    return f'{", ".join(f"{p:{form}}" for p in got)}; {len(missed)} of {len(points)} {never}'


def _spread(values: list[float], form: str) -> str:
    mean = f'{sum(values) / len(values):{form}}'
    if len(values) == 1:
        return mean
    return f'{mean} ({min(values):{form}}-{max(values):{form}})'


def _ends(own: dict) -> str:
    known = [value for value in own['success'] if value is not None]
    if len(known) < len(own['success']):
        return 'unknown: no episode ended'
    within = f', at tau {min(own["tau"]):.2f}' if min(own['tau']) < 1 else ''
    return _spread(known, '.2f') + within


def _page(svg: str, groups: dict[str, list[Run]], result: dict, metric: str, band: str) -> str:
    headings, lines = cells(result)
    curves = table(headings, [[html.escape(cell) for cell in line] for line in lines])
    runs = table(['curve', 'run', 'frames', 'minutes'],
                 [[html.escape(label), html.escape(str(run.path)),
                   f'{run.columns["frames"][-1]:,.0f}', f'{run.columns["minutes"][-1]:.1f}']
                  for label, own in groups.items() for run in own], text=2)
    bands = {'range': 'from the smallest to the largest',
             'std': 'one standard deviation each way'}[band]
    return page('vn_nav compare', f"""<h1>Learning curves: {html.escape(metric)}</h1>
<p class="soft">Lines are means over runs that differ in their seed, bands go {bands}; both end
where the shortest of these runs ends. Dashed: inside the curriculum, whose episodes start nearer
to the goal, so that no success there counts.</p>
<figure>{svg}</figure>
<h2>When success was reached</h2>
<p class="soft">At tau = 1 only: starts as in the evaluation. Frames in thousands. Success is the
trainer's mean over its last 200 episodes; a value counts when the mean over the following tenth of
the run holds it, since the episodes that end first flatter. Means over runs, in brackets the
range. The last column is the mean over the last tenth of the run.</p>
{curves}
<h2>Runs</h2>{runs}
<p class="soft">vn_nav {__version__}</p>""")


def _print(result: dict, out: Path) -> None:
    print_table('Success at tau = 1', *cells(result))
    print(out)

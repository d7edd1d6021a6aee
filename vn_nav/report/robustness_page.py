"""What a policy bears, factor by factor: a page of charts, the charts as a picture, a table."""

from __future__ import annotations

import html

import cv2
import numpy as np

from vn_nav import __version__
from vn_nav.evaluation.evaluator import DECLARED
from vn_nav.evaluation.robustness import HELD, Measured, Robustness, change, held
from vn_nav.report import tables
from vn_nav.report.chart import Series, Shape, Text, legend, panel, to_picture, to_svg
from vn_nav.report.page import page, table
from vn_nav.report.tables import TITLES, number

WIDTH, HEIGHT = 560.0, 330.0  # of a chart [pixels]
COLUMNS = 2  # of charts in the picture
STROKE = 0.1  # half the width of a level that stands apart, in steps of the axis
# Curves: figure, name, colour.
SUCCESS, FALSE_STOPS, COLLISIONS = (
    ('success', 'success', 'c2'), ('false_stops', 'false stops', 'c1'),
    ('collisions', 'collisions', 'c0'))


def robustness_page(found: Robustness, *, name: str, place: str) -> str:
    """The page, with what is measured so far.

    Args:
        found: the curves.
        name: of the checkpoint.
        place: where it was measured, for people.
    """
    sections = ''.join(
        f'<h2>{html.escape(found.factors[factor].title)}</h2>'
        f'<p>{html.escape(verdict(found, factor))}</p>'
        f'<figure>{_svg(found, factor)}</figure>'
        f'<p class="soft">{html.escape(found.factors[factor].about)}</p>{_table(found, factor)}'
        for factor, own in found.curves.items() if own)
    refused = ''.join(f'<li>{html.escape(line)}</li>' for line in found.refused)
    refused = f'<h2>Not measured</h2><ul>{refused}</ul>' if refused else ''
    episodes = '' if found.usual is None else f', {found.usual.figures["episodes"]} episodes each'
    return page(f'{name}: robustness', f"""<h1>{html.escape(name)}: robustness</h1>
<p class="soft">{html.escape(place)}{episodes}. {html.escape(TITLES[found.stop])}. vn_nav
{__version__}.</p>
<p>One factor is changed at a time, everything else is as in the training (*). Every level has the
same episodes: houses, starts, goals and random numbers. Bands are 95 % intervals of the success;
<em>change</em> is the difference from the usual, with the paired 95 % interval. A level is called
held where no more than {HELD:.2f} of the success is lost. False stops are a share of the episodes,
collisions of the decisions.</p>
{sections}{refused}""")


def robustness_png(found: Robustness) -> bytes:
    """All charts side by side, as PNG."""
    known = [factor for factor, own in found.curves.items() if own]
    shapes: list[Shape] = []
    for k, factor in enumerate(known):
        shapes += _chart(found, factor, WIDTH * (k % COLUMNS), HEIGHT * (k // COLUMNS))
    drawn = to_picture(shapes, WIDTH * min(COLUMNS, len(known) or 1),
                       HEIGHT * max(-(-len(known) // COLUMNS), 1))
    return cv2.imencode('.png', cv2.cvtColor(drawn, cv2.COLOR_RGB2BGR))[1].tobytes()


def markdown(found: Robustness) -> str:
    """All levels as a Markdown table, ready for docs/results.md."""
    lines = [['factor', *_headings(found)]]
    lines.append(['---'] * len(lines[0]))
    for factor, own in found.curves.items():
        lines += [[found.factors[factor].title if k == 0 else '', *_cells(found, measured)]
                  for k, measured in enumerate(own)]
    return tables.markdown(lines)


def verdict(found: Robustness, factor: str) -> str:
    """Which levels of a factor are held, in a sentence or two."""
    usual = found.usual
    assert usual is not None  # it is measured first
    others = [measured for measured in found.curves[factor] if not measured.step.usual]
    if not others:
        return 'Nothing but the usual is measured.'
    good = [measured for measured in others if held(measured, usual)]
    bad = [measured for measured in others if not held(measured, usual)]
    lead = f'Success is {usual.figures["success"]:.2f} as usual'
    parts = []
    if good:
        parts.append('held at ' + ', '.join(map(_with_success, good)))
    if bad:
        parts.append('lost at ' + ', '.join(map(_with_success, bad)))
    return f'{lead}; {"; ".join(parts)} ({found.factors[factor].unit}).'


def _with_success(measured: Measured) -> str:
    return f'{measured.step.label} ({measured.figures["success"]:.2f})'


def _headings(found: Robustness) -> list[str]:
    false = ['false stops'] if found.stop == DECLARED else []
    return ['level', 'success (95 %)', 'change (paired)', 'SPL', *false, 'collisions', 'decisions']


def _cells(found: Robustness, measured: Measured) -> list[str]:
    assert found.usual is not None
    own = measured.figures
    low, high = own['success_interval']
    mean, least, most = change(measured, found.usual)
    return [_label(measured), f'{own["success"]:.2f} ({low:.2f}-{high:.2f})',
            '' if measured.step.usual else f'{mean:+.2f} ({least:+.2f} to {most:+.2f})',
            number(own['spl'], '.2f'),
            *([f'{own["false_stops"]:.2f}'] if found.stop == DECLARED else []),
            f'{own["collisions"]:.1%}'.replace('%', ' %'), f'{own["decisions"]:.0f}']


def _label(measured: Measured) -> str:
    return measured.step.label + ('*' if measured.step.usual else '')


def _table(found: Robustness, factor: str) -> str:
    return table(_headings(found), [[html.escape(cell) for cell in _cells(found, measured)]
                                    for measured in found.curves[factor]])


def _svg(found: Robustness, factor: str) -> str:
    return to_svg(_chart(found, factor, 0.0, 0.0), WIDTH, HEIGHT,
                  f'success against {found.factors[factor].title.lower()}')


def _chart(found: Robustness, factor: str, left: float, top: float) -> list[Shape]:
    """The chart of a factor, with its corner there [pixels]."""
    own, about = found.curves[factor], found.factors[factor]
    curves = [SUCCESS, *([FALSE_STOPS] if found.stop == DECLARED else []), COLLISIONS]
    names, tall = legend([(name, colour) for _, name, colour in curves], left + 200, top + 12,
                         left + WIDTH)
    series = [part for curve in curves for part in _series(found, factor, *curve)]
    return [Text(left + 16, top + 27, about.title, 'start', 'ink', 16), *names,
            *panel((left + 56, top + tall + 24, left + WIDTH - 20, top + HEIGHT - 56), series,
                   title=f'{about.unit} (* usual)', y_range=(0.0, 1.0), log=False,
                   labels=[_label(measured) for measured in own])]


def _series(found: Robustness, factor: str, figure: str, name: str, colour: str
            ) -> list[Series]:
    """The curve along the scale, and a stroke for each level that stands apart from it."""
    own = found.curves[factor]
    along = {step.name for step in found.factors[factor].steps[
        :len(found.factors[factor].steps) - found.factors[factor].apart]}
    points = [(float(x), x, measured) for x, measured in enumerate(own)
              if measured.step.name in along]
    runs = [points] if points else []
    runs += [[(x - STROKE, x, measured), (x + STROKE, x, measured)]
             for x, measured in enumerate(own) if measured.step.name not in along]
    found_series = []
    for run in runs:
        values = np.array([measured.figures[figure] for *_, measured in run])
        low, high = values, values
        if figure == 'success':
            low, high = np.array([measured.figures['success_interval'] for *_, measured in run]).T
        found_series.append(Series(name, colour, np.array([x for x, *_ in run]), values, low, high,
                                   np.ones(len(run), bool)))
    return found_series

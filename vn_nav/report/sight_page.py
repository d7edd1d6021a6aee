"""One self-contained HTML page on how the networks of `search` see: ROC, calibration, errors."""

from __future__ import annotations

import html
import math
from collections.abc import Sequence

import numpy as np

from vn_nav import __version__
from vn_nav.arrival import ARRIVAL_HEADING, ARRIVAL_RADIUS
from vn_nav.learning.sight_figures import (
    HALF_RADIUS,
    Judged,
    auc,
    calibration,
    calibration_error,
    figures,
    in_band,
    roc,
)
from vn_nav.report.chart import Series, Shape, legend, panel, to_svg
from vn_nav.report.page import cards, page, table

BANDS = ((0.1, 0.25), (0.25, 0.5), (0.5, 0.75), (0.75, 1.01))  # shares of the goal picture
DISTANCES = (0.0, 0.6, 1.5, 3.0, 6.0)  # m
THRESHOLDS = (0.3, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95)
FALSE_RATES = (0.01, 0.02, 0.05, 0.1)
WIDTH, HEIGHT = 520.0, 420.0  # of a chart [pixels]
DEFINITIONS = f"""<h2>Definitions</h2><dl>
<dt>In view</dt><dd>The picture shows at least a tenth of what the goal picture shows.</dd>
<dt>Arrived</dt><dd>Within {ARRIVAL_RADIUS:g} m (driving distance) and
{math.degrees(ARRIVAL_HEADING):g} degrees of where the goal picture was taken.</dd>
<dt>Hard ring</dt><dd>Pairs that are nearly there: 0.6 to 1.5 m away and turned by no more than 45
degrees, or within 0.6 m but turned by 30 to 60 degrees.</dd>
<dt>By the pose alone</dt><dd>The probability of arrival that follows from co-visibility and from
the distributions of position and heading.</dd>
<dt>Calibration</dt><dd>Of all pairs that are given a probability of about p a share of p should be
so. The error is the mean gap.</dd>
<dt>Half circle</dt><dd>Share of the goals that stand within the circle which, as the network says,
holds half of them: 50 % would be right, less is too sure.</dd>
<dt>Range</dt><dd>To the first obstacle along a bearing; the error is relative, of the median of
what is said.</dd></dl>"""


def sight_page(rows: Sequence[dict], judged: Judged, *, name: str, places: str) -> str:
    """The page.

    Args:
        rows: metrics of the training; the first is of the network before it.
        judged: what was said of pairs that nobody learned from.
        name: of the run.
        places: where the pairs are from, for people.
    """
    found, known = figures(judged), judged.overlap >= 0
    some = judged.there | judged.ring
    curves = [('in view', judged.co_visible[known], judged.sees[known]),
              ('arrived', judged.arrived, judged.there),
              ('arrived, against the hard ring alone', judged.arrived[some], judged.there[some]),
              ('the same, by the pose alone', judged.arrived_by_pose[some], judged.there[some])]
    trained = rows[-1]
    body = f"""<h1>{html.escape(name)}: what it sees</h1>
<p class="soft">{len(judged.overlap):,} picture pairs of {html.escape(places)}, learned from by
nobody: {judged.sees.mean():.0%} in view, {judged.there.mean():.0%} arrived,
{judged.ring.mean():.0%} in the hard ring. Trained on {trained["frames"]:,} pairs in
{trained["minutes"]:.0f} minutes. vn_nav {__version__}.</p>
{cards([(f'{found["co_visible_auc"]:.3f}', 'in view', 'area under the ROC'),
        (f'{found["arrived_auc"]:.3f}', 'arrived', 'area under the ROC'),
        (f'{found["arrived_ring_auc"]:.3f}', 'arrived', 'against the hard ring alone'),
        (f'{found["bearing_deg"]:.0f} deg', 'bearing', 'median error, in view'),
        (f'{found["range_error"]:.1%}', 'range', 'median error')])}
<h2>In view? Arrived?</h2>
<figure>{_roc_chart(curves)}</figure>
{_rates(curves)}
<h2>Are the probabilities true?</h2>
<figure>{_calibration_chart(curves[:2])}</figure>
{_thresholds(judged)}
<h2>Where is the goal?</h2>
{_errors(judged)}
<h2>How far is the place free?</h2>
{_range_table(judged)}
<h2>While learning</h2>
<figure>{_learning_chart(rows)}</figure>
{DEFINITIONS}"""
    return page(f'{name}: what it sees', body)


def _chart(series: Sequence[Series], title: str, label: str) -> str:
    shapes: list[Shape] = []
    names, tall = legend([(own.name, own.colour) for own in series if own.name], 60, 8, WIDTH - 10)
    shapes += names
    shapes += panel((60, tall + 20, WIDTH - 20, HEIGHT - 56), series, title=title,
                    y_range=(0.0, 1.0), log=False)
    return to_svg(shapes, WIDTH, HEIGHT, label)


def _curve(name: str, colour: str, x: np.ndarray, y: np.ndarray, full: bool = True) -> Series:
    return Series(name, colour, x, y, y, y, np.full(len(x), full))


def _roc_chart(curves) -> str:
    series = []
    for k, (name, score, true) in enumerate(curves):
        if len(score):
            false_rate, true_rate, _ = roc(score, true)
            at = np.unique(np.linspace(0, len(false_rate) - 1, 300).astype(int))
            series.append(_curve(name, f'c{k}', false_rate[at], true_rate[at]))
    ends = np.array([0.0, 1.0])
    return _chart([*series, _curve('by chance', 'c7', ends, ends, False)],
                  'share of the negatives that are called positive (y: of the positives)',
                  'ROC of in view and arrived')


def _calibration_chart(curves) -> str:
    series = []
    for k, (name, score, true) in enumerate(curves):
        if len(score):
            said, held, _ = calibration(score, true)
            series.append(_curve(f'{name} (error {calibration_error(score, true):.3f})', f'c{k}',
                                 said, held))
    ends = np.array([0.0, 1.0])
    return _chart([*series, _curve('true', 'c7', ends, ends, False)],
                  'probability that is said (y: share that is so)',
                  'calibration of in view and arrived')


def _learning_chart(rows: Sequence[dict]) -> str:
    names = {'co_visible_auc': 'AUC in view', 'arrived_auc': 'AUC arrived',
             'arrived_ring_auc': 'AUC arrived, in the ring',
             'range_within_fifth': 'ranges within a fifth'}
    minutes = np.array([row['minutes'] for row in rows])
    minutes = minutes if minutes[-1] > 0 else minutes + np.arange(len(rows))
    return _chart([_curve(name, f'c{k}', minutes,
                          np.nan_to_num(np.array([row[f'validation_{key}'] for row in rows])))
                   for k, (key, name) in enumerate(names.items())],
                  'minutes', 'figures over the training')


def _rates(curves) -> str:
    """Share of positives found at some false positive rates."""
    lines = []
    for name, score, true in curves:
        if len(score) and true.any():
            false_rate, true_rate, _ = roc(score, true)
            found = [true_rate[np.searchsorted(false_rate, rate, side='right') - 1]
                     for rate in FALSE_RATES]
            lines.append([name, f'{auc(score, true):.3f}', *(f'{value:.0%}' for value in found)])
    return table(['Found at', 'area under the ROC',
                  *(f'{rate:.0%} false' for rate in FALSE_RATES)], lines)


def _thresholds(judged: Judged) -> str:
    """What is called at thresholds, by how much of the goal is in view, or how near the robot."""
    kinds = [*((f'{low:.0%} to {min(high, 1):.0%} in view', 'co_visible',
                in_band(judged.overlap, (low, high))) for low, high in BANDS),
             ('not in view', 'co_visible', (judged.overlap >= 0) & ~judged.sees),
             ('arrived', 'arrived', judged.there), ('in the hard ring', 'arrived', judged.ring),
             ('neither', 'arrived', ~judged.there & ~judged.ring)]
    lines = [[f'{name}', 'in view' if asked == 'co_visible' else 'arrived', f'{own.sum():,}',
              *(_share(getattr(judged, asked)[own] > least) for least in THRESHOLDS)]
             for name, asked, own in kinds]
    return table(['Share that is called', 'as', 'pairs',
                  *(f'above {least:g}' for least in THRESHOLDS)], lines, text=2)


def _errors(judged: Judged) -> str:
    """Errors of the pose by overlap, and by distance where in view."""
    lines = []
    kinds = [*((f'{low:.0%} to {min(high, 1):.0%} in view', in_band(judged.overlap, (low, high)))
               for low, high in BANDS),
             *((f'{near:g} to {far:g} m away', judged.sees & in_band(judged.distance, (near, far)))
               for near, far in zip(DISTANCES, DISTANCES[1:], strict=False))]
    for name, own in kinds:
        far = own & (judged.distance > 0.3)
        if not own.any():
            continue
        lines.append([
            name, f'{own.sum():,}',
            f'{np.median(judged.distance[own]):.2f}',
            *(f'{np.percentile(judged.position_error[own], share):.2f}' for share in (50, 80)),
            f'{math.degrees(np.median(judged.bearing_error[far])):.0f}' if far.any() else '',
            *(f'{math.degrees(np.percentile(judged.heading_error[own], share)):.0f}'
              for share in (50, 80)),
            _share(judged.position_error[own] <= HALF_RADIUS * judged.position_scale[own])])
    return table(['', 'pairs', 'distance m (median)', 'position m (median)', '(80 %)',
                  'bearing deg (median)', 'heading deg (median)', '(80 %)', 'half circle'], lines)


def _range_table(judged: Judged) -> str:
    """Errors of the ranges, all columns and those at the edges of the picture."""
    columns = judged.range_ratio.shape[1]
    edge = np.r_[:columns // 8, columns - columns // 8:columns]
    lines = []
    for name, ratio in (('all bearings', judged.range_ratio),
                        ('outermost quarter', judged.range_ratio[:, edge])):
        ratio = ratio[np.isfinite(ratio)]
        off = np.abs(ratio - 1)
        lines.append([name, f'{np.median(off):.1%}', _share(off <= 0.2), _share(off <= 0.1),
                      _share(ratio > 1.2), _share(ratio < 0.8)] if len(off) else [name] + [''] * 5)
    return table(['', 'error (median)', 'within a fifth', 'within a tenth', 'too far by a fifth',
                  'too near by a fifth'], lines)


def _share(values: np.ndarray) -> str:
    return f'{values.mean():.0%}' if len(values) else ''

"""The charts of `vn_nav bag show`: map of the path, actions, velocities, rates."""

from __future__ import annotations

import html
import math

import numpy as np

from vn_nav.bags.poses import COMMAND_TIMEOUT_S
from vn_nav.bags.report.figures import Shot, Timeline
from vn_nav.bags.report.show import AXES, Shown
from vn_nav.bags.segmenter import ACTION_LENGTH_TOLERANCE
from vn_nav.report.chart import Line, Series, Shape, Text, legend, panel, ticks, to_svg
from vn_nav.report.page import CURVES

MAP_SIZE_PX = 620, 470  # pixels
MAP_MARGIN_M = 0.4  # m around the path, and the least it is drawn wide
MIN_SPEED_M_RAD_PER_S = 0.02  # m/s or rad/s: below that an axis is not drawn
AXIS_LABELS = {'vx': 'forward [m/s]', 'vy': 'left [m/s]', 'wz': 'turning left [rad/s]'}


def path_map(shown: Shown) -> str:
    """The path from above, with the places of the film strip's pictures."""
    ways = [way for way in shown.ways.values() if len(way)]
    if not ways:
        return '<p>Nothing: no picture has a pose.</p>'
    points = np.concatenate(ways)[:, :2]
    width, height = MAP_SIZE_PX
    low, high = points.min(0) - MAP_MARGIN_M, points.max(0) + MAP_MARGIN_M
    scale = min((width - 20) / (high[0] - low[0]), (height - 50) / (high[1] - low[1]))
    corner = np.array([width - scale * (high[0] + low[0]),
                       height - 20 + scale * (high[1] + low[1])]) / 2

    def place(points: np.ndarray) -> np.ndarray:
        return corner + np.asarray(points)[..., :2] * (scale, -scale)

    unit = _unit(max(high - low))
    beyond = (np.array(MAP_SIZE_PX) / scale - (high - low)) / 2
    shapes: list[Shape] = _grid(place, low - beyond, high + beyond, unit)
    for episode, way in shown.ways.items():
        colour = f'c{episode % CURVES}'
        shapes += [Line(place(way), colour, 2.4, opacity=0.85), _disc(place(way[0]), 12, colour),
                   _ring(place(way[-1]), 13, colour)]
    for k, shot in enumerate(shown.film):
        shapes += _mark(place(shot.pose), shot, str(k + 1))
    base = height - 10
    shapes += [Line(np.array([[14, base], [14 + unit * scale, base]]), 'ink', 2),
               Text(20 + unit * scale, base + 4, f'{unit:g} m', 'start', 'ink')]
    by = ('by odometry' if shown.topics.odometry else 'by the commands alone, which drift: there '
          'is no odometry')
    colours = (f'one colour per episode (again after {CURVES})' if shown.report.episodes > CURVES
               else 'one colour per episode' if shown.report.episodes > 1 else '')
    return f"""<figure>{to_svg(shapes, width, height, 'map of the path')}<figcaption>The path
{by}{", " * bool(colours)}{colours}. Dot: start; ring: end; numbers: pictures of the film strip,
with the direction the robot faced.</figcaption></figure>"""


def _grid(place, low: np.ndarray, high: np.ndarray, unit: float) -> list[Shape]:
    lines: list[Shape] = []
    for axis in (0, 1):
        for value in np.arange(math.ceil(low[axis] / unit), math.floor(high[axis] / unit) + 1):
            ends = np.array([low, high])
            ends[:, axis] = value * unit
            lines.append(Line(place(ends), 'line'))
    return lines


def _unit(span: float) -> float:
    """A round length [m], of which about six fit."""
    marks = ticks(0.0, span, 6)
    return marks[1] - marks[0]


def _mark(at: np.ndarray, shot: Shot, label: str) -> list[Shape]:
    """A number where a picture was taken, with a nose in its direction."""
    ahead = np.array([math.cos(shot.pose[2]), -math.sin(shot.pose[2])])
    side = np.array([-ahead[1], ahead[0]])
    nose = np.array([at + 16 * ahead, at + 6 * side + 6 * ahead, at - 6 * side + 6 * ahead])
    return [Line(nose, 'ink', filled=True), _disc(at, 9, 'ink'),
            Text(at[0], at[1] + 4, label, 'middle', 'card', 11)]


def _disc(at: np.ndarray, radius: float, colour: str) -> Line:
    return Line(_round(at, radius), colour, filled=True)


def _ring(at: np.ndarray, radius: float, colour: str) -> Line:
    return Line(_round(at, radius), colour, 2.4)


def _round(at: np.ndarray, radius: float) -> np.ndarray:
    angles = np.linspace(0, 2 * math.pi, 25)
    return at + radius * np.stack([np.cos(angles), np.sin(angles)], 1)


def action_bars(shown: Shown) -> str:
    """How often the drive holds each action of the robot, and how much fits none."""
    report = shown.report
    rows = [(name, report.actions[k], 'c0') for k, name in enumerate(shown.robot.action_names)
            if np.any(shown.robot.moves[k])]
    rows.append(('fits none', report.misfits, 'bad'))
    largest, total = max(count for _, count, _ in rows) or 1, sum(count for _, count, _ in rows)
    width, height, left, right = 420, 16 + 34 * len(rows), 112, 326
    shapes: list[Shape] = []
    for k, (name, count, colour) in enumerate(rows):
        y = 12 + 34 * k
        end = left + (right - left) * count / largest
        shapes += [Text(left - 10, y + 16, name.replace('_', ' '), 'end', 'ink', 13),
                   Line(np.array([[left, y], [end, y], [end, y + 22], [left, y + 22]]), colour,
                        filled=True),
                   Text(end + 6, y + 16, f'{count:,} ({count / max(total, 1):.0%})')]
    return f"""<figure>{to_svg(shapes, width, height, 'actions')}<figcaption>The drive, cut into
the actions of the robot {html.escape(shown.robot.name)}. An action counts if its length is right
to {ACTION_LENGTH_TOLERANCE:.0%} and there is little motion along other axes; the rest
matches no action.</figcaption></figure>"""


def velocity_chart(velocities: Timeline, moved: float) -> str:
    """Commanded and measured velocities over time.

    Args:
        velocities: by kind and axis.
        moved: how far the poses of the odometry moved [m or rad].
    """
    curves = {f'{kind} {axis}': velocities.values(f'{kind} {axis}')
              for kind in ('commanded', 'measured') for axis in AXES}
    known = {name: np.isfinite(values[:, 0]).any() for name, (_, values) in curves.items()}
    kinds = [kind for kind in ('commanded', 'measured') if known[f'{kind} vx']]
    if not kinds:
        return '<p>Neither commands nor odometry were recorded.</p>'
    reach = {axis: _reach([curves[f'{kind} {axis}'][1] for kind in kinds]) for axis in AXES}
    axes = [axis for axis in AXES
            if axis != 'vy' or max(map(abs, reach['vy'])) > MIN_SPEED_M_RAD_PER_S]
    width, height = 1100, 150
    shapes, top = legend([(kind, _kind_colour(kind)) for kind in kinds], 62, 4, width)
    top += 24
    for number, axis in enumerate(axes):
        series = [_series(kind, *curves[f'{kind} {axis}'], velocities.width) for kind in kinds]
        last = number == len(axes) - 1
        shapes += panel((62, top, width - 16, top + height), series, log=False, marks=(0.0,),
                        title='seconds since the recording began' if last else '',
                        y_range=reach[axis])
        shapes.append(Text(62, top - 7, AXIS_LABELS[axis], 'start', 'ink', 13))
        top += height + (52 if last else 48)
    silent = 'measured' in kinds and moved > MIN_SPEED_M_RAD_PER_S and not any(
        np.nanmax(np.abs(curves[f'measured {axis}'][1])) > 0 for axis in AXES)
    still = ' The odometry reports no velocities, though its poses move.' if silent else ''
    return f"""<figure>{to_svg(shapes, width, top, 'velocities over time')}<figcaption>Means over
{velocities.width:g} s, with the lowest and highest value in between. Without a command for
{COMMAND_TIMEOUT_S:g} s nothing is commanded.{still}</figcaption></figure>"""


def _reach(values: list[np.ndarray]) -> tuple[float, float]:
    """The range [m/s or rad/s] that shows all values, and zero."""
    low = min(0.0, *(float(np.nanmin(v)) for v in values))
    high = max(0.0, *(float(np.nanmax(v)) for v in values))
    room = max(0.08 * (high - low), MIN_SPEED_M_RAD_PER_S)
    return (low - room if low < 0 else low), high + room


def _kind_colour(kind: str) -> str:
    return {'commanded': 'c1', 'measured': 'c0'}[kind]


def _series(kind: str, times: np.ndarray, values: np.ndarray, width: float) -> Series:
    """A curve; a base holds a command for a while and then stops."""
    values = values.copy()
    known = np.isfinite(values[:, 0])
    if kind == 'commanded':
        since = math.inf
        for k in range(len(values)):
            since = 0.0 if known[k] else since + width
            if not known[k]:
                values[k] = values[k - 1] if since <= COMMAND_TIMEOUT_S else 0.0
    else:
        times, values = times[known], values[known]
    return Series(kind, _kind_colour(kind), times, values[:, 0], values[:, 1], values[:, 2],
                  np.ones(len(times), bool))


def rate_chart(times: np.ndarray, rate: np.ndarray, name: str) -> str:
    """Messages a second [K] of a topic over time [K], small."""
    width, height = 240, 26
    half = times[0]
    x = np.stack([times - half, times + half], 1).ravel() / (times[-1] + half) * width
    y = height - 1 - np.repeat(rate, 2) / max(rate.max(), 1e-9) * (height - 4)
    outline = np.concatenate([[[0, height - 1]], np.stack([x, y], 1), [[width, height - 1]]])
    return to_svg([Line(outline, 'c0', opacity=0.25, filled=True), Line(outline, 'c0', 1.2)],
                  width, height, f'rate of {name} over time')

"""Floor plans with journeys, as SVG."""

from __future__ import annotations

import dataclasses
import html
import math
from collections.abc import Sequence

import numpy as np

PIXELS_PER_M = 46  # pixels per metre
MARGIN_M = 0.3  # m around the place
MIN_STEP_M = 0.02  # m: smaller steps add no points to a line


@dataclasses.dataclass(frozen=True)
class Journey:
    """A way through a place."""

    trajectory: np.ndarray  # [K,3] x, y [m], yaw [rad] in the map frame
    success: bool
    contacts: np.ndarray | None = None  # [C,2] where something was touched [m]


def floor_map(plan: dict, journeys: Sequence[Journey], goals: Sequence[Sequence[float]]) -> str:
    """Top-down SVG, y upwards: journeys that arrived are green, the others orange.

    Args:
        plan: the place as on the bridge's topic `scene`: `bounds`, `walls` and `outside` as
            rectangles (x0, y0, x1, y1) in metres, `obstacles` with a label as well, `rooms_list`
            of `name` and `rect`.
        journeys: to draw, dots at their starts.
        goals: (x, y, yaw, ...) of the arrows.
    """
    x0, y0, x1, y1 = plan['bounds']
    width = (x1 - x0 + 2 * MARGIN_M) * PIXELS_PER_M
    height = (y1 - y0 + 2 * MARGIN_M) * PIXELS_PER_M

    def place(x, y):
        return (x - x0 + MARGIN_M) * PIXELS_PER_M, height - (y - y0 + MARGIN_M) * PIXELS_PER_M

    def line(points):
        return ' '.join(f'{px:.1f},{py:.1f}' for px, py in (place(x, y) for x, y in points))

    def rect(box, style):
        left, top = place(box[0], box[3])
        return (f'<rect x="{left:.1f}" y="{top:.1f}" '
                f'width="{(box[2] - box[0]) * PIXELS_PER_M:.1f}" '
                f'height="{(box[3] - box[1]) * PIXELS_PER_M:.1f}" {style}/>')

    alone = len(journeys) == 1  # room for a broad line, its end and what it touched
    parts = [rect(plan['bounds'], 'fill="var(--floor)"')]
    parts += [rect(box, 'fill="var(--card)"') for box in plan.get('outside', [])]
    parts += [rect(box, 'fill="var(--wood)" rx="3"') for *box, _ in plan['obstacles']]
    parts += [rect(box, 'fill="var(--wall)"') for box in plan['walls']]
    for room in plan['rooms_list']:
        left, top = place(room['rect'][0], room['rect'][3])
        parts.append(f'<text x="{left + 8:.1f}" y="{top + 18:.1f}">'
                     f'{html.escape(room["name"])}</text>')
    for journey in journeys:
        way = journey.trajectory[:, :2]
        if not len(way):
            continue
        moved = np.hypot(*np.diff(way, axis=0, prepend=np.inf).T) > MIN_STEP_M
        colour = 'var(--good)' if journey.success else 'var(--bad)'
        (sx, sy), (ex, ey) = place(*way[0]), place(*way[-1])
        parts.append(f'<polyline points="{line(way[moved])}" fill="none" stroke="{colour}" '
                     f'stroke-width="{3 if alone else 2}" stroke-opacity=".{8 if alone else 6}" '
                     f'stroke-linejoin="round"/><circle cx="{sx:.1f}" cy="{sy:.1f}" '
                     f'r="{7 if alone else 4}" fill="{colour}"/>')
        if alone:
            parts.append(f'<circle cx="{ex:.1f}" cy="{ey:.1f}" r="8" fill="none" '
                         f'stroke="{colour}" stroke-width="3"/>')
            for x, y in () if journey.contacts is None else journey.contacts:
                px, py = place(x, y)
                parts.append(f'<path d="M{px - 4:.1f} {py - 4:.1f}l8 8m0 -8l-8 8" '
                             'stroke="var(--bad)" stroke-width="2"/>')
    for x, y, yaw, *_ in goals:
        corners = [(x + r * math.cos(yaw + turn), y + r * math.sin(yaw + turn))
                   for r, turn in ((0.45, 0), (0.13, math.pi / 2), (0.13, -math.pi / 2))]
        px, py = place(x, y)
        parts.append(f'<polygon points="{line(corners)}" fill="var(--goal)"/><circle '
                     f'cx="{px:.1f}" cy="{py:.1f}" r="{0.13 * PIXELS_PER_M:.1f}" '
                     'fill="var(--goal)"/>')
    return (f'<svg viewBox="0 0 {width:.0f} {height:.0f}" role="img" aria-label="map with '
            f'journey{"s" * (len(journeys) != 1)}">{"".join(parts)}</svg>')

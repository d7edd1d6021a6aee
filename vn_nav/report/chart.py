"""Line charts: drawn once as simple shapes, then written as SVG or as a picture."""

from __future__ import annotations

import dataclasses
import html
import math
from collections.abc import Mapping, Sequence

import cv2
import numpy as np

from vn_nav.report.page import COLOURS, LIGHT

DASH = 6.0, 4.0  # pixels drawn and left out
FONT = 'system-ui, sans-serif'
LABEL_MARGIN = 0.3  # of a step, left and right of an axis of labels
NAME_WIDTH = 90.0  # of a level, about [pixels]


@dataclasses.dataclass(frozen=True)
class Line:
    """A polyline [K,2], or with `filled` the area inside it."""

    points: np.ndarray
    colour: str  # a name of `page.LIGHT`
    width: float = 1.0
    dashed: bool = False
    opacity: float = 1.0
    filled: bool = False


@dataclasses.dataclass(frozen=True)
class Text:
    """Text; `anchor` is start, middle or end."""

    x: float
    y: float  # of the base line
    content: str
    anchor: str = 'start'
    colour: str = 'soft'
    size: int = 12


@dataclasses.dataclass(frozen=True)
class Series:
    """A curve with its band; dashed where it is not `full`."""

    name: str
    colour: str
    x: np.ndarray
    mean: np.ndarray
    low: np.ndarray
    high: np.ndarray
    full: np.ndarray


Shape = Line | Text


def panel(box: tuple[float, float, float, float], series: Sequence[Series], *, title: str,
          y_range: tuple[float, float], log: bool, marks: Sequence[float] = (),
          levels: Mapping[str, float] | None = None, labels: Sequence[str] = ()) -> list[Shape]:
    """Axes and curves.

    Args:
        box: left, top, right, bottom of the plotting area [pixels].
        series: the curves.
        title: below the x axis.
        y_range: lowest and highest value shown.
        log: logarithmic x.
        marks: values to draw a dashed line at.
        levels: values to draw a line at, by the name that is written there.
        labels: below x = 0, 1, 2, ... in place of numbers.
    """
    left, top, right, bottom = box
    if labels:
        x0, x1 = -LABEL_MARGIN, len(labels) - 1 + LABEL_MARGIN
    else:
        x0 = min(s.x[0] for s in series) if log else 0.0
        x1 = max(s.x[-1] for s in series)
    scale = math.log10 if log else float
    span = (scale(x1) - scale(x0)) or 1.0
    y0, y1 = y_range

    def across(x: float) -> float:
        return left + (scale(x) - scale(x0)) / span * (right - left)

    def up(y):
        return bottom - (np.clip(y, y0, y1) - y0) / (y1 - y0) * (bottom - top)

    def clear(begin: float, y: float) -> float:
        """How far the curves stay from a value where its name would stand."""
        return min((abs(float(mean) - y) for own in series
                    for x, mean in zip(own.x, own.mean, strict=True)
                    if begin <= across(x) <= begin + NAME_WIDTH), default=math.inf)

    shapes: list[Shape] = []
    for y in ticks(y0, y1):
        shapes += [Line(np.array([[left, up(y)], [right, up(y)]]), 'line'),
                   Text(left - 8, up(y) + 4, short(y), 'end')]
    named = (list(enumerate(labels)) if labels else
             [(x, short(x)) for x in (log_ticks(x0, x1) if log else ticks(x0, x1))])
    for x, name in named:
        shapes += [Line(np.array([[across(x), bottom], [across(x), bottom + 5]]), 'soft'),
                   Text(across(x), bottom + 19, name, 'middle')]
    shapes += [Line(np.array([[left, up(y)], [right, up(y)]]), 'soft', dashed=True)
               for y in marks if y0 < y < y1]
    shapes += [Line(np.array([[left, bottom], [right, bottom]]), 'soft'),
               Text((left + right) / 2, bottom + 40, title, 'middle', 'ink', 13)]
    for name, y in (levels or {}).items():
        below = bottom - up(y) < (bottom - top) / 3 and bottom - up(y) > 20  # curves are above
        middle = (left + right) / 2
        places = ((right - NAME_WIDTH, right - 4, 'end'), (left, left + 4, 'start'),
                  (middle - NAME_WIDTH / 2, middle, 'middle'))
        _, x, anchor = max(places, key=lambda place: clear(place[0], y))
        shapes += [Line(np.array([[left, up(y)], [right, up(y)]]), 'ink', 1.2),
                   Text(x, up(y) + (14 if below else -5), name, anchor, 'ink', 11)]
    for s in series:
        along = np.array([across(value) for value in s.x])
        outline = np.concatenate([np.stack([along, up(s.high)], 1),
                                  np.stack([along, up(s.low)], 1)[::-1]])
        shapes.append(Line(outline, s.colour, opacity=0.16, filled=True))
    for s in series:
        points = np.stack([[across(value) for value in s.x], up(s.mean)], 1)
        # Stretches of one kind; each begins where the last one ended.
        turns = np.nonzero(np.diff(s.full.astype(int)))[0] + 1
        for begin, end in zip([0, *turns], [*turns, len(points)], strict=True):
            stretch = points[max(begin - 1, 0):end]
            if len(stretch) > 1:
                full = bool(s.full[begin])
                shapes.append(Line(stretch, s.colour, 2.2 if full else 1.5, not full,
                                   1.0 if full else 0.8))
    return shapes


def legend(names: Sequence[tuple[str, str]], left: float, top: float, right: float
           ) -> tuple[list[Shape], float]:
    """Names and colours in lines, and the height that they take [pixels]."""
    shapes: list[Shape] = []
    x, y = left, top + 14
    for name, colour in names:
        width = 40 + 7.2 * len(name)
        if x + width > right and x > left:
            x, y = left, y + 22
        shapes += [Line(np.array([[x, y - 4], [x + 22, y - 4]]), colour, 3),
                   Text(x + 28, y, name, 'start', 'ink', 13)]
        x += width + 12
    return shapes, y + 8 - top


def ticks(low: float, high: float, wanted: int = 5) -> list[float]:
    """Round values within a range, about as many as wanted."""
    raw = (high - low) / wanted
    size = 10.0 ** math.floor(math.log10(raw))
    step = next(size * m for m in (1, 2, 2.5, 5, 10) if size * m >= raw * 0.999)
    return [k * step for k in range(math.ceil(low / step - 1e-9),
                                    math.floor(high / step + 1e-9) + 1)]


def log_ticks(low: float, high: float) -> list[float]:
    """Powers of ten within a range; twos and fives as well where there are few."""
    decades = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    steps = (1, 2, 5) if math.log10(high / low) < 2.5 else (1,)
    return [m * 10.0**k for k in decades for m in steps
            if low * 0.999 <= m * 10.0**k <= high * 1.001]


def short(value: float) -> str:
    """A number in a few characters: 1.5 M, 200 k, 0.75."""
    for size, letter in ((1e9, ' G'), (1e6, ' M'), (1e3, ' k')):
        if abs(value) >= size:
            return f'{value / size:.6g}{letter}'
    return f'{value:.6g}'


def to_svg(shapes: Sequence[Shape], width: float, height: float, label: str, *,
           alone: bool = False) -> str:
    """An SVG element; `alone` as a file of its own, which brings its colours."""
    parts = []
    for shape in shapes:
        if isinstance(shape, Text):
            parts.append(
                f'<text x="{shape.x:.1f}" y="{shape.y:.1f}" text-anchor="{shape.anchor}" '
                f'style="font:{shape.size}px {FONT};fill:var(--{shape.colour})">'
                f'{html.escape(shape.content)}</text>')
            continue
        points = ' '.join(f'{x:.1f},{y:.1f}' for x, y in shape.points)
        if shape.filled:
            parts.append(f'<polygon points="{points}" fill="var(--{shape.colour})" '
                         f'fill-opacity="{shape.opacity}"/>')
        else:
            dash = f' stroke-dasharray="{DASH[0]:g} {DASH[1]:g}"' if shape.dashed else ''
            parts.append(f'<polyline points="{points}" fill="none" '
                         f'stroke="var(--{shape.colour})" stroke-width="{shape.width}" '
                         f'stroke-opacity="{shape.opacity}" stroke-linejoin="round"{dash}/>')
    own = f'<style>{COLOURS}</style><rect width="100%" height="100%" fill="var(--card)"/>'
    name = 'xmlns="http://www.w3.org/2000/svg" ' if alone else ''
    return (f'<svg {name}viewBox="0 0 {width:.0f} {height:.0f}" role="img" '
            f'aria-label="{html.escape(label)}">{own if alone else ""}{"".join(parts)}</svg>')


def to_picture(shapes: Sequence[Shape], width: float, height: float, *, zoom: float = 2.0
               ) -> np.ndarray:
    """The same as a picture, [H,W,3] uint8 RGB, in the light colours."""
    image: np.ndarray = np.full(
        (round(height * zoom), round(width * zoom), 3), _rgb('card'), np.uint8)
    for shape in shapes:
        if isinstance(shape, Text):
            size = shape.size * zoom / 30
            (wide, _), _ = cv2.getTextSize(shape.content, cv2.FONT_HERSHEY_SIMPLEX, size, 1)
            x = shape.x * zoom - {'start': 0, 'middle': wide / 2, 'end': wide}[shape.anchor]
            cv2.putText(image, shape.content, (round(x), round(shape.y * zoom)),
                        cv2.FONT_HERSHEY_SIMPLEX, size, _rgb(shape.colour), 1, cv2.LINE_AA)
            continue
        layer = image.copy()
        pieces = _dashes(shape.points) if shape.dashed else [shape.points]
        fixed = [np.round(piece * zoom * 16).astype(np.int32) for piece in pieces]  # 1/16 pixel
        if shape.filled:
            cv2.fillPoly(layer, fixed, _rgb(shape.colour), cv2.LINE_AA, 4)
        else:
            cv2.polylines(layer, fixed, False, _rgb(shape.colour),
                          max(1, round(shape.width * zoom)), cv2.LINE_AA, 4)
        image = cv2.addWeighted(layer, shape.opacity, image, 1 - shape.opacity, 0)
    return image


def _rgb(colour: str) -> tuple[int, int, int]:
    value = LIGHT[colour]
    red, green, blue = (int(value[k:k + 2], 16) for k in (1, 3, 5))
    return red, green, blue


def _dashes(points: np.ndarray) -> list[np.ndarray]:
    """The drawn pieces of a dashed polyline."""
    along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))])
    pieces = []
    for begin in np.arange(0.0, along[-1], sum(DASH)):
        at = np.union1d(along[(along > begin) & (along < begin + DASH[0])],
                        [begin, min(begin + DASH[0], along[-1])])
        pieces.append(np.stack([np.interp(at, along, points[:, k]) for k in (0, 1)], 1))
    return pieces

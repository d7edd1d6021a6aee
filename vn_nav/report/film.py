"""A filmed search as an animated GIF: the map as it grows, beside the camera and the goal."""

from __future__ import annotations

import functools
import io
import itertools
import math
from collections.abc import Iterator
from typing import Any

import cv2
import numpy as np

from vn_nav.errors import UserError
from vn_nav.evaluation.filming import Film
from vn_nav.evaluation.metrics import Episode
from vn_nav.report.page import LIGHT
from vn_nav.report.search_map import (
    BEST_RGB,
    FREE_RGB,
    GOAL_RGB,
    OCCUPIED_RGB,
    ROBOT_RGB,
    UNKNOWN_RGB,
    Window,
    draw,
    known_bounds,
    rgb,
)

WIDTH, PICTURE = 760, 200  # pixels: of a frame, and of a picture's side
GAP, HEAD, LINE, FOOT = 12, 40, 22, 30  # pixels: margin, title, caption, legend
PAPER_RGB, INK_RGB, SOFT_RGB = rgb(LIGHT['paper']), rgb(LIGHT['ink']), rgb(LIGHT['soft'])
MOST_FRAMES = 110  # of longer episodes some decisions are left out
FRAME_MS, HOLD_MS = 110, 3500  # each frame, and the last one
# Of the 256 that a GIF has, for the pictures; the others are the map's. Fewer where it is too big.
PICTURE_COLOURS = 112, 64, 32
SAME = 255  # index of a pixel that stays as it was
MOST_BYTES = 3_000_000
AIMS = {'explore': 'exploring', 'look': 'looking around', 'turn': 'turning to the view',
        'follow': 'driving to its best guess', 'lost': 'searching once more'}
LEGEND = (('unknown', UNKNOWN_RGB), ('free', FREE_RGB), ('occupied', OCCUPIED_RGB),
          ('robot', ROBOT_RGB), ('guess at the goal', BEST_RGB),
          ('goal, unknown to it', GOAL_RGB))


def gif(film: Film, title: str) -> bytes:
    """The film as an animated GIF that plays for ever.

    Args:
        film: what to show.
        title: plain text above it.

    Raises:
        UserError: Pillow is missing.
    """
    drawn = list(frames(film, title))
    data = b''
    for colours in PICTURE_COLOURS:
        data = _encoded(drawn, _palette(film, drawn, colours))
        if len(data) <= MOST_BYTES:
            break
    return data


def _encoded(drawn: list[np.ndarray], palette: Any) -> bytes:
    """Frames as a GIF in which each has only the pixels that change."""
    image = _pillow()[0]
    indexed = [np.asarray(image.fromarray(frame).quantize(
        palette=palette, dither=image.Dither.NONE)) for frame in drawn]
    changes = [indexed[0], *(np.where(now == before, np.uint8(SAME), now)
                             for before, now in itertools.pairwise(indexed))]
    pages = []
    for change in changes:
        page = image.fromarray(change)
        page.putpalette(palette.getpalette())
        pages.append(page)
    file = io.BytesIO()
    pages[0].save(file, 'GIF', save_all=True, append_images=pages[1:], loop=0, optimize=False,
                  disposal=1, transparency=SAME,
                  duration=[FRAME_MS] * (len(drawn) - 1) + [HOLD_MS])
    return file.getvalue()


def frames(film: Film, title: str) -> Iterator[np.ndarray]:
    """Its frames [H,W,3] uint8 RGB: one a decision as far as there is room, and one of the end."""
    episode, count = film.episode, len(film.searches)
    assert episode.trajectory is not None  # of an episode that was driven here
    start = episode.trajectory[0]
    bounds = film.plan['bounds'] if film.plan else known_bounds(film.searches[-1], start)
    side = WIDTH - PICTURE - 3 * GAP
    height = 2 * (LINE + PICTURE) + GAP
    view = Window.about(bounds, side, height)
    goal = _scaled(film.goal_picture)
    step = math.ceil(count / MOST_FRAMES)
    for k in [*range(0, count - 1, step), count - 1, count]:
        ended, k = k == count, min(k, count - 1)
        search = film.searches[k]
        at = k + 1 + (ended and len(episode.trajectory) > k + 1)
        seen = draw(search, view, start, plan=film.plan, track=episode.trajectory[:at],
                    goal=episode.goal_pose, fov=film.fov)
        frame = np.full((HEAD + height + FOOT + GAP, WIDTH, 3), PAPER_RGB, np.uint8)
        frame[HEAD:HEAD + height, GAP:GAP + side] = seen
        left = WIDTH - GAP - PICTURE
        for top, picture in ((HEAD + LINE, _scaled(film.pictures[k])),
                             (HEAD + 2 * LINE + PICTURE + GAP, goal)):
            frame[top:top + PICTURE, left:left + PICTURE] = picture
        bar = round(PICTURE * search.arrival)
        bottom = HEAD + height
        frame[bottom - 6:bottom, left:left + PICTURE] = UNKNOWN_RGB
        frame[bottom - 6:bottom, left:left + bar] = GOAL_RGB
        state, colour = _outcome(film) if ended else (AIMS.get(search.aim, search.aim), INK_RGB)
        yield _written(frame, [
            (GAP, 11, title, 17, INK_RGB),
            (left, 13, f'decision {k + 1}', 15, SOFT_RGB),
            (left, HEAD + 2, f'camera (the policy sees {film.seen} x {film.seen})', 12, SOFT_RGB),
            (left, HEAD + LINE + PICTURE + GAP + 2,
             f'goal picture; is it here? {search.arrival:.0%}', 12, SOFT_RGB),
            (GAP + 8, HEAD + height - 30, state, 19, colour)], HEAD + height + 8)


def _outcome(film: Film) -> tuple[str, tuple[int, int, int]]:
    """How it ended, and the colour to say it in."""
    e: Episode = film.episode
    off = f'{e.stop_distance:.1f} m and {math.degrees(e.stop_heading):.0f} deg off'
    if e.success:
        return ('says that it is there: ' if e.declared else 'arrived: ') + off, ROBOT_RGB
    if e.declared:
        return f'stops in the wrong place: {off}', BEST_RGB
    return f'gives up after {e.decisions} decisions, {e.stop_distance:.1f} m off', BEST_RGB


def _scaled(picture: np.ndarray) -> np.ndarray:
    """A picture for a frame; a little smoother, because noise is what fills a GIF."""
    shrink = cv2.INTER_AREA if picture.shape[0] > PICTURE else cv2.INTER_CUBIC
    return cv2.medianBlur(cv2.resize(np.ascontiguousarray(picture), (PICTURE, PICTURE),
                                     interpolation=shrink), 3)


@functools.cache
def _pillow() -> tuple[Any, Any, Any]:
    """Modules of Pillow: image, drawing and fonts."""
    try:
        from PIL import Image, ImageDraw, ImageFont
    except ImportError as error:
        raise UserError('a film is written with the extra "film"', str(error),
                        "pip install 'vn_nav[film]'") from error
    return Image, ImageDraw, ImageFont


@functools.cache
def _font(size: int) -> Any:
    return _pillow()[2].load_default(size)


def _written(frame: np.ndarray, texts: list[tuple], legend: int) -> np.ndarray:
    """A frame with texts (left, top, text, size, colour), and the legend from a row on."""
    image, drawing, _ = _pillow()
    canvas = image.fromarray(frame)
    pen = drawing.Draw(canvas)
    for x, y, text, size, colour in texts:
        if size == 19:  # over the map
            box = pen.textbbox((x, y), text, font=_font(size))
            pen.rounded_rectangle((box[0] - 6, box[1] - 4, box[2] + 6, box[3] + 4), 5,
                                  fill=FREE_RGB, outline=UNKNOWN_RGB)
        pen.text((x, y), text, font=_font(size), fill=colour)
    x = GAP
    for name, colour in LEGEND:
        pen.rectangle((x, legend + 3, x + 12, legend + 13), fill=colour, outline=SOFT_RGB)
        pen.text((x + 18, legend), name, font=_font(13), fill=SOFT_RGB)
        x += 18 + round(pen.textlength(name, font=_font(13))) + 20
    return np.asarray(canvas)


def _palette(film: Film, drawn: list[np.ndarray], count: int) -> Any:
    """255 colours for all frames, as an image: so many of the pictures, and the map's."""
    image = _pillow()[0]
    some = [_scaled(film.pictures[k]) for k in
            np.unique(np.linspace(0, len(film.pictures) - 1, 16).astype(int))]
    pictures = image.fromarray(np.concatenate([*some, _scaled(film.goal_picture)]))
    colours = pictures.quantize(count, dither=image.Dither.NONE).getpalette()
    side = np.concatenate([frame[:, :WIDTH - PICTURE - GAP].reshape(-1, 3) for frame in (
        *drawn[::max(len(drawn) // 12, 1)], drawn[-1])]).astype(np.int32)
    found, counts = np.unique(side @ np.array([1 << 16, 1 << 8, 1], np.int32), return_counts=True)
    common = found[np.argsort(-counts, kind='stable')[:SAME - count]]
    table = [*colours[:3 * count],
             *np.stack([common >> 16, common >> 8 & 255, common & 255], axis=1).ravel().tolist()]
    palette = image.new('P', (1, 1))
    palette.putpalette(table + table[-3:] * (256 - len(table) // 3))
    return palette

"""Figures as tables: in the terminal and as HTML, from one list of columns."""

from __future__ import annotations

import html
from collections.abc import Callable, Iterable, Sequence

from vn_nav.evaluation.evaluator import DECLARED
from vn_nav.report.page import table
from vn_nav.report.terminal import print_table

TITLES = {'arrival': 'Arrival', 'declared': 'Declared stop'}
SPLITS = {  # names of splits, for people
    'scenes': 'Chosen scenes', 'seen_goals': 'Seen goals', 'unseen_goals': 'Unseen goals',
    'all_goals': 'All goals',
    'train': 'Training split', 'validation': 'Validation split', 'test': 'Test split',
    'unseen_look': 'Unseen look',
}
Column = tuple[str, Callable[[dict], str]]  # heading, its text from a summary
COLUMNS: tuple[Column, ...] = (
    ('success (95 %)', lambda r: '{:.2f} ({:.2f}-{:.2f})'.format(r['success'],
                                                                 *r['success_interval'])),
    ('SPL', lambda r: number(r['spl'], '.2f')),
    ('decisions (95 %)', lambda r: '{:.0f} ({:.0f}-{:.0f})'.format(r['decisions'],
                                                                   *r['decisions_interval'])),
    ('seconds', lambda r: number(r['seconds'], '.0f')),
    ('collisions', lambda r: f'{r["collisions"]:.1%}'),
    ('contact-free', lambda r: f'{r["contact_free_success"]:.2f}'),
    ('stop error', lambda r: stop_error(r)),
    ('return', lambda r: f'{r["return"]:.2f}'),
)
STOP_COLUMNS: tuple[Column, ...] = (
    ('declared', lambda r: f'{r["declared"]:.2f}'),
    ('false stops', lambda r: f'{r["false_stops"]:.2f}'),
    ('reached', lambda r: f'{r["reached"]:.2f}'),
    ('within 1 m (SPL)', lambda r: '-' if r['within_1m'] is None else
     f'{r["within_1m"]:.2f} ({number(r["spl_within_1m"], ".2f")})'),
)
SHOWN_COLUMNS: tuple[Column, ...] = (  # where a row shows another picture than the goal's
    ('at the picture', lambda r: number(r.get('stops_at_shown'), '.2f')),
)

FILTER_COLUMNS: tuple[Column, ...] = (  # where a row has an action filter
    ('filter acted', lambda r: f'{r["filter_acted"]:.1%}' if 'filter_acted' in r else '-'),
    ('filter changed', lambda r: f'{r["filter_changed"]:.1%}' if 'filter_changed' in r else '-'),
)


def number(value: float | None, form: str) -> str:
    """A figure, or a dash where there is none."""
    return '-' if value is None else f'{value:{form}}'


def unit(figures: dict) -> str:
    """Of a summary's distances: 'm', or 'steps' on a grid."""
    return 'm' if 'stop_error_m' in figures else 'steps'


def stop_error(figures: dict) -> str:
    """Distance and heading error at the end of episodes, in words; a dash: nobody knows them."""
    name = unit(figures)
    if figures['stop_error_deg'] is None:
        return '-'
    return f'{figures[f"stop_error_{name}"]:.2f} {name} {figures["stop_error_deg"]:.0f} deg'


def place(split: str, scenes: Sequence[str], bag: str | None = None) -> str:
    """A split and its scenes, or the recorded drive, in short."""
    if bag is not None:
        return f'{SPLITS[split].lower()} of {bag}'
    if len(scenes) <= 3:
        return f'{SPLITS[split].lower()} ({", ".join(scenes)})'
    return f'{SPLITS[split].lower()} ({len(scenes)} scenes)'


def _columns(stop: str, rows: Iterable[dict]) -> tuple[Column, ...]:
    rows = list(rows)
    columns = COLUMNS
    if stop == DECLARED:
        shown = SHOWN_COLUMNS if any('stops_at_shown' in row for row in rows) else ()
        columns = COLUMNS[:1] + STOP_COLUMNS + shown + COLUMNS[1:]
    return columns + (FILTER_COLUMNS if any('filter_acted' in row for row in rows) else ())


def _rows_cells(rows: dict[str, dict], stop: str) -> tuple[list[str], list[list[str]]]:
    columns = _columns(stop, rows.values())
    return (['policy', *(heading for heading, _ in columns)],
            [[name, *(text(figures) for _, text in columns)] for name, figures in rows.items()])


def _scenes_cells(scenes: dict, stop: str) -> tuple[list[str], list[list[str]]]:
    """A line a scene: the policy's figures, and next to them the success of each control."""
    columns = _columns(stop, (row for rows in scenes.values() for row in rows[stop].values()))
    names = list(next(iter(scenes.values()))[stop])
    lines = []
    for scene, rows in scenes.items():
        own, *controls = rows[stop].values()
        lines.append([scene, str(own['episodes']), *(text(own) for _, text in columns),
                      *(f'{control["success"]:.2f}' for control in controls)])
    return ['scene', 'episodes', *(heading for heading, _ in columns), *names[1:]], lines


def row_line(name: str, figures: dict, stop: str) -> str:
    """A row in a line, as soon as it is measured."""
    texts = [f'{heading} {shown(figures)}' for heading, shown in _columns(stop, [figures])]
    return f'{name}: {figures["episodes"]} episodes, {", ".join(texts)}'


def print_rows(figures: dict[str, dict[str, dict]], title: str) -> None:
    """Print the rows of a split, a table for each kind of stop.

    Args:
        figures: as of `evaluator.figures`.
        title: of the place.
    """
    for stop, rows in figures.items():
        count = next(iter(rows.values()))['episodes']
        _print(f'{title}: {TITLES[stop].lower()}, {count} episodes each', *_rows_cells(rows, stop))


def print_scenes(scenes: dict, title: str) -> None:
    """Print the figures of each scene; `scenes` by name, each as for `print_rows`."""
    for stop in next(iter(scenes.values())):
        _print(f'{title}: {TITLES[stop].lower()}, by scene', *_scenes_cells(scenes, stop))


def _print(title: str, headings: list[str], lines: list[list[str]]) -> None:
    first, *others = headings
    print_table(title, [first, *(heading.replace(' ', '\n', 1).replace('-', '-\n')
                                 for heading in others)], lines)


def rows_html(rows: dict[str, dict], stop: str) -> str:
    """The rows of one kind of stop as an HTML table."""
    headings, lines = _rows_cells(rows, stop)
    return table(headings, [[html.escape(cell) for cell in line] for line in lines], first=True)


def scenes_html(scenes: dict, stop: str) -> str:
    """The figures of each scene, of one kind of stop, as an HTML table."""
    headings, lines = _scenes_cells(scenes, stop)
    return table(headings, [[html.escape(cell) for cell in line] for line in lines])


def markdown(lines: Sequence[Sequence[str]]) -> str:
    """Rows of cells as a Markdown table; the second is of '---'."""
    return '\n'.join(f'| {" | ".join(line)} |'.replace('| ---', '|---').replace('--- |', '---|')
                     for line in lines)

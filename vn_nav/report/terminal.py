"""Tables in a terminal: nothing is cut off at any width."""

from __future__ import annotations

from collections.abc import Sequence

GAP = 2  # characters between columns


def print_table(title: str, headings: Sequence[str], lines: Sequence[Sequence[str]], *,
                width: int | None = None) -> None:
    """Print a table; where it is wider than the terminal, as several below each other.

    Args:
        title: plain text.
        headings: of the columns, may have several lines; the first column names the rows, the
            others are numbers.
        lines: the cells.
        width: characters; default: of the terminal. A file or a pipe has none: all in one table.
    """
    from rich.box import SIMPLE_HEAD
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text
    console = Console()
    widths = [max(len(part) for cell in (heading, *(line[k] for line in lines))
                  for part in cell.split('\n')) for k, heading in enumerate(headings)]
    if width is not None:
        console.width = width
    elif not console.is_terminal:
        console.width = sum(widths) + GAP * len(widths)
    for number, columns in enumerate(_blocks(widths, console.width)):
        table = Table(title=None if number else Text(title), box=SIMPLE_HEAD, show_edge=False,
                      pad_edge=False, collapse_padding=True)
        for k in columns:
            table.add_column(Text(headings[k]), justify='left' if k == 0 else 'right',
                             overflow='fold')
        for line in lines:
            table.add_row(*(Text(line[k]) for k in columns))
        if number:
            console.print()
        console.print(table)


def _blocks(widths: Sequence[int], most: int) -> list[list[int]]:
    """Columns side by side as far as they fit, the first one in each block."""
    blocks = [[0]]
    used = widths[0]
    for k in range(1, len(widths)):
        if len(blocks[-1]) > 1 and used + GAP + widths[k] > most:
            blocks.append([0])
            used = widths[0]
        blocks[-1].append(k)
        used += GAP + widths[k]
    return blocks

"""What docstrings have of Markdown, as reStructuredText: tables, `code`s, lists of results."""

import re

CODE = re.compile(r'(`[^`]+`)')
RESULT = re.compile(r'[\w, *]+: ')  # `image: [V,3,S,S] uint8`


def to_rst(lines):
    """Replace a docstring's lines, in place, before the sections of Google's style are read."""
    lines[:] = _results(_tables(lines))


def _tables(lines):
    table = []
    for line in [*lines, None]:
        if line is not None and re.fullmatch(r'\s*\|.*\|\s*', line):
            table.append(line)
            continue
        if len(table) > 1:
            yield from ['', *_list_table(table), '']
        else:
            yield from map(_plain, table)
        table = []
        if line is not None:
            yield _plain(line)


def _list_table(table):
    indent = ' ' * (len(table[0]) - len(table[0].lstrip()))
    yield f'{indent}.. list-table::'
    yield f'{indent}   :header-rows: 1'
    yield ''
    for row in (table[0], *table[2:]):  # the second is the rule
        for column, cell in enumerate(row.strip()[1:-1].split('|')):
            yield f'{indent}   {" " if column else "*"} - {_plain(cell.strip())}'


def _plain(line):
    """A bar is no substitution, and a letter may follow a closing backquote."""
    parts = CODE.split(line)
    for index, part in enumerate(parts):
        if index % 2:
            parts[index] = part + ('\\ ' if re.match(r'[\w\[(]', parts[index + 1]) else '')
        else:
            parts[index] = part.replace('|', r'\|')
    return ''.join(parts)


def _results(lines):
    """A section `Returns:` of several named results, as a list."""
    lines = list(lines)
    while lines:
        line = lines.pop(0)
        indent = len(line) - len(line.lstrip())
        if line.strip() != 'Returns:':
            yield line
            continue
        section = []
        while lines and (not lines[0].strip() or lines[0].startswith(' ' * (indent + 1))):
            section.append(lines.pop(0))
        least = min((len(text) - len(text.lstrip()) for text in section if text.strip()),
                    default=0)
        named = [bool(RESULT.match(text[least:])) for text in section]
        if sum(named) < 2:
            yield from [line, *section]
            continue
        yield f'{" " * indent}:returns:'
        for text, is_named in zip(section, named, strict=True):
            yield f'{" " * least}{"- " if is_named else "  "}{text[least:]}'.rstrip()
        yield ''

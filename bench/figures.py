"""Which figures of README, docs and model cards are older than the code that they measure.

    python bench/figures.py              # make figures
    python bench/figures.py --changed    # and which commits those are: make figures CHANGED=1

`docs/figures.yaml` says of each figure where it stands, the command that makes it, when and on
which commit it was measured, and which files it measures. The last column says how much of these
files has changed since: statements that are new or gone, without comments, docstrings and format,
and without those that only moved. 0 %: the figure is of today's code. A change of names counts as
well: look at the commits before you measure again.

The exit code is 0, and 2 with one line where the registry is broken.
"""

from __future__ import annotations

import argparse
import ast
import dataclasses
import datetime
import hashlib
import re
import shlex
import subprocess
import sys
import textwrap
from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path

from vn_nav.cli.commands import COMMANDS
from vn_nav.errors import UserError
from vn_nav.structured_file import read_yaml

ROOT = Path(__file__).resolve().parent.parent
REGISTRY = 'docs/figures.yaml'
WHAT, MEND = 'the registry of figures', f'mend {REGISTRY}'
NONE = 'none'  # in place of a command, together with a reason
KEYS = {'file', 'section', 'command', 'date', 'commit', 'machine', 'code'}
OPTIONAL = {'figures', 'reason'}
COLUMNS = (('section', 28), ('command', 29), ('date', 10), ('changed', 7))  # 80 characters
GAP = '  '
DOCUMENTED = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)


@dataclasses.dataclass(frozen=True)
class Figure:
    """An entry of the registry: figures of one section that were measured together."""

    file: str  # from the root of the repository, as all paths here
    section: str  # its heading
    figures: str  # which of the section; '': all
    commands: tuple[str, ...]  # that make them; empty: none does
    reason: str  # why none does
    date: str
    commit: str  # whose tree was measured
    machine: str
    code: tuple[str, ...]  # files and folders that are measured

    @property
    def name(self) -> str:
        """Where it stands, in words."""
        return f'{self.file}: {self.section}' + (f' ({self.figures})' if self.figures else '')


def read_registry(path: Path) -> list[Figure]:
    """Read the registry.

    Raises:
        UserError: it is no mapping of `code` and `figures`; an entry lacks a key, or has one that
            nobody knows, or a value of another type.
    """
    content = read_yaml(path, WHAT, MEND)
    if set(content) != {'code', 'figures'}:
        raise UserError(f'{WHAT} has the keys code and figures', sorted(content), MEND)
    groups, entries = content['code'], content['figures']
    if not isinstance(groups, dict) or not isinstance(entries, list):
        raise UserError('code is a mapping of names to paths, figures a list of entries',
                        f'{type(groups).__name__}, {type(entries).__name__}', MEND)
    groups = {name: _texts(paths, f'code: {name}') for name, paths in groups.items()}
    return [_figure(entry, groups) for entry in entries]


def _figure(entry: object, groups: dict[str, tuple[str, ...]]) -> Figure:
    keys = set(entry) if isinstance(entry, dict) else set()
    if not isinstance(entry, dict) or not KEYS <= keys <= KEYS | OPTIONAL:
        raise UserError(f'an entry has the keys {", ".join(sorted(KEYS))}; and may have '
                        f'{", ".join(sorted(OPTIONAL))}', entry, MEND)
    where = f'{entry["file"]}: {entry["section"]}'
    for key in ('file', 'section', 'commit', 'machine', *(OPTIONAL & keys)):
        if not isinstance(entry[key], str) or not entry[key].strip():
            raise UserError(f'{key} is a text; a commit of digits alone in quotation marks',
                            f'{where}: {entry[key]!r}', MEND)
    if type(entry['date']) is not datetime.date:
        raise UserError('a date is YEAR-MONTH-DAY', f'{where}: {entry["date"]!r}', MEND)
    if not re.fullmatch('[0-9a-f]{7,40}', entry['commit']):
        raise UserError('a commit is 7 to 40 hexadecimal digits', f'{where}: {entry["commit"]}',
                        MEND)
    commands = _texts(entry['command'], where)
    if (commands == (NONE,)) != ('reason' in entry):
        raise UserError(f'an entry has a command, or "command: {NONE}" and a reason', where, MEND)
    code = [path for name in _texts(entry['code'], where) for path in groups.get(name, (name,))]
    return Figure(
        file=entry['file'], section=entry['section'], figures=entry.get('figures', ''),
        commands=() if commands == (NONE,) else commands, reason=entry.get('reason', ''),
        date=entry['date'].isoformat(), commit=entry['commit'], machine=entry['machine'],
        code=tuple(dict.fromkeys(code)))


def _texts(value: object, where: str) -> tuple[str, ...]:
    """A text, or a list of some."""
    texts = value if isinstance(value, list) else [value]
    if not texts or not all(isinstance(text, str) and text.strip() for text in texts):
        raise UserError('commands and paths are a text, or a list of texts',
                        f'{where}: {value!r}', MEND)
    return tuple(texts)


def sections(text: str) -> dict[str, str]:
    """The sections of a Markdown page: heading to text, up to the next heading of any level.

    Blocks of code are left out.

    Raises:
        UserError: a heading stands twice.
    """
    text = re.sub(r'^```.*?^```', '', text, flags=re.MULTILINE | re.DOTALL)
    _, *parts = re.split(r'^#+ (.+)\n', text, flags=re.MULTILINE)
    found = dict(zip(parts[::2], parts[1::2], strict=True))
    if len(found) < len(parts) // 2:
        raise UserError('a heading stands once in a page',
                        next(name for name in found if parts[::2].count(name) > 1), 'rename one')
    return found


def check(figures: Iterable[Figure], root: Path) -> None:
    """Check what an entry names: its section, and the programs of its commands.

    Raises:
        UserError: there is none of that name.
    """
    pages: dict[str, dict[str, str]] = {}
    for figure in figures:
        path = root / figure.file
        if figure.file not in pages:
            if not path.is_file():
                raise UserError('figures stand in a file', figure.file, MEND)
            pages[figure.file] = sections(path.read_text())
        if figure.section not in pages[figure.file]:
            raise UserError(f'{figure.file} has the section', figure.section, MEND)
        for command in figure.commands:
            if not _runs(command, root):
                raise UserError('a command begins with python and a file, vn_nav and one of its '
                                'commands, or make and a goal', f'{figure.name}: {command}', MEND)


def _runs(command: str, root: Path) -> bool:
    """Whether the program of a command is there."""
    try:
        words = shlex.split(command, comments=True)
    except ValueError:  # a quotation mark that is never closed
        return False
    while words and re.match(r'[A-Z][A-Z_]*=', words[0]):
        words = words[1:]
    match words:
        case ['make', goal, *_]:
            return goal in _goals(root)
        case ['vn_nav', name, *_]:
            return name in COMMANDS
        case ['python', '-m', 'pytest', file, *_] | ['python', file, *_]:
            return file.endswith('.py') and (root / file).is_file()
    return False


def _goals(root: Path) -> set[str]:
    """Goals of the Makefile."""
    found = re.search(r'^\.PHONY: (.+)$', (root / 'Makefile').read_text(), re.MULTILINE)
    return set(found.group(1).split()) if found else set()


def statements(path: str, content: bytes) -> Counter[str]:
    """What a file says: its lines; of Python without comments, docstrings and format.

    Of a file that is no text: one line, as good as its content.
    """
    if b'\0' in content:
        return Counter([f'{path}: {hashlib.sha256(content).hexdigest()}'])
    text = content.decode(errors='replace')
    if path.endswith('.py'):
        tree = ast.parse(text)
        for node in ast.walk(tree):
            if isinstance(node, DOCUMENTED) and ast.get_docstring(node, clean=False) is not None:
                node.body = node.body[1:] or [ast.Pass()]
        text = ast.unparse(tree)
    return Counter(line for line in text.splitlines() if line.strip())


class History:
    """The commits of the repository.

    Raises:
        UserError: git is missing, or this is no clone with all commits.
    """

    def __init__(self, root: Path):
        self.root = root
        self._known: dict[tuple[str, str], Counter[str]] = {}  # by object and path
        try:
            top, shallow = self._git('rev-parse', '--show-toplevel',
                                     '--is-shallow-repository').splitlines()
        except (OSError, subprocess.CalledProcessError):
            top, shallow = '', ''
        if not top or Path(top).resolve() != root.resolve() or shallow != 'false':
            raise UserError('figures are compared with the history of their code', 'a copy '
                            'without history', 'use a clone, or run git fetch --unshallow in it')

    def _git(self, *words: str) -> str:
        return subprocess.run(['git', *words], cwd=self.root, check=True, capture_output=True,
                              text=True).stdout

    def check(self, figures: Iterable[Figure]) -> None:
        """Check the commits and paths of entries.

        Raises:
            UserError: a commit that is none of this history, or younger than the figure; a path
                that is not there and never was.
        """
        known: set[str] = set()
        dates = dict(line.split() for line in self._git('log', '--format=%H %as').splitlines())
        for figure in figures:
            found = [date for commit, date in dates.items() if commit.startswith(figure.commit)]
            if len(found) != 1:
                raise UserError('figures are measured at a commit of this history',
                                f'{figure.name}: {figure.commit}', MEND)
            if found[0] > figure.date:
                raise UserError('a commit is no younger than the figures that are measured at it',
                                f'{figure.name}: {figure.date}, {figure.commit} of {found[0]}',
                                MEND)
            for path in set(figure.code) - known:
                if not (self.root / path).exists() and not self._git(
                        'log', '-1', '--format=%h', '--', path):
                    raise UserError('measured code is, or was, a file or folder here',
                                    f'{figure.name}: {path}', MEND)
                known.add(path)

    def changed(self, figure: Figure) -> float:
        """Which share of what a figure measures is new or gone since, 0 to 1."""
        then, now = self._statements(figure.commit, figure), self._statements('HEAD', figure)
        most = max(then.total(), now.total(), 1)
        return max((now - then).total(), (then - now).total()) / most

    def _statements(self, commit: str, figure: Figure) -> Counter[str]:
        """Those of the files that a figure measures, in the tree of a commit."""
        total: Counter[str] = Counter()
        for line in self._git('ls-tree', '-r', commit, '--', *figure.code).splitlines():
            about, path = line.split('\t')
            name = about.split()[2]
            if (name, path) not in self._known:
                content = subprocess.run(['git', 'cat-file', 'blob', name], cwd=self.root,
                                         check=True, capture_output=True).stdout
                self._known[name, path] = statements(path, content)
            total += self._known[name, path]
        return total

    def since(self, figure: Figure) -> list[str]:
        """The commits that have touched what a figure measures: 'hash date subject' each."""
        return self._git('log', '--no-merges', '--format=%h %as %s', f'{figure.commit}..HEAD',
                         '--', *figure.code).splitlines()


def row(cells: Sequence[str]) -> list[str]:
    """The lines of a row, in columns of `COLUMNS`; the last one holds numbers."""
    wrapped = [[part for line in cell.split('\n')
                for part in textwrap.wrap(line, width, break_on_hyphens=False)]
               for cell, (_, width) in zip(cells, COLUMNS, strict=True)]
    lines = []
    for number in range(max(map(len, wrapped))):
        parts = [cell[number] if number < len(cell) else '' for cell in wrapped]
        *texts, count = [f'{part:{align}{width}}' for part, align, (_, width) in zip(
            parts, '<<<>', COLUMNS, strict=True)]
        lines.append(GAP.join([*texts, count]).rstrip())
    return lines


def percent(share: float) -> str:
    """A share in whole percents; what is no zero is none."""
    return '<1 %' if 0 < share < 0.005 else f'{share:.0%}'.replace('%', ' %')


def table(figures: Sequence[Figure], changed: Sequence[float],
          commits: Sequence[Sequence[str]]) -> str:
    """The table, page by page; the commits of each figure below its row."""
    lines = [*row([name for name, _ in COLUMNS]), *row(['-' * width for _, width in COLUMNS])]
    for file in dict.fromkeys(figure.file for figure in figures):
        lines += ['', file]
        for figure, share, found in zip(figures, changed, commits, strict=True):
            if figure.file != file:
                continue
            section = figure.section + (f': {figure.figures}' if figure.figures else '')
            lines += row([section, '\n'.join(figure.commands) or NONE, figure.date,
                          percent(share)])
            lines += [f'    {textwrap.shorten(commit, 76, placeholder="...")}'
                      for commit in found]
    older, much = sum(map(bool, changed)), sum(share > 0.1 for share in changed)
    without = sum(not figure.commands for figure in figures)
    return '\n'.join([*lines, '', f'{len(figures)} entries: {older} older than their code ({much} '
                      f'by over 10 %), {without} without a command.'])


def main(root: Path = ROOT) -> int:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__.split('\n')[0])
    parser.add_argument('--changed', action='store_true', help='print the commits as well')
    options = parser.parse_args()
    try:
        figures = read_registry(root / REGISTRY)
        check(figures, root)
        try:
            history = History(root)
        except UserError as error:
            print(f'bench/figures.py: {error}')
            return 0
        history.check(figures)
    except UserError as error:
        print(f'bench/figures.py: {error}', file=sys.stderr)
        return 2
    print(table(figures, [history.changed(figure) for figure in figures],
                [history.since(figure) if options.changed else [] for figure in figures]))
    return 0


if __name__ == '__main__':
    sys.exit(main())

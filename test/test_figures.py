"""Figures of README, docs and model cards: each has an entry, and its age is told."""

import functools
import importlib.util
import re
import subprocess
import sys

import pytest
import yaml
from paths import ROOT

PAGES = ['README.md', *(f'docs/{name}.md' for name in (
    'results', 'performance', 'scaling', 'safety', 'method', 'bags', 'reproduce')),
    *(str(path.relative_to(ROOT)) for path in (
        *sorted(ROOT.glob('docs/simulators/*.md')), *sorted(ROOT.glob('models/*/README.md'))))]

# Sections that hold figures by the rule below and measure nothing.
EXCEPTIONS = {
    ('README.md', 'Topics'): 'lengths of queues',
    ('docs/results.md', 'Results'): 'says what intervals are',
    ('docs/method.md', "The thesis's network"): 'shapes of layers',
    ('docs/method.md', 'The search'): 'a constant of the planner',
    ('docs/method.md', 'Measured ranges'): 'a constant of the simulated sensor',
    ('docs/method.md', 'Recall of a taught place'): 'a constant of the evidence',
    ('docs/bags.md', 'Pictures'): 'limits', ('docs/bags.md', 'Teach'): 'defaults of options',
    ('docs/bags.md', 'Online'): 'defaults of options; its rate stands in performance.md',
    ('docs/scaling.md', 'Cost model'): 'sizes of messages, from the number of parameters',
    ('docs/scaling.md', 'Planned: 8 and 64 GPUs'): 'a plan, from data sheets',
    ('docs/simulators/suncg.md', 'RoomNav'): "a constant of House3D's rule",
    **{(page, 'Visual navigation policy'): 'the shape of the network and the length of training'
       for page in PAGES if page.startswith('models/')},
}

# A cell of a table that begins with a number; in running text a share, a rate, a ratio, a time of
# milliseconds, or a success with its interval.
CELL = re.compile(r'[*\-~< ]*\d')
TEXT = re.compile(r'\d %|\d (frames|steps|decisions)/s|\d times\b|\d ms\b|\b[01]\.\d\d \(')


def module(name):
    spec = importlib.util.spec_from_file_location(name, ROOT / 'bench' / f'{name}.py')
    loaded = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = loaded  # its dataclasses look for it there
    spec.loader.exec_module(loaded)
    return loaded


figures = module('figures')


def holds_figures(text):
    """Whether a section holds figures, by a plain rule."""
    rows = [line for line in text.splitlines() if line.startswith('|')]
    prose = ' '.join(line for line in text.splitlines() if not line.startswith('|'))
    return bool(TEXT.search(prose)) or any(
        CELL.match(cell) for row in rows for cell in row.strip('|').split('|'))


def test_the_rule_finds_figures():
    assert holds_figures('| a | b |\n|---|---|\n| rate | **9,877** |')
    assert holds_figures('It collides in 8 %\nof its decisions.')
    assert holds_figures('529 steps/s with 1 environment')
    assert holds_figures('success 0.94 (0.86-1.00)')
    assert not holds_figures('| a | b |\n|---|---|\n| `0.25` | seconds |\n\nIn 2019, 3 people.')


def test_every_section_with_figures_has_an_entry():
    known = {(figure.file, figure.section) for figure in entries()}
    held = {(page, heading) for page in PAGES
            for heading, text in figures.sections((ROOT / page).read_text()).items()
            if holds_figures(text)}
    lacking = sorted(held - known - set(EXCEPTIONS))
    assert not lacking, f'give them an entry in {figures.REGISTRY}: {lacking}'
    idle = sorted(set(EXCEPTIONS) - (held - known))
    assert not idle, f'no exception is needed: {idle}'


@functools.cache
def entries():
    return figures.read_registry(ROOT / figures.REGISTRY)


def test_what_entries_name_is_there():
    figures.check(entries(), ROOT)


@pytest.mark.slow
def test_commits_of_entries_are_in_the_history():
    try:
        history = figures.History(ROOT)
    except figures.UserError as error:
        pytest.skip(f'expected: {error}')
    history.check(entries())


ENTRY = {'file': 'README.md', 'section': 'Speed', 'command': 'python bench/speed.py --rounds 3',
         'date': '2026-01-02', 'machine': 'one core', 'code': ['fast', 'bench/speed.py']}


def git(folder, *words, date='2026-01-02T12:00:00'):
    return subprocess.run(
        ['git', '-c', 'user.name=A', '-c', 'user.email=a@example.org', *words], cwd=folder,
        env={'PATH': '/usr/bin:/bin', 'GIT_AUTHOR_DATE': date, 'GIT_COMMITTER_DATE': date},
        check=True, capture_output=True, text=True).stdout.strip()


def commit(folder, path, text, **options):
    (folder / path).parent.mkdir(parents=True, exist_ok=True)
    (folder / path).write_text(text)
    git(folder, 'add', path)
    git(folder, 'commit', '-m', f'{path} is changed', **options)
    return git(folder, 'rev-parse', '--short=12', 'HEAD')


@pytest.fixture
def project(tmp_path):
    """A repository with a page, a program, a folder of code, and no registry yet."""
    folder = tmp_path / 'project'
    folder.mkdir()
    git(folder, 'init', '-q')
    commit(folder, 'README.md', '# Fast\n\n## Speed\n\n9,000 frames/s\n')
    commit(folder, 'Makefile', '.PHONY: demo test\n')
    commit(folder, 'bench/speed.py', '')
    return folder, commit(folder, 'code/loop.py', 'begin\nslow\nend\n')


def register(folder, entry, **changes):
    entry = {key: value for key, value in {**entry, **changes}.items() if value is not None}
    text = yaml.safe_dump({'code': {'fast': ['code']}, 'figures': [entry]})
    # A date is one, as in the file that people write.
    return commit(folder, figures.REGISTRY, text.replace(f"'{entry['date']}'", entry['date']))


def call(folder, monkeypatch, capsys, *words):
    monkeypatch.setattr(sys, 'argv', ['figures.py', *words])
    code = figures.main(folder)
    return code, capsys.readouterr()


def test_statements_of_a_program_are_its_code():
    written = b'''"""What it is."""
import os  # for later

class Loop:
    """Slow."""

    def run(self, *,
            frames):
        """Go."""
        return [frames,
                os]
'''
    expected = ['import os', 'class Loop:', '    def run(self, *, frames):',
                '        return [frames, os]']
    assert list(figures.statements('code/loop.py', written)) == expected
    assert list(figures.statements('code/loop.yaml', b'a: 1\n\nb: 2\n')) == ['a: 1', 'b: 2']
    one, other = (figures.statements('model.bin', content) for content in (b'\0a', b'\0b'))
    assert one.total() == other.total() == 1 and one != other


@pytest.mark.slow
def test_changed_statements_are_counted(project, monkeypatch, capsys):
    folder, measured = project
    register(folder, ENTRY, commit=measured)
    code, said = call(folder, monkeypatch, capsys)
    none = '1 entries: 0 older than their code (0 by over 10 %), 0 without a command.'
    assert code == 0 and none in said.out
    # Another text, format and place change nothing.
    commit(folder, 'README.md', '# Fast\n\n## Speed\n\n9,000 frames/s, measured\n')
    commit(folder, 'bench/speed.py', '# another way to count\n')
    git(folder, 'mv', 'code/loop.py', 'code/loops.py')
    git(folder, 'commit', '-m', 'another name')
    assert none in call(folder, monkeypatch, capsys)[1].out
    # A statement of three is another one, and one is new: half of four.
    changed = commit(folder, 'code/loops.py', 'begin\nfast\nend\nreport\n')
    code, said = call(folder, monkeypatch, capsys)
    row = next(line for line in said.out.splitlines() if line.startswith('Speed'))
    assert code == 0 and row.split()[-3:] == ['2026-01-02', '50', '%']
    assert changed[:7] not in said.out
    assert '1 entries: 1 older than their code (1 by over 10 %)' in said.out
    code, said = call(folder, monkeypatch, capsys, '--changed')
    assert changed[:7] in said.out and 'code/loops.py is changed' in said.out
    assert 'README.md is changed' not in said.out
    assert max(map(len, said.out.splitlines())) <= 80


@pytest.mark.parametrize('share, said', [(0, '0 %'), (0.0001, '<1 %'), (0.006, '1 %'),
                                         (1, '100 %')])
def test_a_small_share_is_not_none(share, said):
    assert figures.percent(share) == said


@pytest.mark.slow
def test_code_that_is_gone_still_has_a_history(project, monkeypatch, capsys):
    folder, measured = project
    register(folder, ENTRY, commit=measured)
    git(folder, 'rm', '-rq', 'code')
    git(folder, 'commit', '-m', 'no loop any more')
    code, said = call(folder, monkeypatch, capsys, '--changed')
    assert code == 0 and 'no loop any more' in said.out


@pytest.mark.slow
@pytest.mark.parametrize('words', [('--depth', '1'), None], ids=['shallow', 'no git'])
def test_without_history_it_says_so_in_one_line(project, tmp_path, monkeypatch, capsys, words):
    folder, measured = project
    register(folder, ENTRY, commit=measured)
    copy = tmp_path / 'copy'
    if words:
        git(tmp_path, 'clone', '-q', *words, folder.as_uri(), str(copy))
    else:  # unpacked inside another repository, as an archive may be
        git(tmp_path, 'init', '-q')
        copy.mkdir()
        for path in git(folder, 'ls-files').splitlines():
            (copy / path).parent.mkdir(parents=True, exist_ok=True)
            (copy / path).write_text((folder / path).read_text())
    code, said = call(copy, monkeypatch, capsys)
    assert code == 0 and said.out.count('\n') == 1 and 'without history' in said.out


@pytest.mark.slow
@pytest.mark.parametrize('changes, words', [
    ({'section': 'Slowness'}, 'README.md has the section'),
    ({'file': 'docs/gone.md'}, 'figures stand in a file'),
    ({'command': 'python bench/gone.py'}, 'a command begins with'),
    ({'command': 'vn_nav fly models/house'}, 'a command begins with'),
    ({'command': ['make test', 'make figures']}, 'a command begins with'),
    ({'command': 'none'}, 'and a reason'),
    ({'reason': 'tried once'}, 'and a reason'),
    ({'code': ['code', 'gone']}, 'measured code is, or was'),
    ({'commit': '0123456789ab'}, 'a commit of this history'),
    ({'commit': '12 days ago'}, 'hexadecimal'),
    ({'date': '2026-01-01'}, 'a commit is no younger'),
    ({'date': 'yesterday'}, 'a date is'),
    ({'machine': None}, 'an entry has the keys'),
    ({'machnie': 'one core'}, 'an entry has the keys'),
], ids=str)
def test_a_broken_registry_is_one_line(project, monkeypatch, capsys, changes, words):
    folder, measured = project
    register(folder, {**ENTRY, 'commit': measured}, **changes)
    code, said = call(folder, monkeypatch, capsys)
    assert code == 2 and not said.out and said.err.count('\n') == 1
    assert words in said.err


@pytest.mark.parametrize('command, runs', [
    ('make demo', True), ('make', False), ('SIZE=3 python -m pytest bench/speed.py -k all', True),
    ('vn_nav evaluate models/house', True), ('python -m pytest test', False),
    ("python bench/speed.py 'open", False), ('rm -r bench/speed.py', False)])
def test_which_commands_have_a_program(tmp_path, command, runs):
    (tmp_path / 'bench').mkdir()
    (tmp_path / 'bench' / 'speed.py').touch()
    (tmp_path / 'Makefile').write_text('.PHONY: demo\n')
    assert figures._runs(command, tmp_path) == runs


def test_make_has_the_goal():
    said = subprocess.run(
        ['make', '-n', '--assume-old', '.venv/.ready', 'figures', 'CHANGED=1'], cwd=ROOT,
        capture_output=True, text=True, timeout=60)
    assert said.returncode == 0 and 'bench/figures.py --changed\n' in said.stdout

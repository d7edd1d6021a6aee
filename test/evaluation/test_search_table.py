"""`bench/search.py`: rows are measured once, kept, and printed as a table."""

import importlib.util
import json
import sys

import pytest
from paths import ROOT
from small_search import write_small_search


@pytest.fixture(scope='module')
def table():
    spec = importlib.util.spec_from_file_location('search_table', ROOT / 'bench' / 'search.py')
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # its dataclasses look for it there
    spec.loader.exec_module(module)
    return module


def call(table, monkeypatch, capsys, *words):
    monkeypatch.setattr(sys, 'argv', ['search.py', *map(str, words)])
    code = table.main()
    return code, capsys.readouterr()


def test_every_row_of_the_issue_is_there(table):
    assert {'test', 'unseen_look', 'wrong', 'absent', 'blank', 'random', 'explorer', 'shortest',
            'rough', 'true', 'none', 'scan', 'depth', 'low', 'high', 'narrow',
            'wide'} <= table.ROWS.keys()
    for row in table.ROWS.values():
        assert row.robot is None or (table.ROBOTS / f'{row.robot}.yaml').is_file()


def test_rows_are_measured_once_and_kept(table, monkeypatch, capsys, tmp_path):
    folder = write_small_search(tmp_path / 'model')
    common = (folder, '--houses', 2, '--episodes', 2, '--max-decisions', 3, '--out',
              tmp_path / 'rows')
    rows = ('absent', 'random', 'low', 'narrow', 'wide')
    code, first = call(table, monkeypatch, capsys, *common, '--rows', *rows)
    assert code == 0
    lines = [line for line in first.out.splitlines() if line.startswith('|')]
    assert len(lines) == 2 + len(rows) and len({line.count('|') for line in lines}) == 1
    assert [line.split('|')[1].strip() for line in lines[2:]] == [
        table.ROWS[name].title for name in table.ROWS if name in rows]
    kept = {path.stem: path.read_bytes() for path in (tmp_path / 'rows').iterdir()}
    assert kept.keys() == set(rows)
    low = json.loads(kept['low'])
    assert low['conditions']['camera'] == 'low' and low['figures'].keys() == {'declared'}
    assert json.loads(kept['random'])['figures'].keys() == {'arrival', 'declared'}

    monkeypatch.setattr(table, 'measured', lambda *_: pytest.fail('measured again'))
    code, again = call(table, monkeypatch, capsys, *common, '--rows', *rows)
    assert code == 0 and again.out.splitlines() == lines
    assert kept == {path.stem: path.read_bytes() for path in (tmp_path / 'rows').iterdir()}
    # Of another number of episodes nothing has been measured.
    code, other = call(table, monkeypatch, capsys, *common, '--seed', 5, '--print')
    assert code == 0 and len(other.out.splitlines()) == 2


def test_what_cannot_be_measured_is_said_and_the_rest_goes_on(table, monkeypatch, capsys,
                                                              tmp_path):
    folder = write_small_search(tmp_path / 'model')

    def refuse(row, *_):
        raise table.UserError('a rule', row.title, 'a remedy')
    monkeypatch.setattr(table, 'measured', refuse)
    code, done = call(table, monkeypatch, capsys, folder, '--out', tmp_path / 'rows', '--rows',
                      'low', 'wide')
    assert code == 1 and done.err.count('a rule') == 2
    code, done = call(table, monkeypatch, capsys, tmp_path / 'nowhere')
    assert code == 2 and 'checkpoint' in done.err

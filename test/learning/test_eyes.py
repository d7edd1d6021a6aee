"""`bench/eyes.py`: a table of what the networks of search see."""

import importlib.util
import sys

from paths import ROOT
from small_search import write_small_search


def test_a_row_without_and_one_with_mirror_images(monkeypatch, capsys, tmp_path):
    spec = importlib.util.spec_from_file_location('eyes', ROOT / 'bench' / 'eyes.py')
    eyes = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(eyes)
    folder = write_small_search(tmp_path / 'model')

    def call(*words):
        monkeypatch.setattr(sys, 'argv', ['eyes.py', *map(str, words)])
        return eyes.main(), capsys.readouterr()
    code, said = call(folder, '--groups', 12)
    lines = [[cell.strip() for cell in line.split('|')] for line in said.out.splitlines()]
    assert code == 0 and [line[2] for line in lines] == ['mirrored', '---', 'no', 'yes']
    assert lines[2][3:] != lines[3][3:]
    code, said = call(ROOT / 'models' / 'house')
    assert code == 2 and 'architecture search' in said.err and said.err.count('\n') == 1

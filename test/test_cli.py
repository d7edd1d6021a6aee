"""The command line: bad input is one line, exit code 2, and nothing half-written."""

import subprocess
import sys

import cv2
import pytest
from ros_harness import write_checkpoint

from vn_nav.cli import main
from vn_nav.policy.checkpoint import CONFIG


def run(*words):
    return subprocess.run([sys.executable, '-m', 'vn_nav.cli', *map(str, words)],
                          capture_output=True, text=True, timeout=100)


@pytest.mark.parametrize('words, expected', [
    (['evaluate', '/nowhere'], 'checkpoint'),
    (['train', '--backend', 'thor', '--out', 'OUT'], 'backend'),
    (['train', '--rooms', '99', '--out', 'OUT'], 'rooms'),
    (['train', '--house', '-1', '--out', 'OUT'], 'seed'),
    (['train', '--frames', '0', '--out', 'OUT'], 'frame'),
    (['train', '--resume', '--out', 'OUT'], 'resume'),
    (['demo', '--checkpoint', '/nowhere', '--out', 'OUT'], 'checkpoint'),
    (['demo', '--episodes', '0', '--out', 'OUT'], 'episode'),
])
def test_bad_input_is_one_line(tmp_path, words, expected):
    out = tmp_path / 'out'
    done = run(*[out if word == 'OUT' else word for word in words])
    assert done.returncode == 2, done.stderr
    assert len(done.stderr.strip().splitlines()) == 1, done.stderr
    assert expected in done.stderr and 'received' in done.stderr
    assert not out.exists()


def test_another_world_version_is_refused_with_the_remedy(tmp_path, capsys):
    folder = write_checkpoint(tmp_path / 'model', size=36)
    config = (folder / CONFIG).read_text()
    (folder / CONFIG).write_text(config.replace('"world_version": "1"', '"world_version": "0"'))
    for words in (['evaluate', str(folder)],
                  ['demo', '--checkpoint', str(folder), '--out', str(tmp_path / 'demo')]):
        assert main(words) == 2
        message = capsys.readouterr().err
        assert 'world version' in message and 'vn_nav train' in message
    assert not (tmp_path / 'demo').exists()


def test_evaluate_prints_figures(tmp_path, capsys):
    folder = write_checkpoint(tmp_path / 'model', size=36)
    assert main(['evaluate', str(folder), '--episodes', '6', '--max-decisions', '20',
                 '--json', str(tmp_path / 'figures.json')]) == 0
    assert 'shortest path' in capsys.readouterr().out
    assert (tmp_path / 'figures.json').exists()


def test_house_show_writes_a_picture(tmp_path, capsys):
    path = tmp_path / 'house.png'
    assert main(['house', 'show', '--seed', '3', '--rooms', '4', '--out', str(path)]) == 0
    assert '4 rooms' in capsys.readouterr().out
    picture = cv2.imread(str(path))
    assert picture.shape[1] == 1200 and picture.std() > 30
    assert main(['house', 'show', '--out', str(tmp_path / 'house.txt')]) == 2
    assert 'received' in capsys.readouterr().err

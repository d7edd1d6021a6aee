"""The command line: bad input is one line, exit code 2, and nothing half-written."""

import subprocess
import sys

import cv2
import pytest
from ros_harness import write_checkpoint

from vn_nav.cli import main
from vn_nav.policy.checkpoint import CONFIG
from vn_sim_bridge.world import WORLD_VERSION


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
    (folder / CONFIG).write_text(config.replace(f'"world_version": "{WORLD_VERSION}"',
                                                '"world_version": "0"'))
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


def test_a_policy_for_another_robot(tmp_path, capsys):
    """Other step sizes, camera and actions: trained, evaluated, and refused on the wrong robot."""
    robot = tmp_path / 'low.yaml'
    robot.write_text("""
name: low
camera_height: 0.4
camera_fov_deg: 75
actions:
  - {name: forward, dx: 0.25}
  - {name: rotate_left, dyaw_deg: 20}
  - {name: rotate_right, dyaw_deg: -20}
  - {name: look_up, dpitch_deg: -15}
  - {name: look_down, dpitch_deg: 15}
""")
    names = 'forward,rotate_left,rotate_right,look_up,look_down'
    run_folder = tmp_path / 'run'
    assert main(['train', '--robot', str(robot), '--actions', names, '--envs', '4', '--size', '36',
                 '--frames', '200', '--rooms', '2', '--no-tensorboard',
                 '--out', str(run_folder)]) == 0
    checkpoint = str(run_folder / 'checkpoint')
    common = ['evaluate', checkpoint, '--episodes', '4', '--max-decisions', '10']
    assert main([*common, '--robot', str(robot)]) == 0
    capsys.readouterr()
    assert main(common) == 2
    assert 'camera' in capsys.readouterr().err
    assert main(['train', '--actions', 'fly,crawl', '--out', str(tmp_path / 'none')]) == 2
    assert "'fly'" in capsys.readouterr().err

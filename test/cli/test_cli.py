"""The command line: bad input is one line, exit code 2, and nothing half-written."""

import json
import signal
import subprocess
import sys

import cv2
import pytest
from ros_harness import write_checkpoint

from vn_nav.cli import main
from vn_nav.policy.checkpoint import CONFIG
from vn_sim_bridge.simulators.house import WORLD_VERSION


def run(*words):
    return subprocess.run([sys.executable, '-m', 'vn_nav.cli', *map(str, words)],
                          capture_output=True, text=True, timeout=100)


def test_a_reader_that_goes_away_ends_a_command_without_a_traceback():
    with subprocess.Popen([sys.executable, '-m', 'vn_nav.cli', 'simulators'], text=True,
                          stdout=subprocess.PIPE, stderr=subprocess.PIPE) as command:
        command.stdout.close()
        assert command.stderr.read() == ''
    assert command.returncode == 128 + signal.SIGPIPE


def _config(folder):
    """What config.json says, to be changed on purpose: without its checksum."""
    config = json.loads((folder / CONFIG).read_text())
    del config['config_sha256']
    return config


@pytest.mark.parametrize('words, expected', [
    (['evaluate', '/nowhere'], 'checkpoint'),
    (['evaluate', 'models/house', '--episodes', '0'], 'episode'),
    (['evaluate', 'models/house', '--houses', '0'], 'house'),
    (['evaluate', 'models/house', '--split', 'moon'], 'unseen_look'),
    (['evaluate', 'models/house', '--split', 'test', '--house', '3'], 'by name or by split'),
    (['evaluate', 'models/house', '--stop-threshold', '1'], 'threshold'),
    (['evaluate', 'models/house', '--html', 'OUT/page.html'], 'folder'),
    (['evaluate', 'models/house', '--bag', '/nowhere'], 'a recording'),
    (['evaluate', 'models/house', '--bag', 'bags/house_drive', '--rooms', '5'], '--rooms'),
    (['evaluate', 'models/house', '--bag', 'bags/house_drive', '--split', 'test'], 'seen_goals'),
    (['evaluate', 'models/house', '--bag', 'bags/house_drive', '--goals', '1'], 'four goals'),
    (['evaluate', 'models/house', '--margin', '0.2'], 'give --bag'),
    (['evaluate', 'models/house', '--odometry', 'true'], 'policies that use it'),
    (['evaluate', 'models/house', '--robot', 'bench/robots/narrow.yaml'], '90 deg'),
    (['evaluate', 'models/house', '--verify', 'sift'], 'another architecture'),
    (['evaluate', 'models/search', '--verify', 'sift', '--bag', 'bags/house_drive'],
     'full pictures'),
    (['film', '/nowhere', '--out', 'OUT.gif'], 'checkpoint'),
    (['film', 'models/search', '--out', 'OUT.png'], '.gif'),
    (['film', 'models/search', '--out', 'OUT/film.gif'], 'folder'),
    (['film', 'models/house', '--scene', 'house:7?rooms=1', '--stop', 'arrival', '--out',
      'OUT.gif'], 'searches'),
    (['compare', '/nowhere', '--out', 'OUT'], '.html'),
    (['train', '--backend', 'thor', '--out', 'OUT'], 'backend'),
    (['train', '--rooms', '99', '--out', 'OUT'], 'rooms'),
    (['train', '--house', '-1', '--out', 'OUT'], 'seed'),
    (['train', '--frames', '0', '--out', 'OUT'], 'frame'),
    (['train', '--resume', '--out', 'OUT'], 'resume'),
    (['demo', '--checkpoint', '/nowhere', '--out', 'OUT'], 'checkpoint'),
    (['demo', '--episodes', '0', '--out', 'OUT'], 'episode'),
    (['doctor', '--seconds', '0'], '--seconds'),
    (['doctor', '--checkpoint', '/nowhere'], 'checkpoint'),
    (['doctor', '--robot', '/nowhere'], 'robot file'),
    (['doctor', '--topics', '/nowhere'], 'YAML file'),
    (['doctor', '--set', 'seed'], 'NAME=VALUE'),
    (['doctor', '--set', 'seed=1'], 'the doctor uses'),
    (['doctor', '--set', 'max_frame_age=far'], 'max_frame_age'),
    (['doctor', '--set', 'use_sim_time=1'], 'true or false'),
    (['doctor', '--html', 'OUT/page.html'], 'folder'),
    (['doctor', '--bag', '/nowhere'], 'bag'),
    (['doctor', '--bag', 'bags/house_drive', '--base-check'], 'without a graph'),
])
def test_bad_input_is_one_line(tmp_path, capsys, words, expected):
    out = tmp_path / 'out'
    assert main([word.replace('OUT', str(out)) for word in words]) == 2
    said = capsys.readouterr().err
    assert len(said.strip().splitlines()) == 1, said
    assert expected in said and 'received' in said
    assert not out.exists()


def test_the_process_ends_with_that_line_and_exit_code_2():
    done = run('evaluate', '/nowhere')
    assert done.returncode == 2 and done.stderr.startswith('vn_nav: ')
    assert len(done.stderr.strip().splitlines()) == 1


def test_another_world_version_is_refused_with_the_remedy(tmp_path, capsys):
    folder = write_checkpoint(tmp_path / 'model', size=36)
    config = json.dumps(_config(folder))
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
    figures, page = tmp_path / 'figures.json', tmp_path / 'page.html'
    assert main(['evaluate', str(folder), '--episodes', '6', '--max-decisions', '20',
                 '--json', str(figures), '--html', str(page)]) == 0
    assert 'shortest path' in capsys.readouterr().out
    result = json.loads(figures.read_text())
    assert list(result['splits']) == ['seen_goals'] and result['decoding'] == 'sample'
    rows = result['splits']['seen_goals']['rows']['arrival']
    assert len(rows) == 7 and all(row['episodes'] == 6 for row in rows.values())
    assert page.read_text().count('<svg') == 6


def test_a_policy_of_recorded_pictures_is_measured_in_houses_that_are_named(tmp_path, capsys):
    folder = write_checkpoint(tmp_path / 'model', size=36)
    config = _config(folder)
    config |= {'world_version': 'recorded', 'houses': [], 'rooms': None}
    (folder / CONFIG).write_text(json.dumps(config))
    words = ['evaluate', str(folder), '--house', '7', '--episodes', '1', '--max-decisions', '2',
             '--no-controls']
    assert main([*words, '--rooms', '1']) == 0
    assert main(['evaluate', str(folder), '--rooms', '1']) == 2


def test_evaluate_by_split_and_house(tmp_path, capsys):
    folder = write_checkpoint(tmp_path / 'model', size=36)
    figures = tmp_path / 'figures.json'
    assert main(['evaluate', str(folder), '--episodes', '2', '--max-decisions', '5', '--split',
                 'seen_goals', '--split', 'unseen_goals', '--split', 'unseen_look', '--houses',
                 '2', '--no-controls', '--per-scene', '--json', str(figures)]) == 0
    assert '12001' in capsys.readouterr().out
    splits = json.loads(figures.read_text())['splits']
    assert {name: list(split['scenes']) for name, split in splits.items()} == {
        'seen_goals': ['house:7'], 'unseen_goals': ['house:7'],
        'unseen_look': ['house:12000', 'house:12001']}
    starts = {split['rows']['arrival']['right goal, sample']['start_distance']
              for split in splits.values()}
    assert len(starts) == 3  # other goals, other houses


def test_a_house_of_the_training_is_not_held_out(tmp_path, capsys):
    folder = write_checkpoint(tmp_path / 'model', size=36)
    config = _config(folder) | {'houses': [10_001]}
    (folder / CONFIG).write_text(json.dumps(config))
    assert main(['evaluate', str(folder), '--split', 'validation']) == 2
    message = capsys.readouterr().err
    assert '10001' in message and 'not trained in' in message


def test_a_task_without_goals_has_fewer_controls(tmp_path):
    folder = write_checkpoint(tmp_path / 'model', size=36)
    config = _config(folder) | {'task': 'collect', 'objects': 4}
    (folder / CONFIG).write_text(json.dumps(config))
    figures = tmp_path / 'figures.json'
    assert main(['evaluate', str(folder), '--episodes', '2', '--max-decisions', '5',
                 '--json', str(figures)]) == 0
    assert list(json.loads(figures.read_text())['splits']['seen_goals']['rows']['arrival']) == [
        'right goal, sample', 'right goal, greedy', 'random actions']


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
                 '--frames', '200', '--rooms', '2', '--no-tensorboard', '--pair-minutes', '0',
                 '--out', str(run_folder)]) == 0
    checkpoint = str(run_folder / 'checkpoint')
    common = ['evaluate', checkpoint, '--episodes', '4', '--max-decisions', '10']
    assert main([*common, '--robot', str(robot)]) == 0
    capsys.readouterr()
    assert main(common) == 2
    assert 'camera' in capsys.readouterr().err
    assert main(['train', '--actions', 'fly,crawl', '--out', str(tmp_path / 'none')]) == 2
    assert "'fly'" in capsys.readouterr().err

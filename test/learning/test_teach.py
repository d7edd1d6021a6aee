"""`vn_nav teach`: from a bag to a policy for the place where it was driven."""

import importlib.util
import json
import math
import re
import signal
import subprocess
import sys
import time

import cv2
import numpy as np
import pytest
import torch
from joystick_drive import ROBOT, SIZE, drive, write_bag
from paths import ROOT

from vn_nav.bags.mapping.pose_graph import between, compose
from vn_nav.cli import main
from vn_nav.errors import UserError
from vn_nav.learning.presets import preset
from vn_nav.learning.stages import Stages
from vn_nav.learning.teach_evaluation import RIGHT
from vn_nav.learning.teach_job import TeachJob
from vn_nav.learning.teach_network import OWN_LOGIT_SHARE
from vn_nav.learning.teaching import teach
from vn_nav.learning.trainer import train
from vn_nav.policy.checkpoint import load_checkpoint
from vn_sim_bridge import teach_place as place
from vn_sim_bridge.recorded.image_graph import build_graph
from vn_sim_bridge.simulators.house import WORLD_VERSION
from vn_sim_bridge.teach_place import draw_map, held_out, make_env, make_pairs


@pytest.fixture(scope='module')
def driven():
    torch.set_num_threads(1)
    return drive(100)


@pytest.fixture(scope='module')
def graph(driven):
    poses, pictures = driven
    return build_graph(pictures, poses, np.zeros(len(poses), int), ROBOT, goals=24,
                       world_version=WORLD_VERSION)


def test_a_drive_with_a_joystick_is_a_place(graph):
    """Nothing of it is cut off, robots can turn everywhere, and ways lead to all goals."""
    assert len(graph.goals) >= 12 and graph.distance_to(graph.goals[0]).maximum > 2
    assert graph.map.component.mean() > 0.99 and graph.world_version == WORLD_VERSION
    env = make_env(graph, ROBOT, 16, max_decisions=60)
    _, info = env.reset(seed=0)
    ends = []
    for _ in range(80):
        _, _, terminated, truncated, info = env.step(env.oracle_actions())
        ends += info['success'][terminated | truncated].tolist()
    assert len(ends) > 30 and np.mean(ends) > 0.95


def test_the_map_shows_pictures_and_goals(graph, tmp_path):
    draw_map(tmp_path / 'map.png', *held_out(graph))
    shown = cv2.imread(str(tmp_path / 'map.png'))[..., ::-1].reshape(-1, 3).tolist()
    colours = {tuple(pixel) for pixel in shown}
    assert {(42, 98, 201), (196, 87, 44), (120, 128, 140)} <= colours


def test_picture_pairs_come_first_and_after_the_weights_of_a_checkpoint(graph, tmp_path):
    own, others = held_out(graph)
    config = preset('fast', channels=(8, 8, 8), features=16, hidden=16, frames=64,
                    rollout_length=16, pair_minutes=0.01, bf16=False, learning_rate=1e-9,
                    final_learning_rate=1e-9)
    info = {'world_version': WORLD_VERSION, 'camera_fov_deg': 90.0, 'camera_height': 1.0}

    def trained(name, **options):
        env = make_env(own, ROBOT, 4, privileged=config.privileged, max_decisions=20)
        return load_checkpoint(train(env, config, tmp_path / name, info=info, **options)
                               ).network.state_dict()
    plain = trained('plain')
    begun = trained('begun', init=tmp_path / 'plain' / 'checkpoint',
                    pairs=lambda: make_pairs(own, others, ROBOT, 0))
    assert (tmp_path / 'begun' / 'pairs' / 'pairs.csv').is_file()
    assert not (tmp_path / 'plain' / 'pairs').exists()
    same = {name for name in plain if torch.allclose(plain[name], begun[name], atol=1e-6)}
    assert any(name.startswith('encoder') for name in plain.keys() - same)
    assert {name for name in plain if name.startswith('actor')} <= same


@pytest.mark.parametrize(('words', 'says'), [
    (['--minutes', '0'], 'some time to learn'),
    (['--goals', '1'], 'at least four goals'),
    (['--checkpoint', 'models/house', '--size', '32'], 'size is that of the checkpoint'),
    (['--checkpoint', 'nowhere'], 'a checkpoint is a folder'),
    (['--places', '1'], '2 to 1024 place cells'),
    (['--pictures', '9-3'], 'ranges in their order'),
    (['--robot', 'nowhere.yaml'], 'a robot file exists'),
    (['--topics', 'nowhere.yaml'], 'in a YAML file'),
    (['--set', 'teacher=nobody'], 'the teacher is one of'),
])
def test_bad_options_are_one_line_and_code_2(words, says, tmp_path, capsys):
    code = main(['teach', str(tmp_path / 'bag'), '--out', str(tmp_path / 'out'), *words])
    said = capsys.readouterr().err
    assert code == 2 and says in said and said.count('\n') == 1
    assert not (tmp_path / 'out').exists()


def test_a_drive_that_leads_nowhere_is_one_line_and_code_2(driven, tmp_path, capsys):
    poses, pictures = (part[:40] for part in driven)  # only turns, at the first place
    bag = write_bag(tmp_path / 'bag', poses, pictures)
    code = main(['teach', str(bag), '--out', str(tmp_path / 'out'), '--size', '36'])
    said = capsys.readouterr().err
    assert code == 2 and 'leads through a place' in said and said.count('\n') == 1
    assert not (tmp_path / 'out' / 'checkpoint').exists()


@pytest.fixture(scope='module')
def bag(driven, tmp_path_factory):
    return write_bag(tmp_path_factory.mktemp('driven') / 'bag', *driven)


def test_the_robot_needs_the_actions_of_the_checkpoint(driven, tmp_path, capsys):
    bag = write_bag(tmp_path / 'bag', *(part[:5] for part in driven))
    (tmp_path / 'robot.yaml').write_text(
        'name: short\nactions:\n- {name: forward, dx: 0.3}\n- {name: backward, dx: -0.2}\n'
        '- {name: rotate_left, dyaw_deg: 30}\n- {name: rotate_right, dyaw_deg: -30}\n')
    assert main(['teach', str(bag), '--out', str(tmp_path / 'out'), '--checkpoint',
                 'models/anywhere', '--robot', str(tmp_path / 'robot.yaml')]) == 2
    assert 'how far forward moves the robot' in capsys.readouterr().err


@pytest.fixture(scope='module')
def houses():
    """Poses and pictures of drives through two houses, each from where its odometry begins."""
    found = []
    for house in (12007, 12008):
        poses, pictures = drive(200, rooms=3, house=house, size=96)
        found.append((between(poses[:1], poses), pictures))
    return found


@pytest.mark.slow
@pytest.mark.parametrize('joint', ['odometry starts again', 'odometry goes on'])
def test_two_houses_are_no_one_place(joint, houses, tmp_path, capsys):
    """They are refused with the pictures of each; one of them alone can be learned."""
    (one, first), (other, second) = houses
    if joint == 'odometry goes on':
        other = np.array([compose(one[-1], pose) for pose in other])
    bag = write_bag(tmp_path / 'bag', np.concatenate([one, other]),
                    np.concatenate([first, second]))
    words = ['teach', str(bag), '--out', str(tmp_path / 'out'), '--checkpoint', 'models/anywhere',
             '--minutes', '0.05', '--episodes', '1']
    assert main(words) == 2
    said = capsys.readouterr().err
    assert '2 that have nothing in common' in said and said.count('\n') == 1
    assert not (tmp_path / 'out' / 'checkpoint').exists()
    own = re.search(r'learn one place with --pictures (\d+)-(\d+)', said)
    assert own[1] == '1' and abs(int(own[2]) - len(one)) <= 20
    assert main([*words, '--pictures', f'{own[1]}-{len(one)}']) == 0
    assert 'moved by up to' in capsys.readouterr().out
    info = load_checkpoint(tmp_path / 'out' / 'checkpoint').info
    assert f'pictures 1-{len(one)}' in info['notes'] and 'recorded pictures' in info['data']
    assert 'no episode was driven' in (tmp_path / 'out' / 'checkpoint' / 'README.md').read_text()
    # Odometry alone shows a jump, and what goes on it cannot tell apart.
    assert main(['evaluate', 'models/anywhere', '--bag', str(bag), '--no-straighten', '--episodes',
                 '1', '--max-decisions', '2', '--no-controls']) == (
                     2 if joint == 'odometry starts again' else 0)


def test_a_signal_ends_a_stage_between_two_steps_and_a_second_one_at_once(capsys):
    before = signal.getsignal(signal.SIGINT)
    with Stages(1.0) as stages:
        stages('learning', 0.0)
        signal.raise_signal(signal.SIGINT)
        done = True  # what is under way is not torn apart
        with pytest.raises(KeyboardInterrupt):
            stages('learning', 0.5)
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGTERM)
    assert done and signal.getsignal(signal.SIGINT) is before
    assert 0 < stages.left < 60 and 'of 1 min · learning' in capsys.readouterr().out


@pytest.mark.slow
@pytest.mark.timeout(300)
@pytest.mark.parametrize(('sign', 'kept'), [
    ('learning the place', 'not measured'), ('learning paths', 'not measured'),
    ('arrival · right goal', 'of 20 rows')])
def test_after_sigint_there_is_a_whole_checkpoint_and_the_rows_so_far(sign, kept, bag, tmp_path):
    out = tmp_path / 'out'
    with open(tmp_path / 'said', 'w') as said:
        process = subprocess.Popen(
            [sys.executable, '-m', 'vn_nav.cli', 'teach', str(bag), '--out', str(out),
             '--checkpoint', 'models/anywhere', '--goals', '8', '--cache', str(tmp_path / 'cache'),
             '--minutes', '10' if sign == 'learning the place' else '2'], stdout=said,
            stderr=subprocess.STDOUT)
    try:
        until = time.monotonic() + 240
        while sign not in (tmp_path / 'said').read_text():
            assert process.poll() is None and time.monotonic() < until
            time.sleep(0.05)
        process.send_signal(signal.SIGINT)
        assert process.wait(60) == 130
    finally:
        process.kill()
    words = (tmp_path / 'said').read_text()
    assert kept in words and 'Traceback' not in words
    taught = load_checkpoint(out / 'checkpoint')
    if kept == 'of 20 rows':
        rows = json.loads((out / 'evaluation.json').read_text())['splits']['seen_goals']['rows']
        assert RIGHT in rows['arrival'] and any('seen_goals' in name for name in
                                                taught.info['results'])
        assert '<svg' in (out / 'evaluation.html').read_text()
    else:
        assert not (out / 'evaluation.json').exists()


@pytest.mark.slow
@pytest.mark.timeout(1200)
def test_minutes_in_the_pictures_of_a_drive_beat_chance(tmp_path, capsys):
    bag = write_bag(tmp_path / 'bag', *drive(160, rooms=2))
    out = tmp_path / 'out'
    assert main(['teach', str(bag), '--out', str(out), '--size', str(SIZE), '--minutes', '2.5',
                 '--goals', '12', '--envs', '32', '--set', 'hidden=128', '--set', 'features=128',
                 '--episodes', '32']) == 0
    result = json.loads((out / 'evaluation.json').read_text())
    rows = result['splits']['seen_goals']['rows']['arrival']
    success = {name: row['success'] for name, row in rows.items()}
    assert success['right goal, sample'] > success['random actions'] + 0.2
    assert success['shortest path'] > 0.95
    said = capsys.readouterr().out
    assert 'learning' in said and 'evaluation' in said and '2.5 minutes: reading the bag' in said
    loaded = load_checkpoint(out / 'checkpoint')
    assert loaded.config.size == SIZE and loaded.info['world_version'] == WORLD_VERSION
    assert loaded.info['stop_threshold'] == 0.5 and 'Taught in the pictures' in (
        loaded.info['notes'])
    assert any('unseen_goals' in name for name in loaded.info['results'])
    assert '<svg' in (out / 'evaluation.html').read_text() and (out / 'map.png').is_file()
    assert math.isclose(loaded.info['camera_fov_deg'], 90)
    with pytest.raises(UserError, match='a folder of its own'):
        raise_of(bag, out)


@pytest.mark.slow  # the evaluation
def test_a_policy_that_is_given_learns_the_place_by_heart(driven, tmp_path, capsys):
    """Spots and ways alone: nothing that it has learned elsewhere changes but how it counts."""
    bag, out = write_bag(tmp_path / 'bag', *driven), tmp_path / 'out'
    given = load_checkpoint('models/anywhere')
    assert main(['teach', str(bag), '--out', str(out), '--checkpoint', 'models/anywhere',
                 '--minutes', '1.5', '--goals', '8', '--episodes', '1']) == 0
    said = capsys.readouterr().out
    assert 'the advised action loses' in said and 'on others' in said
    taught = load_checkpoint(out / 'checkpoint')
    assert 2 <= taught.config.places <= 64 and taught.config.moves == given.config.moves
    before, after = given.network.state_dict(), taught.network.state_dict()
    for name, tensor in before.items():
        mine = after[name][:, :tensor.shape[1]] if name == 'memory.input_weight' else after[name]
        share = OWN_LOGIT_SHARE if name.startswith('actor') else 1
        assert torch.allclose(mine, tensor * share), name
    # On a loaded machine the minutes may be over before that row: then it says so.
    page = (out / 'evaluation.html').read_text()
    assert 'before teaching' in page or 'evaluation are left out' in ' '.join(said.split())
    # Taught once more, it counts no less than before.
    assert main(['teach', str(bag), '--out', str(tmp_path / 'again'), '--checkpoint',
                 str(out / 'checkpoint'), '--minutes', '0.05', '--goals', '8', '--episodes',
                 '1']) == 0
    again = load_checkpoint(tmp_path / 'again' / 'checkpoint').network
    assert torch.equal(again.actor.weight, taught.network.actor.weight)


@pytest.mark.slow
def test_a_drive_is_taught_from_python(driven, tmp_path):
    """As examples/pretrain_and_teach.py does it."""
    spec = importlib.util.spec_from_file_location(
        'pretrain_and_teach', ROOT / 'examples' / 'pretrain_and_teach.py')
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    write_bag(tmp_path / 'bag', *driven)
    folder = module.main(str(tmp_path / 'bag'), str(tmp_path / 'runs'), 0.1, epochs=1, size=SIZE,
                         episodes=2)
    taught = load_checkpoint(folder)
    assert taught.config.hidden == 128 and taught.config.places and taught.info['command'] == ''
    before = load_checkpoint(tmp_path / 'runs' / 'pretrained' / 'checkpoint')
    assert before.info['losses'] and torch.equal(before.network.critic.weight,
                                                 taught.network.critic.weight)
    assert (tmp_path / 'runs' / 'taught' / 'evaluation.json').is_file()


@pytest.mark.parametrize('fields, rule', [
    ({'minutes': 0}, 'some time to learn'), ({'episodes': 0}, 'at least one episode'),
    ({'places': 1}, '2 to 1024'), ({'envs': 0}, 'at least one robot'),
    ({'size': 84, 'checkpoint': 'models/house'}, 'size is that of the checkpoint')])
def test_a_job_that_cannot_be_done_is_refused_where_it_is_written(fields, rule):
    with pytest.raises(UserError, match=rule):
        TeachJob('bag', 'out', **fields)


def test_numbers_of_a_training_that_do_not_exist_are_refused(tmp_path):
    with pytest.raises(UserError, match='a training has only the numbers .*nonsense'):
        teach(TeachJob('bag', tmp_path / 'out', changes={'nonsense': 1}), place)
    assert not (tmp_path / 'out').exists()


def raise_of(bag, out):
    """Teach again where something was taught already."""
    teach(TeachJob(bag, out), place)

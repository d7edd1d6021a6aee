"""`vn_nav publish`: half precision, a stop threshold, figures by split, a whole card."""

import json

import pytest
import safetensors
import torch
from ros_harness import write_checkpoint
from small_search import write_small_search

from vn_nav.cli import main
from vn_nav.cli.publish import SEARCH_THRESHOLDS, threshold_scenes
from vn_nav.policy.checkpoint import load_checkpoint

PAIRS = {'loss': -0.8, 'bearing_deg': 11.2}  # what a training of the networks of search measures


def publish(source, target, *words):
    return main(['publish', str(source), str(target), *map(str, words)])


def said_in_one_line(capsys):
    said = capsys.readouterr().err
    assert len(said.strip().splitlines()) == 1, said
    return said


@pytest.mark.slow
def test_a_policy_that_searches_is_published_with_a_row_for_each_split_and_control(
        tmp_path, capsys):
    source = write_small_search(
        tmp_path / 'run', results={'held-out pairs': PAIRS}, stop_threshold=None,
        notes='Trained here. Measured with `vn_nav publish`, years ago. Figures are defined in '
        'docs/architecture.md. One seed.')
    target = tmp_path / 'model'
    assert publish(source, target, '--split', 'validation', '--houses', 1, '--episodes', 1) == 0
    shipped = load_checkpoint(target)
    assert shipped.info['decoding'] == 'greedy'
    assert shipped.info['stop_threshold'] in SEARCH_THRESHOLDS
    results = shipped.info['results']
    assert results['held-out pairs'] == PAIRS
    driven = {name: row for name, row in results.items() if name != 'held-out pairs'}
    rows = ['right goal, greedy', 'wrong goal', 'blank goal', 'random actions', 'explorer',
            'shortest path']
    assert list(driven) == [f'1 house, validation split: {kind}{row}'
                            for kind in ('', 'declared stop, ') for row in rows]
    assert all(row['episodes'] == 1 for row in driven.values())
    assert driven['1 house, validation split: shortest path']['success'] == 1.0

    with safetensors.safe_open(target / 'model.safetensors', 'pt') as weights:
        assert {weights.get_tensor(name).dtype for name in weights.keys()} == {torch.float16}
    said = capsys.readouterr().out
    assert said.count('declaring above') == len(SEARCH_THRESHOLDS)
    notes = shipped.info['notes']
    assert notes.startswith('Trained here. One seed. Measured with `vn_nav publish`, 1 episodes')
    assert 'odometry: drift' in notes and 'years ago' not in notes
    assert 'in 1 scene of the training split that it was not trained in' in notes
    card = (target / 'README.md').read_text()
    assert '| | loss | bearing deg |\n|---|---|---|\n| held-out pairs | -0.8 | 11.2 |\n\n' in card
    assert '| 1 house, validation split: declared stop, wrong goal | 1 |' in card


@pytest.mark.slow
def test_a_threshold_that_is_given_or_kept_is_not_chosen(tmp_path, capsys):
    source = write_checkpoint(tmp_path / 'run', size=36, arrival=0.9, stop_threshold=0.6)
    words = ('--split', 'test', '--houses', 1, '--episodes', 1)
    assert publish(source, tmp_path / 'kept', *words, '--keep-threshold') == 0
    assert publish(source, source, *words, '--stop-threshold', 0.7, '--notes', 'By hand.') == 0
    assert 'declaring above' not in capsys.readouterr().out
    assert load_checkpoint(tmp_path / 'kept').info['stop_threshold'] == 0.6
    itself = load_checkpoint(source)  # published in its own place
    assert itself.info['stop_threshold'] == 0.7
    assert itself.info['notes'].startswith('By hand. Measured with')


@pytest.mark.slow
def test_a_policy_of_one_house_is_published_with_the_house_and_one_held_out(tmp_path):
    source, target = write_checkpoint(tmp_path / 'run', size=36), tmp_path / 'model'
    assert publish(source, target, '--unseen', 8, '--episodes', 1) == 0
    results = json.loads((target / 'config.json').read_text())['results']
    assert {name.split(':')[0] for name in results} == {'trained house', 'unseen house 8'}


@pytest.mark.parametrize('words, expected', [
    ((), 'neither'),
    (('--unseen', '8', '--split', 'test'), '--unseen and --split'),
    (('--unseen', '8', '--houses', '3'), 'without --split'),
    (('--split', 'test', '--houses', '0'), 'at least one scene'),
    (('--split', 'moon'), 'unseen_look'),
    (('--split', 'test', '--episodes', '0'), 'at least one episode'),
    (('--split', 'test', '--stop-threshold', '1'), 'stop threshold'),
    (('--split', 'test', '--keep-threshold'), 'a threshold that is kept'),
    (('--unseen', '7'), 'not trained in'),
])
def test_what_cannot_be_published_is_refused_before_anything_is_measured(
        tmp_path, capsys, words, expected):
    source = write_small_search(tmp_path / 'run', stop_threshold=None)
    assert publish(source, tmp_path / 'model', *words) == 2
    assert expected in said_in_one_line(capsys)
    assert not (tmp_path / 'model').exists()


def test_a_folder_that_cannot_be_written_is_refused_first(tmp_path, capsys):
    source = write_small_search(tmp_path / 'run', stop_threshold=0.9)
    (tmp_path / 'file').touch()
    assert publish(source, tmp_path / 'file' / 'model', '--split', 'test') == 2
    assert 'may be written' in said_in_one_line(capsys)


def test_a_threshold_is_for_a_policy_that_declares(tmp_path, capsys):
    source = write_checkpoint(tmp_path / 'run', size=36)
    assert publish(source, tmp_path / 'model', '--split', 'test', '--stop-threshold', '0.5') == 2
    assert 'head arrival' in said_in_one_line(capsys)


def test_the_threshold_is_chosen_in_houses_that_no_figure_is_from():
    info = {'simulator': 'house', 'scenes': [f'house:{seed}' for seed in range(1024)]}
    assert threshold_scenes(info, ['house:1024', 'house:11000'], 2, others=True) == [
        'house:1025', 'house:1026']
    assert threshold_scenes(info, ['house:8'], 2, others=False) == ['house:0', 'house:1']
    small = info | {'scenes': ['house:0?rooms=2']}
    assert threshold_scenes(small, [], 1, others=True) == ['house:1?rooms=2']
    # Without a split for training there are the scenes of the training.
    corridor = {'simulator': 'examples.corridor', 'scenes': ['examples.corridor:5']}
    assert threshold_scenes(corridor, [], 2, others=True) == ['examples.corridor:5']

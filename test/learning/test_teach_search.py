"""`vn_nav teach` of a policy that searches: from a recorded drive to a place that it recalls."""

import json

import numpy as np
import pytest
import torch
from joystick_drive import drive, write_bag

from vn_nav.arrival import wrap_angle
from vn_nav.cli import main
from vn_nav.policy.checkpoint import load_checkpoint
from vn_nav.policy.runtime import PolicyRuntime
from vn_nav.policy.search.key_pictures import KeyPictures
from vn_nav.policy.search.taught import TaughtPlace
from vn_nav.policy.search.torch_eyes import TorchEyes

SEARCH = 'models/search'
pytestmark = pytest.mark.timeout(400)  # one run of the command, for all of them


@pytest.fixture(scope='module')
def driven():
    torch.set_num_threads(1)
    return drive(100, size=64)


@pytest.fixture(scope='module')
def taught(driven, tmp_path_factory):
    """A run on the drive's bag; its odometry is true."""
    folder = tmp_path_factory.mktemp('search')
    bag = write_bag(folder / 'bag', *driven)
    assert main(['teach', str(bag), '--out', str(folder / 'run'), '--checkpoint', SEARCH,
                 '--no-straighten', '--minutes', '0.1', '--episodes', '1', '--goals', '12']) == 0
    return folder / 'run'


def test_it_keeps_the_weights_and_learns_the_place(taught, driven):
    before, after = (load_checkpoint(folder) for folder in (SEARCH, taught / 'checkpoint'))
    assert isinstance(after.network.taught, TaughtPlace) and before.network.taught is None
    for name, tensor in before.network.state_dict().items():
        assert torch.equal(tensor, after.network.state_dict()[name])
    assert after.info['stop_threshold'] == before.info['stop_threshold']
    assert after.info['preset'] == 'search' and 'recorded pictures' in after.info['data']
    poses, pictures = driven
    place = after.network.taught
    assert 20 < len(place.poses) < len(poses)
    for picture, pose in list(zip(place.pictures, place.poses, strict=True))[::9]:
        same = np.flatnonzero((pictures == picture).all(axis=(1, 2, 3)))
        assert np.abs(poses[same] - pose).min(axis=0) == pytest.approx(0, abs=1e-3)


def test_it_is_measured_on_goals_that_are_no_key_pictures(taught):
    result = json.loads((taught / 'evaluation.json').read_text())
    rows = result['splits']['seen_goals']['rows']['arrival']
    assert rows['right goal, sample']['episodes'] == 1
    info = load_checkpoint(taught / 'checkpoint').info
    assert any('seen_goals' in name for name in info['results'])


def test_it_knows_where_pictures_between_the_key_pictures_were_taken(taught, driven):
    network = load_checkpoint(taught / 'checkpoint').network
    keys = KeyPictures(TorchEyes(network), network.taught)
    known = {picture.tobytes() for picture in network.taught.pictures}
    poses, pictures = driven
    rows = [k for k in range(60, len(poses), 23) if pictures[k].tobytes() not in known]
    off = []
    for row in rows:
        found, _ = keys.recognise(pictures[row:row + 1], None)
        gap = np.hypot(*(found[0].pose[:2] - poses[row, :2])) if found else np.inf
        turn = abs(wrap_angle(found[0].pose[2] - poses[row, 2])) if found else np.inf
        off.append((gap, np.degrees(turn)))
    assert len(off) > 10 and (np.median(off, axis=0) < (0.4, 12)).all()


def test_a_robot_recalls_map_and_goal_within_a_few_decisions(taught, driven):
    policy = PolicyRuntime(taught / 'checkpoint', stop_threshold=1.0)
    poses, pictures = driven
    goal, here = len(poses) // 2, len(poses) - 30
    policy.set_goal(pictures[goal])
    for _ in range(4):
        policy.act(pictures[here], poses[here])
    assert policy.search is not None and policy.search.recalls is not None
    recall, = policy.search.recalls
    assert recall.localiser.sure
    assert np.hypot(*(recall.localiser.poses[0].pose[:2] - poses[here, :2])) < 0.6
    assert np.hypot(*(recall.goals[0].pose[:2] - poses[goal, :2])) < 0.6
    searcher, = policy.search.searchers
    assert searcher.grid.prior is not None and searcher.hypotheses.best() is not None
    assert np.isfinite(searcher.hypotheses.best().pose).all()


@pytest.mark.parametrize(('words', 'says'), [
    (['--checkpoint', SEARCH, '--set', 'epochs=2'], 'without a training'),
    (['--set', 'architecture=search'], 'architecture search has no actor'),
])
def test_what_it_cannot_be_taught_with_is_refused(words, says, tmp_path, capsys):
    assert main(['teach', str(tmp_path / 'bag'), '--out', str(tmp_path / 'out'), *words]) == 2
    said = capsys.readouterr().err
    assert says in said and said.count('\n') == 1

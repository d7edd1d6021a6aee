"""Policies measured in the pictures of a drive, and how the time for that is divided."""

import json
import math
from types import SimpleNamespace

import pytest
import torch
from joystick_drive import SIZE, drive, write_bag
from ros_harness import write_checkpoint

from vn_nav.cli import main
from vn_nav.evaluation.evaluator import ENVIRONMENTS, SHORTEST
from vn_nav.learning.teach_evaluation import BEFORE, MIN_EPISODES, RIGHT, Cost, Row, plan, rows_of
from vn_nav.learning.teaching import Teaching
from vn_nav.policy.checkpoint import CONFIG, load_checkpoint
from vn_nav.policy.network import Policy
from vn_nav.policy.network_config import NetworkConfig
from vn_nav.robot import DRIVE_ACTIONS


@pytest.fixture(scope='module')
def bag(tmp_path_factory):
    torch.set_num_threads(1)
    return write_bag(tmp_path_factory.mktemp('driven') / 'bag', *drive(100))


@pytest.mark.slow
def test_any_checkpoint_is_measured_in_the_pictures_of_a_drive(bag, tmp_path, capsys):
    model = write_checkpoint(tmp_path / 'model', size=SIZE, arrival=0.1, stop_threshold=0.5)
    figures, page = tmp_path / 'figures.json', tmp_path / 'page.html'
    arguments = ['evaluate', str(model), '--bag', str(bag), '--cache', str(bag.parent / 'decoded'),
                 '--goals', '24', '--episodes', '8', '--max-decisions', '40', '--json',
                 str(figures)]
    assert main([*arguments, '--html', str(page)]) == 0
    assert 'all goals of bag' in capsys.readouterr().out
    result = json.loads(figures.read_text())
    assert result['bag'] == 'bag' and list(result['splits']) == ['all_goals']
    assert result['odometry'] == 'none'
    rows = result['splits']['all_goals']['rows']
    assert list(rows) == ['arrival', 'declared']
    assert all(row['episodes'] == 8 for own in rows.values() for row in own.values())
    success = {name: row['success'] for name, row in rows['arrival'].items()}
    assert success['shortest path'] > 0.8 > success['random actions']
    shown = page.read_text()
    assert shown.count('<svg') == 6 and 'House' not in shown and 'drive bag' in shown
    # A policy that uses odometry is given it there too.
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Policy, 'uses_odometry', True)
        assert main([*arguments, '--no-controls']) == 0
    assert json.loads(figures.read_text())['odometry'] == 'drift'
    # As `vn_nav teach` divides them: other goals, so other starts.
    assert main([*arguments, '--split', 'seen_goals', '--split', 'unseen_goals',
                 '--no-controls']) == 0
    splits = json.loads(figures.read_text())['splits']
    assert list(splits) == ['seen_goals', 'unseen_goals']
    own, others = (split['rows']['arrival']['right goal, sample']['start_distance']
                   for split in splits.values())
    assert own != others


@pytest.mark.slow
def test_a_drive_is_a_scene_by_its_name(bag, tmp_path):
    model, figures = write_checkpoint(tmp_path / 'model', size=SIZE), tmp_path / 'figures.json'
    assert main(['evaluate', str(model), '--scene', f'bag:{bag}', '--episodes', '4',
                 '--max-decisions', '5', '--no-controls', '--json', str(figures)]) == 0
    assert list(json.loads(figures.read_text())['splits']['scenes']['scenes']) == [f'bag:{bag}']
    assert main(['evaluate', str(model), '--scene', 'bag:/nowhere', '--episodes', '4']) == 2


@pytest.mark.parametrize(('known', 'code', 'says'), [
    ({'world_version': '0'}, 2, 'world version'), ({'world_version': 'recorded'}, 0, ''),
    ({'task': 'room'}, 2, 'knows rooms'), ({'camera_fov_deg': 60.0}, 2, 'the camera')])
def test_what_a_checkpoint_needs_to_be_measured_in_a_drive(known, code, says, bag, tmp_path,
                                                           capsys):
    model = write_checkpoint(tmp_path / 'model', size=SIZE)
    config = json.loads((model / CONFIG).read_text()) | known
    del config['config_sha256']  # changed on purpose
    (model / CONFIG).write_text(json.dumps(config))
    assert main(['evaluate', str(model), '--bag', str(bag), '--cache', str(bag.parent / 'decoded'),
                 '--goals', '8', '--episodes', '1', '--max-decisions', '2', '--no-controls',
                 '--no-straighten']) == code
    assert says in capsys.readouterr().err


def test_rows_and_episodes_are_as_many_as_there_is_time_for():
    network, before = (load_checkpoint('models/anywhere').network for _ in range(2))
    rows = rows_of(['seen_goals', 'unseen_goals'], network, before)
    assert rows[0] == Row('seen_goals', 'arrival', RIGHT) and len(rows) == 20
    assert not any(row.name == BEFORE for row in rows_of(['seen_goals'], network, None))
    # A thousandth of a second a robot.
    costs = [Cost(MIN_EPISODES, 0.01, 0.01), Cost(50, 0.055, 0.01)]

    def needed(some, envs):
        return sum(300 * (0.01 + (row.name not in (SHORTEST, 'random actions'))
                          * (0.005 + 0.001 * envs)) for row in some)
    whole = plan(rows, costs, 50, math.inf, 300)
    assert whole.episodes == 50 and whole.rows == rows and not whole.missing
    assert math.isclose(whole.seconds, needed(rows, 50))
    some = plan(rows, costs, 50, needed(rows, 20) + 0.01, 300)
    assert some.episodes == 20 and some.rows == rows
    few = plan(rows, costs, 50, needed(rows[:7], MIN_EPISODES) + 0.01, 300)
    assert few.episodes == MIN_EPISODES and few.rows == rows[:7] and few.missing == rows[7:]
    none = plan(rows, costs, 50, -1.0, 300)
    assert none.rows == rows[:1] and none.episodes == MIN_EPISODES
    assert plan(rows, costs, 3, -1.0, 300).episodes == 3
    many = plan(rows, costs, 2 * ENVIRONMENTS, math.inf, 300)  # two rounds
    assert math.isclose(many.seconds, 2 * whole.seconds)


class UsesOdometry(Policy):
    """It would, if it had a map."""

    uses_odometry = True


def test_rows_of_a_taught_place_have_the_odometry_of_whoever_uses_it():
    config = NetworkConfig(actions=DRIVE_ACTIONS, size=36, channels=(4, 4, 4), features=8,
                           hidden=8)
    plain, using = Policy(config), UsesOdometry(config)
    for network, before, odometry in ((plain, None, 'none'), (plain, plain, 'none'),
                                      (using, None, 'drift'), (plain, using, 'drift')):
        given = None if before is None else SimpleNamespace(network=before)
        assert Teaching._odometry(SimpleNamespace(given=given), network) == odometry

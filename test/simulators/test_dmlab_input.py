"""DeepMind Lab, what needs no engine: bad input in one line, installing, text maps as places."""

import numpy as np
import pytest

from vn_nav.cli import main
from vn_nav.errors import UserError
from vn_nav.robot import RobotSpec
from vn_nav.scenes import parse_scene
from vn_sim_bridge import simulators
from vn_sim_bridge.dmlab import install, maps
from vn_sim_bridge.floor.places import WalledPlace
from vn_sim_bridge.simulator import Setup
from vn_sim_bridge.simulators.dmlab import SIMULATOR, level_of

SETUP = Setup(1, RobotSpec())


@pytest.fixture
def nothing(tmp_path, monkeypatch):
    """A machine without the engine."""
    monkeypatch.setenv(install.HOME, str(tmp_path / 'none'))
    monkeypatch.delenv(install.PYTHON, raising=False)
    monkeypatch.delenv(install.MAPS, raising=False)


@pytest.mark.slow
def test_without_the_engine_it_says_at_start_what_to_do(nothing, tmp_path, capsys):
    assert main(['train', '--scene', 'dmlab:house', '--out', str(tmp_path / 'run')]) == 2
    said = capsys.readouterr().err
    assert said.count('\n') == 1 and 'vn_nav simulators install dmlab' in said
    assert main(['simulators']) == 0
    assert 'vn_nav simulators install dmlab' in capsys.readouterr().out


@pytest.mark.parametrize('scene, words', [
    ('dmlab:seekavoid_arena_01', 'assets/maps/built'),
    ('dmlab:maze?size=8', 'odd number'), ('dmlab:maze?seed=x', 'whole number'),
    ('dmlab:house?rooms=3', 'leave it out'), ('dmlab:arena?pears=3', 'leave it out')])
def test_a_scene_that_there_is_not_is_refused(nothing, scene, words):
    with pytest.raises(UserError, match=words):
        level_of(parse_scene(scene), SETUP)


def test_a_python_that_is_none_is_refused(nothing, monkeypatch, tmp_path):
    monkeypatch.setenv(install.PYTHON, str(tmp_path / 'python'))
    with pytest.raises(UserError, match=install.PYTHON):
        SIMULATOR.open([parse_scene('dmlab:house')], SETUP)


def test_debian_packages_that_are_missing_are_named_in_one_line(nothing, tmp_path, monkeypatch):
    (tmp_path / 'none' / 'bin').mkdir(parents=True)
    for name in ('installed', 'bin/python'):
        (tmp_path / 'none' / name).touch()
    monkeypatch.setattr(install, 'LIBRARIES', {'libno_such_thing.so.9': 'libno-such-thing9'})
    with pytest.raises(UserError, match='apt install libno-such-thing9'):
        install.interpreter()
    assert simulators.missing(simulators.TABLE['dmlab']) == ['libno-such-thing9']


def test_only_what_can_be_installed_is_installed(capsys):
    for name in ('house', 'no_such_thing'):
        assert main(['simulators', 'install', name]) == 2
        said = capsys.readouterr().err
        assert said.count('\n') == 1 and 'dmlab' in said


@pytest.mark.parametrize('level', [maps.arena(), maps.house(), maps.maze(3, 9), maps.maze(4, 5)])
def test_a_text_map_is_a_place(level):
    place = maps.TextPlace('dmlab:maze', level, 0.18)
    assert isinstance(place, WalledPlace)
    free = np.array([[c != '*' for c in row] for row in level.rows])
    assert not (free[0].any() or free[-1].any() or free[:, 0].any() or free[:, -1].any())
    assert level.map.count('P') == 1 and len(level.looks) == len(level.map)
    cells, _ = place.starts()
    row = len(level.rows) - 1 - (cells[:, 1] / place.side).astype(int)
    assert free[row, (cells[:, 0] / place.side).astype(int)].all()
    for i, j in np.argwhere(~free):
        x, y = place.middle(i, j)
        assert any(r.x0 < x < r.x1 and r.y0 < y < r.y1 for r, _ in place.obstacles)
    for goal in place.goals:  # all can be driven to from everywhere
        assert np.isfinite(place.distance_to(goal).at(cells)).all()


def test_a_maze_is_its_seeds():
    assert maps.maze(3, 9) == maps.maze(3, 9) != maps.maze(4, 9)

"""A route out of a recorded drive."""

import math

import numpy as np
import pytest
from joystick_drive import drive, write_bag

from vn_nav.arrival import wrap_angle
from vn_nav.bags.roles import Topics
from vn_nav.cli import main
from vn_nav.errors import UserError
from vn_nav.routes.from_bag import pictures_along, write_route
from vn_nav.routes.route import read_route


@pytest.fixture(scope='module')
def bag(tmp_path_factory):
    poses, pictures = drive(20.0)
    return write_bag(tmp_path_factory.mktemp('drive') / 'bag', poses, pictures), poses, pictures


def test_a_picture_for_every_stretch_and_turn(bag):
    folder, poses, pictures = bag
    kept = list(pictures_along(folder, Topics(), 0.5, 30.0))
    at = [int(np.abs(own.time - 0.2 * np.arange(len(poses))).argmin()) for own in kept]
    assert at[0] == 0 and len(kept) > 5
    for own, k in zip(kept, at, strict=True):
        assert np.array_equal(own.picture, pictures[k].transpose(1, 2, 0))
    for before, k in zip(at, at[1:], strict=False):
        gaps = [math.dist(poses[j, :2], poses[before, :2]) for j in range(before + 1, k + 1)]
        turns = np.degrees(np.abs(wrap_angle(poses[before + 1:k + 1, 2] - poses[before, 2])))
        assert gaps[-1] >= 0.5 or turns[-1] >= 30
        assert all(gap < 0.5 and turn < 30 for gap, turn in zip(gaps[:-1], turns, strict=False))
    way = np.hypot(*np.diff(poses[:, :2], axis=0).T)
    assert kept[-1].way == pytest.approx(way[:at[-1]].sum(), abs=1e-6)
    assert len(list(pictures_along(folder, Topics(), 1.0, 90.0))) < len(kept)


def test_the_command_writes_a_route_and_a_page_and_names_places(bag, tmp_path, capsys):
    out = tmp_path / 'way'
    assert main(['route', str(bag[0]), '--out', str(out), '--name', 'kitchen=last',
                 '--name', 'desk=0']) == 0
    route = read_route(out)
    said = capsys.readouterr().out
    assert f'{len(route)} pictures along' in said and 'kitchen, desk' in said
    page = (out / 'route.html').read_text()
    assert page.count('<img') == len(route) and '<b>kitchen</b>' in page
    # More names, later.
    assert main(['route', str(out), '--name', 'shelf=2']) == 0
    assert read_route(out).places == {'kitchen': route.numbers[-1], 'desk': 0, 'shelf': 2}
    own = route.picture(0)[0].astype(int)
    first = bag[2][0].transpose(1, 2, 0).astype(int)
    assert own.shape == first.shape and np.abs(own - first).mean() < 4  # JPEG


@pytest.mark.parametrize('words, says', [
    (['BAG'], '--out'), (['BAG', '--out', 'OUT', '--every', '0'], '--every'),
    (['BAG', '--out', 'OUT', '--turn', 'nan'], '--turn'), (['BAG', '--out', '.'], 'folder'),
    (['BAG', '--out', 'OUT', '--name', 'kitchen'], 'PLACE=NUMBER'),
    (['nowhere', '--out', 'OUT'], 'nowhere')])
def test_what_it_refuses_is_one_line(bag, tmp_path, monkeypatch, capsys, words, says):
    monkeypatch.chdir(tmp_path)
    assert main(['route', *(str(bag[0]) if word == 'BAG' else word for word in words)]) == 2
    said = capsys.readouterr().err
    assert says in said and len(said.strip().splitlines()) == 1
    assert not (tmp_path / 'OUT').exists()


def test_several_drives_are_no_route(bag, tmp_path):
    poses, pictures = bag[1].copy(), bag[2]
    poses[len(poses) // 2:] += (10.0, 0.0, 0.0)  # carried elsewhere
    with pytest.raises(UserError, match='one drive'):
        write_route(write_bag(tmp_path / 'bag', poses, pictures), tmp_path / 'way', Topics())
    assert not (tmp_path / 'way').exists()

"""A route as a folder: order, names, the folders of others, and what it refuses."""

import math

import cv2
import numpy as np
import pytest

from vn_nav.errors import UserError
from vn_nav.report.route_page import route_page
from vn_nav.routes.route import is_route, read_route, with_places


def picture(path, shade=100):
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), np.full((30, 40, 3), shade, np.uint8))


@pytest.fixture
def folder(tmp_path):
    for number in (0, 1, 2, 9, 10):
        picture(tmp_path / 'route' / f'{number}.jpg', 10 * number)
    return tmp_path / 'route'


def test_pictures_are_in_the_order_of_their_numbers(folder):
    route = read_route(folder)
    assert route.numbers == (0, 1, 2, 9, 10) and len(route) == 5
    assert [path.name for path in route.files] == ['0.jpg', '1.jpg', '2.jpg', '9.jpg', '10.jpg']
    shades = [route.picture(k)[0].mean() for k in range(5)]
    assert shades == sorted(shades) and route.picture(0)[1] is None
    assert route.index('') == 4 == route.index('10') and route.name(3) == '9'


def test_a_topomap_of_vint_is_a_route(tmp_path):
    # create_topomap.py saves 0.png, 1.png, ... and navigate.py sorts by int(name.split('.')[0]).
    for number in range(12):
        picture(tmp_path / f'{number}.png')
    assert is_route(tmp_path) and read_route(tmp_path).numbers == tuple(range(12))
    (tmp_path / 'info.json').write_text('{}')  # what else stands there is none of it
    picture(tmp_path / 'overview.png')
    assert len(read_route(tmp_path)) == 12


def test_places_have_names(folder):
    route = with_places(read_route(folder), {'kitchen': '9', 'the desk': 'first'})
    assert read_route(folder) == route
    assert route.index('kitchen') == 3 and route.index('the desk') == 0
    assert route.name(3) == 'kitchen' and route.named() == 'kitchen, the desk'
    again = with_places(route, {'kitchen': 'last'})
    assert again.index('kitchen') == 4 and again.index('the desk') == 0
    shown = route_page(again, [(2.0 * k, 0.5 * k) for k in range(5)])
    assert shown.count('<img') == 5 and '<b>kitchen</b> 10' in shown and '2.0 m, 8 s' in shown


def test_the_lens_of_a_route(folder):
    (folder / 'route.yaml').write_text('camera_fov: 62.0\nplaces: {door: 2}\n')
    route = read_route(folder)
    assert route.picture(0)[1] == pytest.approx(math.radians(62))
    assert with_places(route, {'wall': '1'}).places == {'door': 2, 'wall': 1}
    assert read_route(folder).fov == pytest.approx(math.radians(62))


@pytest.mark.parametrize('text, says', [
    ('places: {door: 7}', 'door: 7'), ('places: {door: true}', 'True'), ('places: [1]', 'places'),
    ('places: {12: 1}', '12'), ("places: {'12': 1}", "'12'"), ('camera_fov: wide', 'wide'),
    ('camera_fov: 200', '200'), ('camera_fov: .nan', 'nan'), ('camera_fov: true', 'True'),
    ('kitchen: 1', 'kitchen'), ('- 1', 'mapping'), ('places: {a: 1, a: 2}', 'twice')])
def test_what_a_route_file_may_not_say(folder, text, says):
    (folder / 'route.yaml').write_text(text)
    with pytest.raises(UserError, match='route') as error:
        read_route(folder)
    assert says in str(error.value)


def test_what_is_no_route(tmp_path, folder):
    for path in (tmp_path / 'nowhere', tmp_path):
        assert not is_route(path)
        with pytest.raises(UserError, match='folder of pictures'):
            read_route(path)
    picture(folder / '02.png')
    with pytest.raises(UserError, match='2 twice'):
        read_route(folder)


def test_a_place_that_is_not_there_is_named_with_those_that_are(folder):
    route = with_places(read_route(folder), {'kitchen': '9'})
    for place in ('bath', '3', '-1', '1' * 40):
        with pytest.raises(UserError, match='kitchen'):
            route.index(place)
    for name, number in (('', '1'), ('12', '1'), (' x', '1'), ('x', '3'), ('x', '')):
        with pytest.raises(UserError):
            with_places(route, {name: number})
    assert read_route(folder).places == {'kitchen': 9}


def test_a_picture_that_cannot_be_read_is_named(folder):
    (folder / '9.jpg').write_bytes(b'\xff\xd8\xff no picture')
    with pytest.raises(UserError, match=r'9\.jpg'):
        read_route(folder).picture(3)

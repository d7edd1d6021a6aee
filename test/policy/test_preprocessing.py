"""One frame down three paths, simulator, live topic and bag, is one tensor."""

import math

import numpy as np
import pytest
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import Image

from vn_msgs_py.images import decode_rgb, fill_image
from vn_msgs_py.topics import topic
from vn_nav.bags.storage.reader import read_bag
from vn_nav.bags.storage.writer import BagWriter
from vn_nav.errors import UserError
from vn_nav.observation import OUTSIDE_GREY, preprocess, through_lens
from vn_sim_bridge.navigation.env import NavigationEnv
from vn_sim_bridge.navigation.env_config import EnvConfig

pytestmark = pytest.mark.ros


@pytest.mark.parametrize('camera', [84, 174])
def test_simulator_live_and_bag_agree(tmp_path, camera):
    env = NavigationEnv(EnvConfig(scenes=('house:7',), num_envs=3, size=camera))
    pictures = env.reset(seed=0)[0]['image']
    with BagWriter(tmp_path / 'bag', [topic('image_raw')]) as bag:
        live = []
        for n, picture in enumerate(pictures):
            data = serialize_message(fill_image(
                Image(), np.ascontiguousarray(picture.transpose(1, 2, 0)), 'rgb8'))
            bag.write('image_raw', data, n)
            live.append(preprocess(decode_rgb(deserialize_message(data, Image)), 84))
    recorded = [preprocess(decode_rgb(record.message), 84)
                for record in read_bag(tmp_path / 'bag')]
    direct = [preprocess(picture.transpose(1, 2, 0), 84) for picture in pictures]
    for one, two, three in zip(direct, live, recorded, strict=True):
        assert one.shape == (3, 84, 84)
        assert np.abs(one.astype(int) - two).max() <= 1
        assert np.abs(one.astype(int) - three).max() <= 1
    if camera == 84:
        assert np.array_equal(direct[0], pictures[0])  # nothing to do is nothing done


def test_a_wider_camera_is_cropped_and_a_narrower_one_refused():
    picture = np.zeros((100, 160, 3), np.uint8)
    picture[25:75, 55:105] = 255  # what a camera of half the tangent sees
    wide, needed = 2 * np.arctan(1.0), 2 * np.arctan(0.5)
    assert (preprocess(picture, 50, fov=wide, target_fov=needed) == 255).all()
    with pytest.raises(UserError, match='sees at least'):
        preprocess(picture, 50, fov=needed, target_fov=wide)
    with pytest.raises(UserError, match='uint8'):
        preprocess(picture.astype(float), 50)


def test_recording_into_an_existing_folder_and_reading_nothing_are_refused(tmp_path):
    (tmp_path / 'bag').mkdir()
    with pytest.raises(UserError, match='folder of its own'):
        BagWriter(tmp_path / 'bag', [topic('image_raw')])
    with pytest.raises(UserError, match='metadata.yaml'):
        list(read_bag(tmp_path / 'nothing'))


@pytest.mark.parametrize('width, height, across', [(160, 90, 70), (120, 120, 60), (90, 160, 57)])
def test_a_narrower_camera_keeps_its_width(width, height, across):
    """Against the corners of a picture, projected by hand through the network's lens."""
    focal = width / 2 / math.tan(math.radians(across) / 2)
    short = 2 * math.atan(min(width, height) / 2 / focal)
    picture = np.random.default_rng(0).integers(0, 255, (height, width, 3), np.uint8)
    found, zoom = through_lens(picture, width, fov=short, target_fov=math.radians(90))
    assert zoom == pytest.approx(1 / math.tan(math.radians(across) / 2))
    rows = np.ones(width, bool)
    if height < width:
        above = (width - height) // 2
        rows[:above] = rows[above + height:] = False
        assert (found[:, ~rows] == OUTSIDE_GREY).all()
    below = max(height - width, 0) // 2
    shown = picture[below:below + min(height, width)]
    assert np.array_equal(found[:, rows], shown.transpose(2, 0, 1))  # not a pixel is lost across


def test_a_wide_camera_is_cropped_across_and_may_be_low():
    picture = np.full((67, 120, 3), 255, np.uint8)
    short = 2 * math.atan(67 / 120 * math.tan(math.radians(100) / 2))
    found, zoom = through_lens(picture, 60, fov=short, target_fov=math.radians(90))
    assert zoom == 1.0
    bright = (found > 200).all(0).all(1).mean()  # rows: what 90 deg of width leave of the height
    assert abs(bright - 67 / (120 / math.tan(math.radians(50)))) < 0.05
    square = np.random.default_rng(0).integers(0, 255, (100, 160, 3), np.uint8)
    lens = {'fov': math.radians(100), 'target_fov': math.radians(90)}
    with pytest.raises(UserError, match='50 to 120 deg horizontally'):  # 125 across
        through_lens(square, 60, **lens)
    square = square[:, 30:130]
    assert np.array_equal(through_lens(square, 60, **lens)[0], preprocess(square, 60, **lens))
    for fov in (45, 125):
        with pytest.raises(UserError, match='use another lens'):
            through_lens(square, 60, fov=math.radians(fov), target_fov=math.radians(90))


@pytest.mark.parametrize('fov', [55, 70, 100])
def test_a_goal_of_another_camera_gets_the_zoom_of_the_robots(fov):
    size, zoom = 64, 1.5
    tangent = math.tan(math.radians(fov) / 2)
    picture = np.zeros((400, 400, 3), np.uint8)
    across = (np.arange(400) + 0.5 - 200) / 200 * tangent
    picture[:, np.abs(across) < 0.25] = 255  # a stripe 0.5 m wide, 1 m ahead
    found, same = through_lens(picture, size, fov=math.radians(fov),
                               target_fov=math.radians(90), zoom=zoom)
    assert same == zoom
    stripe = found[0, size // 2].astype(float)
    inside = np.abs((np.arange(size) + 0.5 - size / 2) / (size / 2) / zoom) < tangent
    assert (stripe[~inside] == OUTSIDE_GREY).all()
    assert abs((stripe[inside] / 255).sum() - 0.25 * zoom * size) < 1.5

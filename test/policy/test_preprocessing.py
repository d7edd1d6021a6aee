"""One frame down three paths, simulator, live topic and bag, is one tensor."""

import numpy as np
import pytest
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import Image

from vn_msgs_py.images import decode_rgb, fill_image
from vn_msgs_py.topics import topic
from vn_nav.bags.storage.reader import read_bag
from vn_nav.bags.storage.writer import BagWriter
from vn_nav.errors import UserError
from vn_nav.observation import preprocess
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

"""The adapter of House3D, against a small module with the calls that it makes: no renderer."""

import math
import sys
import types

import numpy as np
import pytest
from suncg_files import write_house

from vn_nav.errors import UserError
from vn_nav.robot import DRIVE_ACTIONS, RobotSpec
from vn_sim_bridge.navigation.env import NavigationEnv
from vn_sim_bridge.navigation.env_config import EnvConfig
from vn_sim_bridge.simulator import Setup
from vn_sim_bridge.simulators import open_simulator

ROBOT = RobotSpec().with_actions(DRIVE_ACTIONS)


class FakeHouse:
    """A floor of 4 x 4 m, x and z from 0 to 4, of which the agent's centre keeps 0.1 m."""

    robotHei = 0.75
    connectedCoors = [(i, j) for i in range(2, 39) for j in range(2, 39)]
    all_rooms = [{'roomTypes': ['Toilet'], 'bbox': {'min': [0, 0, 0], 'max': [4, 2, 4]}},
                 {'roomTypes': [], 'bbox': {'min': [0, 0, 0], 'max': [4, 2, 4]}}]

    def to_coor(self, x, y, shft=False):
        return x / 10, y / 10


class FakeEnvironment:
    """House3D.core.Environment: yaw [deg] from x to z; right of the view is front x up."""

    def __init__(self, api, house, config):
        self.api, self.house, self.config = api, FakeHouse(), config
        self.cam = types.SimpleNamespace(vertical_fov=60.0)
        self.reset(2.0, 2.0, 0.0)

    def reset(self, x=None, y=None, yaw=None):
        self.x, self.z, self.yaw = x, y, yaw

    @property
    def info(self):
        return {'loc': (self.x, self.z), 'yaw': self.yaw}

    def rotate(self, deg):
        self.yaw += deg

    def move_forward(self, dist_fwd, dist_hor=0):
        c, s = math.cos(math.radians(self.yaw)), math.sin(math.radians(self.yaw))
        x, z = self.x + c * dist_fwd - s * dist_hor, self.z + s * dist_fwd + c * dist_hor
        if not (0.1 <= x <= 3.9 and 0.1 <= z <= 3.9):
            return False
        self.x, self.z = x, z
        return True

    def render(self, mode=None):
        picture = np.zeros((self.api.h, self.api.w, 3), np.uint8)
        if mode == 'rgb':
            picture[:] = round(self.x * 50), round(self.z * 50), round(self.yaw) % 256
        elif mode == 'depth':
            picture = picture[..., :2].copy()
            picture[..., 0], picture[0, :, 1] = 51, 255  # 4 m; nothing in the first row
        else:
            picture[:], picture[0] = (0, 137, 65), (9, 9, 9)  # sofa; a colour of no class
        return picture


class FakeApi:
    def __init__(self, w, h, device=0):
        self.w, self.h = w, h


@pytest.fixture
def scene(tmp_path, monkeypatch):
    write_house(tmp_path)
    (tmp_path / 'house' / 'h' / 'house.obj').write_text('')
    colours = tmp_path / 'colours.csv'
    colours.write_text('name,r,g,b\nGround,1,2,3\nSofa,0,137,65\n')
    modules = {'': {}, '.core': {'Environment': FakeEnvironment},
               '.objrender': {'RenderAPI': FakeApi},
               '.common': {'create_default_config':
                           lambda prefix, colormap: {'colorFile': str(colours)}}}
    for name, content in modules.items():
        module = types.ModuleType(f'House3D{name}')
        vars(module).update(content)
        module.__spec__ = types.SimpleNamespace(name=f'House3D{name}')
        monkeypatch.setitem(sys.modules, f'House3D{name}', module)
    return f'house3d:h?data={tmp_path}'


def test_poses_and_moves_are_ours(scene):
    simulator = open_simulator([scene], Setup(2, ROBOT, 16))
    simulator.place(np.array([0, 1]), np.array([[1.0, -2.0, 0.0, 0.0], [1.0, -2.0, np.pi / 2, 0]]))
    motion = simulator.move(np.array([[0.5, 0.0, 0.0, 0.0]] * 2))
    assert not motion.collided.any()
    assert np.allclose(simulator.poses[:, :2], [[1.5, -2.0], [1.0, -1.5]])
    simulator.move(np.array([[0.0, 0.35, 0.0, 0.0]]), np.array([0]))  # to the left
    assert np.allclose(simulator.poses[0], [1.5, -1.65, 0, 0])
    simulator.move(np.array([[0.0, 0.0, math.radians(30), 0.0]]), np.array([1]))
    assert simulator.poses[1, 2] == pytest.approx(math.radians(120))
    assert simulator.cameras()[0].shape == (2, 5)
    simulator.close()
    simulator.close()


def test_a_move_that_is_refused_ends_at_the_contact(scene):
    simulator = open_simulator([scene], Setup(1, ROBOT, 16))
    simulator.place(np.array([0]), np.array([[3.6, -2.0, 0.0, 0.0]]))
    motion = simulator.move(np.array([[0.5, 0.0, 0.0, 0.0]]))
    assert motion.collided[0] and simulator.poses[0, 0] == pytest.approx(3.9, abs=0.011)
    assert motion.delta[0, 0] == pytest.approx(simulator.poses[0, 0] - 3.6)
    again = simulator.move(np.array([[0.5, 0.0, 0.0, 0.0]]))
    assert again.collided[0] and again.delta[0, 0] <= 0.011


def test_depth_is_metres_and_labels_are_by_colour(scene):
    simulator = open_simulator([scene], Setup(1, ROBOT, 16))
    poses = simulator.poses.copy()
    simulator.place(np.array([0]), np.array([[1.0, -3.0, 0.5, 0.0]]))
    frames = simulator.observe()
    assert (frames.depth[0, 1:] == 4.0).all() and (frames.depth[0, 0] == 0).all()
    assert simulator.label_names == ('nothing', 'ground', 'sofa')
    assert (frames.labels[0, 1:] == 2).all() and (frames.labels[0, 0] == 0).all()
    looked = simulator.view(np.array([0]), np.array([[2.0, -1.0, 0.0, 0.0]]))
    assert looked.rgb[0, :, 0, 0].tolist() == [100, 50, 0] and looked.rgb.shape == (1, 3, 16, 16)
    assert np.array_equal(simulator.observe().rgb, frames.rgb)  # nobody has moved
    assert poses.shape == (1, 4)


def test_an_environment_runs_in_it(scene):
    env = NavigationEnv(EnvConfig(scenes=(scene,), num_envs=3, size=16, max_decisions=10))
    env.reset(seed=0)
    for step in range(25):
        *_, info = env.step(np.full(3, step % 4))
    assert env.goal_rooms[0] == 'bathroom' and np.isfinite(info['distance']).all()
    env.close()


def test_what_is_missing_is_said(tmp_path, monkeypatch, scene):
    with pytest.raises(UserError, match='no .*house.obj'):
        open_simulator([scene.replace(':h?', ':other?')], Setup(1, ROBOT, 16))
    with pytest.raises(UserError, match='coarse or fine'):
        open_simulator([scene + '&labels=nyu40'], Setup(1, ROBOT, 16))
    for name in [name for name in sys.modules if name.partition('.')[0] == 'House3D']:
        monkeypatch.delitem(sys.modules, name)
    with pytest.raises(UserError, match='House3D') as told:
        open_simulator([scene], Setup(1, ROBOT, 16))
    assert '\n' not in str(told.value)

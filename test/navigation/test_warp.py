"""The kernels of the GPU, in Warp's CPU mode, against the Numba renderer and NavigationEnv."""

import dataclasses
import math
import subprocess
import sys

import numpy as np
import pytest

from vn_nav.errors import UserError
from vn_nav.scenes import house_scenes
from vn_nav.vector_env import NavigationVectorEnv
from vn_sim_bridge.counter_random import Stream, key
from vn_sim_bridge.houses.objects import object_scene
from vn_sim_bridge.houses.procedural import generate_house
from vn_sim_bridge.navigation.env import NavigationEnv
from vn_sim_bridge.navigation.env_config import EnvConfig
from vn_sim_bridge.render.pack import Lights
from vn_sim_bridge.render.randomisation import draw_appearance, load_randomisation
from vn_sim_bridge.render.rasterizer import Rasterizer
from vn_sim_bridge.render.sensor import expose
from vn_sim_bridge.simulator import Objects

pytestmark = [pytest.mark.slow, pytest.mark.timeout(300)]
COUNT = 60


def views():
    """Scenes, cameras, appearances and objects: whatever a picture can hold."""
    houses = [generate_house(seed, rooms=3 + seed % 7) for seed in (0, 5, 11, 12_003)]
    scenes = [*(house.scene for house in houses), object_scene('ball'), object_scene('vase')]
    rng = np.random.default_rng(0)
    index = np.arange(COUNT) % 4
    xy = np.array([rng.choice(houses[i].floor.centres()) for i in index])
    cameras = np.column_stack([xy, rng.uniform(0.8, 1.2, COUNT), rng.uniform(-3.1, 3.1, COUNT),
                               rng.uniform(-0.6, 0.6, COUNT)])
    look = draw_appearance(load_randomisation('rough'), 12, 0, Stream.APPEARANCE,
                           np.arange(COUNT), 0)
    objects = Objects(np.full((COUNT, 2), -1), np.zeros((COUNT, 2, 4)),
                      np.zeros((COUNT, 2), np.int64))
    objects.scene[:, 0] = 4 + np.arange(COUNT) % 2
    objects.pose[:, 0, :2] = xy + np.stack([np.cos(cameras[:, 3]), np.sin(cameras[:, 3])], axis=1)
    objects.pose[:, 0, 3] = rng.uniform(0, 6, COUNT)
    return scenes, index, cameras, look, objects


@pytest.mark.parametrize('size', [84, 174])
def test_pictures_agree_with_numba(size):
    from vn_sim_bridge.render.warp_renderer import WarpRenderer
    scenes, index, cameras, look, objects = views()
    fov, lights = math.radians(90) + look.fov, Lights(look.cube, look.lamps)
    rgb, depth, labels, instances = Rasterizer(scenes, size).render(
        index, cameras, fov, lights=lights, objects=objects)
    renderer = WarpRenderer(scenes, size, COUNT, objects=2, device='cpu')
    other = renderer.render_arrays(index, cameras, fov, lights, objects)
    assert np.array_equal(labels, other[2]) and np.array_equal(instances, other[3])
    assert np.abs(depth - other[1]).max() <= 1e-4 * depth.max()
    assert (np.abs(depth - other[1]) <= 1e-4 * depth).all()
    gap = np.abs(rgb.astype(int) - other[0].astype(int))
    assert (gap <= 2).mean() >= 0.999
    assert (instances == 65535).any()  # an object was in sight
    keys = key(0, Stream.SENSOR, np.arange(COUNT), 0)
    expose(rgb, look.noise, look.blur, keys)
    noisy = renderer.render_arrays(index, cameras, fov, lights, objects, look.noise, look.blur,
                                   keys)[0]
    assert (np.abs(rgb.astype(int) - noisy.astype(int)) <= 2).mean() >= 0.999


@pytest.mark.parametrize('mode', ['right', 'wrong', 'blank'])
def test_episodes_agree_with_the_environment(mode):
    import torch

    from vn_sim_bridge.navigation.warp_env import WarpNavigationEnv
    randomisation = dataclasses.replace(load_randomisation('rough'), late_picture=0.0)
    config = EnvConfig(
        scenes=house_scenes((7, 3, 12_001), 4), num_envs=24, size=48, max_decisions=20,
        progress_reward=1.0, collision_reward=-0.1, randomisation=randomisation,
        noise=2.0 if mode == 'wrong' else 1.0,
        goal_randomisation=load_randomisation('standard') if mode == 'right' else None,
        actions=('forward', 'backward', 'rotate_left', 'rotate_right', 'left', 'look_up'))
    host, device = NavigationEnv(config), WarpNavigationEnv(config, device='cpu')
    goals = np.abs(host.goals.astype(int) - device.goals.numpy().astype(int))
    assert (goals <= 2).mean() >= 0.999 and host.blank_goal == device.blank_goal
    for env in (host, device):
        env.set_shown_goal(mode)
        env.set_difficulty(0.6)
        env.reset(seed=5)
    rng = np.random.default_rng(0)
    ended = touched = 0
    for step in range(60):
        actions = host.oracle_actions() if step % 3 else rng.integers(0, 6, 24)
        seen, reward, terminated, truncated, info = host.step(actions)
        other, *rest, facts = device.step(torch.from_numpy(actions))
        assert np.abs(reward - rest[0].numpy()).max() < 1e-5
        assert np.array_equal(terminated, rest[1].numpy())
        assert np.array_equal(truncated, rest[2].numpy())
        for part in ('goal_index', 'last_action', 'last_reward'):
            assert np.array_equal(seen[part], other[part].numpy()), part
        for part in ('reset', 'collided', 'goal', 'decisions'):
            assert np.array_equal(info[part], facts[part].numpy()), part
        assert np.abs(info['pose'] - facts['pose'].numpy()).max() < 1e-9
        assert np.allclose(info['distance'], facts['distance'].numpy(), atol=1e-5)
        gap = np.abs(seen['image'].astype(int) - other['image'].numpy().astype(int))
        assert (gap <= 2).mean() >= 0.999
        ended += int((terminated | truncated).sum())
        touched += int(info['collided'].sum())
    assert ended > 24 and touched > 0


def test_observations_share_the_devices_memory():
    import torch

    from vn_sim_bridge.navigation.warp_env import WarpNavigationEnv
    env = WarpNavigationEnv(EnvConfig(scenes=('house:7?rooms=1',), num_envs=2, size=32),
                            device='cpu')
    assert isinstance(env, NavigationVectorEnv) and env.simulator_name == 'house'
    observation, _ = env.reset(seed=0)
    address = observation['image'].data_ptr()
    assert address == env.renderer.rgb.ptr
    later, *_ = env.step(torch.zeros(2, dtype=torch.int64))
    assert later['image'].data_ptr() == address
    with pytest.raises(UserError, match='actions are'):
        env.step(torch.zeros(3, dtype=torch.int64))
    for options in ({'task': 'room'}, {'randomisation': load_randomisation('rough')}):
        with pytest.raises(UserError):
            WarpNavigationEnv(EnvConfig(scenes=('house:7?rooms=1',), num_envs=2, **options),
                              device='cpu')


@pytest.mark.parametrize('module', ['vn_sim_bridge.render.warp_visibility',
                                    'vn_sim_bridge.render.warp_shading',
                                    'vn_sim_bridge.render.warp_sensor',
                                    'vn_sim_bridge.navigation.warp_decisions'])
def test_the_kernels_compile_for_a_gpu(tmp_path, module):
    code = (f'import importlib, warp as wp\nm = importlib.import_module({module!r})\n'
            f'print(wp.compile_aot_module(m, arch=90, module_dir={str(tmp_path)!r}))')
    done = subprocess.run([sys.executable, '-c', code], capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    assert list(tmp_path.glob('*.cubin'))


def test_the_gpu_benchmark_runs(tmp_path):
    done = subprocess.run(
        [sys.executable, 'bench/gpu/run.py', '--device', 'cpu', '--envs', '8', '--sizes', '48',
         '--seconds', '0.05', '--parts', 'render', '--out', str(tmp_path / 'lines.jsonl')],
        capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert len((tmp_path / 'lines.jsonl').read_text().splitlines()) == 3
    assert '"labels_equal": 1.0' in done.stdout

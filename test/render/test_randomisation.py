"""Light, camera and base: reproducible, independent for goal and observation, checked."""

import dataclasses

import numpy as np
import pytest

from vn_nav.errors import UserError
from vn_nav.robot import RobotSpec
from vn_sim_bridge.counter_random import Stream
from vn_sim_bridge.navigation.env import NavigationEnv
from vn_sim_bridge.navigation.env_config import EnvConfig
from vn_sim_bridge.render.randomisation import (
    Randomisation,
    blackbody,
    draw_appearance,
    load_randomisation,
)
from vn_sim_bridge.render.sensor import expose
from vn_sim_bridge.robot.simulated_robot import SimulatedRobot


def make(randomisation, **options):
    return NavigationEnv(EnvConfig(**{'scenes': ('house:7',), 'num_envs': 6, 'size': 48,
                                      'randomisation': randomisation} | options))


def test_nothing_varies_by_default():
    one = draw_appearance(Randomisation(), 3, 0, Stream.APPEARANCE, np.arange(5), np.arange(5))
    for part in one:
        assert (part == part[:1]).all()
    assert not Randomisation().varies_pictures and Randomisation().pictures_per_goal == 1


@pytest.mark.parametrize('name', ['standard', 'rough'])
def test_presets_stay_within_their_ranges_and_repeat(name):
    config = load_randomisation(name)
    env, episode = np.arange(400), np.arange(400) % 7
    one = draw_appearance(config, 6, 3, Stream.APPEARANCE, env, episode)
    again = draw_appearance(config, 6, 3, Stream.APPEARANCE, env, episode)
    other = draw_appearance(config, 6, 3, Stream.GOAL_APPEARANCE, env, episode)
    for part, same, different in zip(one, again, other, strict=True):
        assert np.array_equal(part, same) and not np.array_equal(part, different)
    for part, limits, unit in ((one.noise, config.noise, 1), (one.height, config.height, 1),
                               (one.fov, config.fov_deg, np.pi / 180),
                               (one.pitch, config.pitch_deg, np.pi / 180)):
        low, high = limits[0] * unit, limits[1] * unit
        assert low <= part.min() + 1e-6 and part.max() <= high + 1e-6
        assert np.ptp(part) > 0.9 * (high - low)
    on = (one.lamps.max(axis=2) > 0).mean()
    assert abs(on - config.lamp_on) < 0.05
    assert (one.cube > 0).all()


def test_warm_light_is_red_and_cold_light_blue():
    warm, neutral, cold = blackbody(np.array([2700.0, 6500.0, 12000.0]))
    assert np.allclose(neutral, 1.0)
    assert warm[0] > 1 > warm[2] and cold[2] > 1 > cold[0]


def test_goal_and_observation_are_lit_independently():
    env = make(load_randomisation('standard'))
    observation, info = env.reset(seed=1)
    env.simulator.place(np.arange(6), env.goal_poses[info['goal']])
    seen = env.simulator.observe().rgb.astype(int)
    shown = env.goals[observation['goal_index']].astype(int)
    assert (np.abs(seen - shown).mean(axis=(1, 2, 3)) > 3).all()
    pictures = env.goals[:8].reshape(8, -1)  # one goal
    assert len(np.unique(pictures, axis=0)) == 8


def test_a_seed_reproduces_pictures_for_any_number_of_environments_and_threads():
    config = load_randomisation('rough')
    small, large = make(config, num_envs=2), make(config, num_envs=5)
    parallel = NavigationEnv(large.config, threads=2)
    observations = [env.reset(seed=9)[0] for env in (small, large, parallel)]
    rng = np.random.default_rng(0)
    for _ in range(12):
        actions = rng.integers(0, 4, 5)
        for part in ('image', 'goal_index'):
            assert np.array_equal(observations[0][part], observations[1][part][:2])
            assert np.array_equal(observations[1][part], observations[2][part])
        observations = [env.step(actions[:env.num_envs])[0] for env in (small, large, parallel)]


def test_light_changes_with_the_episode_and_not_within_it():
    env = make(dataclasses.replace(load_randomisation('standard'), noise=(0, 0), blur=(0, 0)),
               max_decisions=2, noise=False, actions=('look_up', 'look_down'))
    first, info = env.reset(seed=0)
    pose = info['pose'].copy()
    env.step(np.zeros(6, int))
    back, _, _, truncated, info = env.step(np.ones(6, int))
    assert np.allclose(info['pose'], pose) and truncated.all()
    assert np.array_equal(first['image'], back['image'])
    env.step(np.zeros(6, int))  # new episodes
    env.simulator.place(np.arange(6), pose)
    assert (env.simulator.observe().rgb != first['image']).any(axis=(1, 2, 3)).all()


def test_sensor_noise_has_the_promised_size_and_differs_from_frame_to_frame():
    grey = np.full((2, 3, 84, 84), 120, np.uint8)
    one, two = grey.copy(), grey.copy()
    sigma, none = np.array([4.0, 9.0], np.float32), np.zeros(2, np.float32)
    expose(one, sigma, none, np.array([1, 2], np.uint64))
    expose(two, sigma, none, np.array([3, 2], np.uint64))
    measured = one.astype(float).std(axis=(1, 2, 3))
    assert np.allclose(measured, sigma, rtol=0.05)
    assert np.abs(one.astype(float).mean(axis=(1, 2, 3)) - 120).max() < 0.3
    assert not np.array_equal(one[0], two[0]) and np.array_equal(one[1], two[1])


def test_blur_is_a_horizontal_box_filter():
    picture = np.zeros((1, 3, 60, 60), np.uint8)
    picture[:, :, :, 30] = 240
    expose(picture, np.zeros(1, np.float32), np.full(1, 0.1, np.float32), np.zeros(1, np.uint64))
    assert (picture[0, 0, 5, 27:34] > 0).sum() == 6 and picture[0, 0, 5].max() == 40
    assert (picture[0, 0] == picture[0, 0, 0]).all()


def test_a_bad_base_drives_less_and_slips():
    worn = dataclasses.replace(Randomisation(), motion_scale=(0.5, 0.5))
    env = make(worn, noise=False, actions=('forward',))
    _, before = env.reset(seed=0)
    *_, info = env.step(np.zeros(6, int))
    free = ~info['collided']
    assert free.any() and np.allclose(info['path_length'][free], 0.25, atol=1e-6)
    slippery = make(dataclasses.replace(Randomisation(), slip=1.0), noise=False,
                    actions=('forward',))
    slippery.reset(seed=0)
    *_, info = slippery.step(np.zeros(6, int))
    assert (info['path_length'] < 0.5).all() and len(set(info['path_length'])) > 1


def test_late_pictures_are_the_ones_before():
    env = make(dataclasses.replace(Randomisation(), late_picture=1.0), noise=False,
               actions=('rotate_left',))
    first, _ = env.reset(seed=0)
    later, *_ = env.step(np.zeros(6, int))
    assert np.array_equal(first['image'], later['image'])


def test_the_bridge_shows_what_the_environment_shows():
    config = dataclasses.replace(load_randomisation('standard'), noise=(0, 0), blur=(0, 0))
    env = make(config, num_envs=3, seed=5)
    observation, info = env.reset(seed=5)
    robot = SimulatedRobot('house:7', robot=RobotSpec(), size=48, seed=5, randomisation=config)
    for n in range(3):
        robot.begin_episode(n)
        assert np.allclose(robot.pose, info['pose'][n])
        assert np.array_equal(robot.observe().rgb[0], observation['image'][n])
        assert np.array_equal(robot.goal_frames().rgb[0],
                              env.goals[observation['goal_index'][n]])


@pytest.mark.parametrize('fields, named', [
    ({'daylight': (2, 1)}, 'daylight'), ({'exposure': (0, 9)}, 'exposure'),
    ({'noise': (-1, 0)}, 'noise'), ({'lamp_on': 1.5}, 'lamp_on'), ({'slip': -0.1}, 'slip'),
    ({'fov_deg': 'wide'}, 'fov_deg'), ({'goal_variants': 0}, 'goal_variants'),
    ({'blur': (0, float('nan'))}, 'blur'),
])
def test_impossible_ranges_are_refused(fields, named):
    with pytest.raises(UserError, match=named):
        Randomisation(**fields)


@pytest.mark.parametrize('text, rule', [
    ('- a list', 'mapping'), ('moonlight: 3', 'known fields'), ('a: [', 'YAML'),
    ('noise: [1]', 'noise'),
])
def test_broken_files_are_refused_by_name(tmp_path, text, rule):
    path = tmp_path / 'odd.yaml'
    path.write_text(text)
    with pytest.raises(UserError, match=rule):
        load_randomisation(path)
    with pytest.raises(UserError, match='nowhere'):
        load_randomisation('nowhere.yaml')

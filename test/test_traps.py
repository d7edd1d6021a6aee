"""Every trap that the published code of the thesis fell into, and the tests that keep us out.

Each named test fails when the trap is put back. `ELSEWHERE` is checked against the files, so that
a test cannot be renamed or dropped unnoticed; what no other file tests, this one does.
"""

import ast
import dataclasses

import numpy as np
import pytest
from paths import ROOT, TESTS

from vn_nav.learning.presets import ENVIRONMENT
from vn_sim_bridge.navigation.env import NavigationEnv
from vn_sim_bridge.navigation.env_config import EnvConfig

# Number in thesis-facts.md, section 6; the trap; the tests (of this file: without a file's name).
TRAPS = {
    1: ('dueling with the mean over one channel', (
        'test_returns.py::test_trap_1_dueling_takes_the_mean_over_actions',
        'test_network.py::test_pixel_control_is_dueling_over_actions')),
    2: ('every environment got the last scene and goal', (
        'test_env.py::test_sixteen_environments_hold_sixteen_scene_goal_pairs',)),
    3: ('short episodes starve the replay', (
        'test_replay.py::test_trap_3_short_episodes_still_fill_the_windows',
        'test_auxiliary.py::test_value_replay_is_the_squared_error_to_the_n_step_return',
        'test_auxiliary.py::test_pixel_control_is_n_step_q_learning_of_pixel_changes')),
    4: ("pixel change against the next episode's first frame", (
        'test_replay.py::test_trap_4_the_last_pixel_change_is_against_the_true_last_frame',
        'test_env.py::test_next_step_autoreset')),
    5: ('goal pictures in BGR, observations in RGB', (
        'test_images.py::test_channel_orders_come_back_as_rgb',
        'test_preprocessing.py::test_simulator_live_and_bag_agree',
        'test_env.py::test_a_robot_that_sees_its_goal_pose_sees_the_goal_picture')),
    6: ('50 GB of replay', ('test_replay.py::test_trap_6_memory_stays_small',)),
    7: ('time-outs as true ends', (
        'test_returns.py::test_trap_7_a_time_out_bootstraps_unless_asked_otherwise',
        'test_learner.py::test_time_outs_bootstrap_unless_asked_otherwise',
        'test_learner.py::test_a2c_has_the_textbook_gradient',
        'test_env.py::test_time_outs_truncate_and_arrivals_terminate')),
    8: ('action orders differ', (
        'test_checkpoint.py::test_other_actions_or_another_order_are_refused',
        'test_trainer.py::test_another_order_of_actions_is_refused')),
    9: ('an old frame in mid-motion, a reward that training did not have, no zero Twist', (
        'test_navigator.py::test_a_decision_moves_and_the_next_waits_for_rest',
        'test_navigator.py::test_stamps_are_judged',
        'test_navigator.py::test_duplicate_and_reordered_frames_are_dropped',
        'test_policy_node.py::test_signals_deliver_zero',
        'test_trap_9_a_robot_without_rewards_sees_what_training_showed')),
    10: ('a turning cost by accident', (
        'test_trap_10_every_reward_term_is_named_and_off',
        'test_trap_10_the_terms_add_up_to_the_reward')),
    11: ('classes blended by resizing', (
        'test_replay.py::test_trap_11_class_colours_are_averaged_and_never_classes',
        'test_auxiliary.py::test_image_losses_are_mean_squared_errors_of_averaged_pictures',
        'test_trap_11_labels_are_never_resized')),
    12: ('sliding along walls', (
        'test_world.py::test_a_blocked_move_ends_at_the_contact_and_does_not_slide',
        'test_metrics.py::test_summary_against_a_loop',
        'test_trap_12_collisions_are_counted')),
}


def make(**options):
    return NavigationEnv(EnvConfig(**{
        'scenes': ('house:7',), 'num_envs': 8, 'size': 36} | options))


def test_every_trap_has_its_tests():
    assert sorted(TRAPS) == list(range(1, 13))
    for number, (_, names) in TRAPS.items():
        for name in names:
            file, _, function = name.rpartition('::')
            [path] = TESTS.rglob(file or 'test_traps.py')
            tree = ast.parse(path.read_text())
            assert function in {node.name for node in tree.body
                                if isinstance(node, ast.FunctionDef)}, (number, name)


@pytest.mark.parametrize('task', ['image', 'object', 'room'])
def test_trap_9_a_robot_without_rewards_sees_what_training_showed(task):
    """Where a decision is taken the last reward has been 0, which is what a robot is fed."""
    env = make(task=task, progress_reward=1.0, collision_reward=-0.1, max_decisions=60)
    env.set_difficulty(0.3)
    observation, info = env.reset(seed=0)
    ends, arrivals = np.zeros(8, bool), 0
    for _ in range(80):
        assert (observation['last_reward'][~ends] == 0).all()
        observation, _, terminated, truncated, info = env.step(env.oracle_actions())
        ends = terminated | truncated
        assert np.array_equal(observation['last_reward'], terminated.astype(np.float32))
        arrivals += info['success'].sum()
    assert arrivals > 8


def terms():
    """Names of all rewards beside the task's own."""
    return {field.name for field in dataclasses.fields(EnvConfig)
            if field.name.endswith(('_reward', '_bonus'))}


def test_trap_10_every_reward_term_is_named_and_off():
    defaults = {field.name: field.default for field in dataclasses.fields(EnvConfig)}
    assert {'progress_reward', 'collision_reward', 'exploration_reward'} <= terms()
    assert all(defaults[name] == 0.0 for name in terms())
    for name, world in ENVIRONMENT.items():
        used = {key for key in world if world[key] and key.endswith(('_reward', '_bonus'))}
        assert used <= terms(), name
    # Turning, driving and touching cost nothing of themselves, in any task.
    for task in ('image', 'object', 'room'):
        env = make(task=task, max_decisions=20)
        env.reset(seed=0)
        table = {name: number for number, name in enumerate(env.action_names)}
        collided = 0
        for action in ('rotate_left', 'rotate_right', 'forward', 'forward') * 8:
            _, reward, terminated, _, info = env.step(np.full(8, table[action]))
            assert np.array_equal(reward, terminated.astype(np.float32))
            collided += info['collided'].sum()
        assert collided > 0


def test_trap_10_the_terms_add_up_to_the_reward():
    """Each term by itself, then all at once, on the same motions."""
    weights = {name: 0.1 * (k + 1) for k, name in enumerate(sorted(terms()))}

    def rewards(**options):
        env = make(max_decisions=30, **options)
        env.set_difficulty(0.3)
        env.reset(seed=1)
        rng = np.random.default_rng(0)
        rows = []
        for _ in range(60):
            actions = np.where(rng.random(8) < 0.7, env.oracle_actions(),
                               rng.integers(0, len(env.action_names), 8))
            rows.append(env.step(actions)[1])
        return np.array(rows)
    sparse = rewards()
    assert 0 < sparse.sum() and set(np.unique(sparse)) == {0.0, 1.0}
    parts = {name: rewards(**{name: weight}) - sparse for name, weight in weights.items()}
    for name, part in parts.items():
        assert np.abs(part).max() > 0.01, f'{name} does nothing'
    assert np.allclose(rewards(**weights), sparse + sum(parts.values()), atol=1e-5)


RESIZES = ('resize', 'interpolate', 'grid_sample', 'Upsample')
# Functions that resize pictures: of cameras, of textures, for people, for frozen features, and to
# tell a black or frozen camera.
MAY_RESIZE = {
    'vn_nav/observation.py', 'vn_sim_bridge/render/scene.py', 'vn_sim_bridge/houses/materials.py',
    'vn_sim_bridge/tools/contact_sheet.py', 'vn_sim_bridge/tools/walk.py',
    'vn_nav/policy/search/local_features.py',  # a camera's full picture
    'vn_msgs_py/heic_file.py',  # photographs
    'vn_nav/policy/zhu.py', 'vn_nav/policy/resnet.py', 'vn_nav/bags/doctor/content_checks.py',
    'vn_nav/bags/report/figures.py', 'vn_nav/dashboard/pictures.py',  # for a page
    'vn_nav/report/search_map.py', 'vn_nav/report/film.py',  # what a policy knows, to look at
    'vn_sim_bridge/render/mesh_scene.py',  # textures
    'vn_sim_bridge/simulators/dmlab.py',  # colours and depth of an engine without labels
}


def test_trap_11_labels_are_never_resized():
    """Labels are rendered at the size they are used in; whoever resizes pictures is known."""
    found = set()
    for package in ('vn_nav', 'vn_msgs_py', 'vn_sim_bridge'):
        for path in (ROOT / package).rglob('*.py'):
            for node in ast.walk(ast.parse(path.read_text())):
                if isinstance(node, ast.Attribute) and node.attr in RESIZES and (
                        isinstance(node.value, ast.Name) and node.value.id in ('cv2', 'F')):
                    found.add(path.relative_to(ROOT).as_posix())
    assert 'vn_nav/observation.py' in found and found <= MAY_RESIZE
    env = make(privileged=('segmentation', 'goal_segmentation'))
    _, info = env.reset(seed=0)
    classes = set(np.unique(env.simulator.observe().labels))
    assert info['segmentation'].shape == info['goal_segmentation'].shape == (8, 36, 36)
    assert set(np.unique(info['segmentation'])) <= classes


def test_trap_12_collisions_are_counted():
    """Driving on against a wall is a contact a decision, and moves nothing."""
    env = make(num_envs=4, noise=False, max_decisions=80)
    env.reset(seed=0)
    forward = np.full(4, env.action_names.index('forward'))
    touched = np.zeros(4, np.int64)
    before = None
    for _ in range(60):
        *_, info = env.step(forward)
        touched += info['collided']
        if before is not None:
            stuck = before['collided'] & info['collided'] & ~info['reset']
            moved = np.hypot(*(info['pose'] - before['pose'])[stuck, :2].T)
            assert (moved < 0.01).all()
        before = info
    assert (touched > 20).all()

"""Episodes of a policy and its controls, by kind of stop and by house, and the page about them."""

import functools
import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from vn_nav.cli.world import long_rows
from vn_nav.errors import UserError
from vn_nav.evaluation.evaluator import (
    PolicyActor,
    by_scene,
    figures,
    measure,
    random_actor,
    run_episodes,
    split_figures,
)
from vn_nav.evaluation.metrics import Episode
from vn_nav.observation import needed_side
from vn_nav.policy.network import Policy
from vn_nav.policy.network_config import NetworkConfig
from vn_nav.policy.zhu_policy import build_policy
from vn_nav.report import tables
from vn_nav.report.evaluation_page import choose, evaluation_page, outcome
from vn_nav.robot import DRIVE_ACTIONS, RobotSpec
from vn_sim_bridge.navigation.env import NavigationEnv
from vn_sim_bridge.navigation.env_config import EnvConfig

ROWS = ['right goal, sample', 'right goal, greedy', 'wrong goal', 'blank goal', 'random actions',
        'explorer', 'shortest path']


def make_network(**fields):
    torch.manual_seed(0)
    return Policy(NetworkConfig(**{'actions': DRIVE_ACTIONS, 'size': 36, 'channels': (4, 4, 4),
                                   'features': 16, 'hidden': 16} | fields))


def make_env(scenes=('house:7',), environments=6, stop='arrival', *, limit=40):
    return NavigationEnv(EnvConfig(scenes=tuple(scenes), num_envs=environments, size=36,
                                   max_decisions=limit, stop=stop))


def oracle(env):
    return lambda observation, reset: env.oracle_actions()


def test_every_environment_gives_the_same_number_of_episodes():
    env = make_env()
    episodes = run_episodes(env, random_actor(env, 0), 12, seed=1, robot=RobotSpec())
    again = run_episodes(env, random_actor(env, 0), 12, seed=1, robot=RobotSpec())
    assert len(episodes) == 12 and episodes == again
    for one in episodes:
        assert one.start_distance >= 1.0 and 1 <= one.decisions <= 40
        assert one.collisions <= one.decisions and one.reward == float(one.success)
        assert one.seconds > 0.5 * one.decisions
        assert one.scene == 'house:7' and one.declared is None and one.reached == one.success


def test_trajectories_are_the_episodes():
    """Start, every decision's end, the metres driven and the goal: as the figures say."""
    env = make_env(limit=80)
    for one in run_episodes(env, oracle(env), 12, seed=3, robot=RobotSpec()):
        assert len(one.trajectory) == one.decisions + 1
        driven = np.hypot(*np.diff(one.trajectory[:, :2], axis=0).T).sum()
        assert driven == pytest.approx(one.path_length, abs=1e-4)
        assert len(one.contacts) == one.collisions
        assert one.success
        assert np.hypot(*(one.trajectory[-1, :2] - one.goal_pose[:2])) <= 0.6
        house = env.places[0]
        assert house.room_at(*one.goal_pose[:2]) == one.goal
        field = house.geodesic(*one.goal_pose[:2])
        start = field.at(one.trajectory[:1, :2])[0]
        assert start == pytest.approx(one.start_distance, abs=1e-3)


def test_every_control_and_equal_starts():
    rows = measure(functools.partial(make_env, limit=60), make_network(), ['house:7'],
                   decoding='sample', episodes=10)
    assert list(rows) == ['arrival'] and list(rows['arrival']) == ROWS
    found = figures(rows)['arrival']
    assert found['shortest path']['success'] >= 0.9
    assert found['explorer']['success'] >= 0.6 > found['random actions']['success']
    assert found['explorer']['spl'] < found['shortest path']['spl']
    starts = {tuple(e.start_distance for e in episodes) for episodes in rows['arrival'].values()}
    assert len(starts) == 1


def test_houses_add_up_to_the_total():
    named = ['house:7', 'house:8', 'house:10000']
    rows = measure(functools.partial(make_env, limit=50), make_network(), named,
                   decoding='sample', episodes=10, controls=('shortest path',))
    total = figures(rows)['arrival']
    scenes = {seed: figures(own)['arrival'] for seed, own in by_scene(rows).items()}
    assert list(scenes) == named
    for name, whole in total.items():
        parts = [own[name] for own in scenes.values()]
        assert [part['episodes'] for part in parts] == [4, 4, 4] and whole['episodes'] == 12
        for key in ('success', 'spl', 'contact_free_success', 'stop_error_m', 'decisions',
                    'seconds', 'return'):
            assert np.mean([part[key] for part in parts]) == pytest.approx(whole[key]), key
        touched = sum(part['collisions'] * part['decisions'] for part in parts)
        assert touched / sum(part['decisions'] for part in parts) == pytest.approx(
            whole['collisions'])


def test_how_often_the_action_filter_acts_is_a_figure():
    """Of the policy's rows, and only where it has a filter; a shown page and tables say it."""
    network = make_network(heads=('goal_pose',), pose_to_memory=True,
                           moves=RobotSpec().with_actions(DRIVE_ACTIONS).moves)
    env = make_env(limit=30)
    actor, counted = PolicyActor(env, network, 'sample', 0), []

    def spy(observation, reset):
        actions = actor(observation, reset)
        counted.append(actor.filtered)
        spy.filtered = actor.filtered
        return actions
    episodes = run_episodes(env, spy, 6, seed=1, robot=RobotSpec())
    total = np.sum([episode.filtered for episode in episodes], axis=0)
    assert 0 < total[1] < total[0] <= sum(rows[0].sum() for rows in counted)
    assert total[0] < sum(episode.decisions for episode in episodes)
    rows = measure(functools.partial(make_env, limit=30), network, ['house:7'], decoding='sample',
                   episodes=6, controls=('random actions',))
    own = figures(rows)['arrival']
    shares = own['right goal, sample']
    assert 0 < shares['filter_changed'] < shares['filter_acted'] < 1
    assert 'filter_acted' not in own['random actions']
    assert f'filter acted {shares["filter_acted"]:.1%}' in tables.row_line('own', shares,
                                                                           'arrival')
    assert 'filter changed' in tables.rows_html(own, 'arrival')
    without = measure(functools.partial(make_env, limit=10), make_network(), ['house:7'],
                      decoding='sample', episodes=6, controls=())
    assert 'filter' not in tables.rows_html(figures(without)['arrival'], 'arrival')


def test_many_houses_are_measured_in_parts(monkeypatch):
    """As if they were in memory at once, except for the seeds of the later parts."""
    made = []

    def make(scenes, environments, stop):
        made.append((scenes, environments))
        return make_env(scenes, environments, stop, limit=10)
    monkeypatch.setattr('vn_nav.evaluation.evaluator.SCENES_AT_ONCE', 2)
    grown = []
    rows = measure(make, make_network(), ['house:7', 'house:8', 'house:9'],
                   decoding='greedy', episodes=5, controls=(),
                   on_row=lambda *row: grown.append(row))
    assert grown == [('arrival', 'right goal, greedy', count) for count in (4, 6)]
    assert made == [(['house:7', 'house:8'], 4), (['house:9'], 2)]
    episodes = rows['arrival']['right goal, greedy']
    assert sorted(e.scene for e in episodes) == [
        f'house:{seed}' for seed in (7, 7, 8, 8, 9, 9)]


def test_rows_that_take_long_are_said(monkeypatch, capsys):
    clock = iter([0.0, 20.0, 620.0, 650.5])
    monkeypatch.setattr('vn_nav.cli.world.time', SimpleNamespace(monotonic=lambda: next(clock)))
    say = long_rows()
    say('arrival', 'right goal, greedy', 12)
    say('declared', 'wrong goal', 232)
    say('declared', 'blank goal', 232)
    assert capsys.readouterr() == ('', 'Declared stop, wrong goal: 232 episodes, 10 min\n'
                                       'Declared stop, blank goal: 232 episodes, 11 min\n')


def test_a_declared_stop_is_measured_beside_arrival():
    network = make_network(heads=('arrival',))
    rows = measure(make_env, network, ['house:7'], decoding='sample', episodes=6, threshold=0.0)
    assert list(rows) == ['arrival', 'declared'] and list(rows['declared']) == ROWS
    # Above 0 is every probability: the policy declares at once, and is wrong, a metre off or more.
    found = figures(rows)['declared']
    policy = found['right goal, sample']
    assert policy['false_stops'] == policy['declared'] == 1.0 and policy['success'] == 0.0
    assert policy['decisions'] == 1.0 and policy['seconds'] == 0.0
    assert found['shortest path']['success'] >= 0.9
    assert found['shortest path']['false_stops'] == 0.0
    # Below 1 is every one: it never declares, and nothing ends before the limit.
    never = figures(measure(make_env, network, ['house:7'], decoding='sample', episodes=6,
                            controls=(), threshold=0.999))['declared']['right goal, sample']
    assert never['declared'] == never['false_stops'] == never['success'] == 0.0
    assert never['decisions'] == 40


def test_whatever_is_declared_of_an_absent_goal_is_false():
    network = make_network(heads=('arrival',))
    rows = measure(make_env, network, ['house:7', 'house:8'], decoding='sample', episodes=6,
                   controls=('absent goal', 'wrong goal', 'shortest path'), threshold=0.0)
    assert 'absent goal' not in rows['arrival'] and 'wrong goal' in rows['arrival']
    assert list(rows['declared']) == ['right goal, sample', 'wrong goal', 'absent goal',
                                      'shortest path']
    found = figures(rows)['declared']
    assert found['absent goal']['declared'] == found['absent goal']['false_stops'] == 1.0
    assert found['absent goal']['stops_at_shown'] == 0.0
    assert 'stops_at_shown' not in found['right goal, sample']
    assert 'at the picture' in tables.rows_html(found, 'declared')
    assert found['shortest path']['within_1m'] >= found['shortest path']['success']


def test_one_kind_of_stop_or_the_controls_alone():
    network = make_network(heads=('arrival',))
    rows = measure(functools.partial(make_env, limit=5), network, ['house:7'], decoding='sample',
                   episodes=2, controls=('random actions',), stops=('declared',), own=False)
    assert {stop: list(own) for stop, own in rows.items()} == {'declared': ['random actions']}
    with pytest.raises(UserError, match='arrival'):
        measure(make_env, make_network(), ['house:7'], decoding='sample', stops=('declared',))


def test_a_wider_camera_shows_the_network_what_its_own_would():
    """As over ROS: cropped to the field of view of the training."""
    size, own = 36, math.radians(90)
    wide = RobotSpec(camera_fov=math.radians(110))
    side = needed_side(size, wide.camera_fov, own)
    env, usual = (NavigationEnv(EnvConfig(scenes=('house:7',), num_envs=4, size=pixels), robot)
                  for pixels, robot in ((side, wide), (size, RobotSpec())))
    network = make_network()
    actor = PolicyActor(env, network, 'greedy', 0, camera_fov=own)
    observation, info = env.reset(seed=0)
    same, _ = usual.reset(seed=0)
    cropped = actor._own(observation['image'])
    assert side > size and cropped.shape == same['image'].shape

    def off(one, other):
        return np.abs(one.astype(float) - other).mean()
    assert off(cropped, same['image']) < 0.4 * off(cropped, same['image'][[1, 2, 3, 0]])
    seen = PolicyActor(usual, network, 'greedy', 0, camera_fov=own)
    assert seen._own(same['image']) is same['image']
    assert actor(observation, info['reset']).shape == (4,)  # goals are cropped as well


def test_a_narrower_camera_tells_the_policy_that_searches_its_zoom():
    size, own, narrow = 40, math.radians(90), RobotSpec(camera_fov=math.radians(60))
    torch.manual_seed(0)
    network = build_policy(NetworkConfig(
        actions=DRIVE_ACTIONS, moves=narrow.with_actions(DRIVE_ACTIONS).moves, size=size,
        architecture='search', channels=(8, 12, 8), features=24, blocks=1, view=own,
        footprint=narrow.footprint_radius))
    env = NavigationEnv(EnvConfig(scenes=('house:7',), num_envs=2, size=size), narrow)
    actor = PolicyActor(env, network, 'greedy', 0, camera_fov=own)
    observation, info = env.reset(seed=0)
    actor(observation, info['reset'])
    bearings = actor.policy.search.searchers[0].bearings
    edge = math.degrees(math.atan(31 / 32 * math.tan(math.radians(30))))
    assert np.degrees(bearings[[0, -1]]) == pytest.approx([edge, -edge])


def test_the_policy_declares_where_its_head_says_so():
    env = make_env(stop='declared')
    actor = PolicyActor(env, make_network(heads=('arrival',)), 'sample', 0, threshold=0.5)
    observation, info = env.reset(seed=0)
    actions = actor(observation, info['reset'])
    actor.threshold = float(np.median(actor.policy.arrival))
    actions = actor(observation, info['reset'])
    declared = actions == env.declare_action
    assert (declared == (actor.policy.arrival > actor.threshold)).all()
    assert declared.any() and not declared.all()


def result_and_rows(stop_threshold=0.0, scenes=('house:7', 'house:8')):
    rows = measure(make_env, make_network(heads=('arrival',)), list(scenes), decoding='sample',
                   episodes=8, controls=('wrong goal', 'random actions'), threshold=stop_threshold)
    return {'checkpoint': 'a <b> run', 'simulator': 'house', 'world_version': '2', 'task': 'image',
            'decoding': 'sample', 'max_decisions': 40, 'seed': 0, 'odometry': 'drift',
            'ranges': 'picture', 'camera': '90 deg, 1 m high',
            'date': '2026-11-24', 'splits': {'scenes': split_figures(rows, scenes)}
            }, {'scenes': rows}


PLAN = {'bounds': [0, 0, 9, 6], 'walls': [[0, 0, 9, 0.1]], 'outside': [],
        'obstacles': [[1, 1, 2, 2, 'table']],
        'rooms_list': [{'name': 'kitchen', 'rect': [0, 0, 5, 6]}]}


def test_the_page_has_a_map_an_episode_and_needs_nothing_else():
    result, rows = result_and_rows()
    plans = {'scenes': {'house:7': PLAN, 'house:8': PLAN}}
    page = evaluation_page(result, rows, plans, maps=5)
    assert page.count('<svg') == page.count('<polyline') == 5
    assert page.count('>false stop<') == 5 and 'a &lt;b&gt; run' in page
    for outside in ('src=', 'href=', '<script', '<link', '@import', 'url('):
        assert outside not in page
    assert page.count('<table') == 4  # both kinds of stop, together and by scene
    assert 'nan' not in page
    assert evaluation_page(result, rows, plans, maps=0).count('<svg') == 0


def shown(success, start=3.0, scene='house:7', **fields):
    return Episode(success=success, start_distance=start, path_length=3.0, decisions=9,
                   collisions=0, seconds=9.0, stop_distance=0.1, stop_heading=0.1, scene=scene,
                   **fields)


def test_failures_and_many_houses_are_shown():
    good = [shown(True, start, scene) for scene in (1, 2, 3) for start in (2.0, 4.0)]
    bad = [shown(False, 5.0, 1)]
    chosen = choose(good + bad, 4)
    assert [e.scene for e in chosen] == [1, 2, 3, 1] and not chosen[-1].success
    assert [e.start_distance for e in chosen[:3]] == [4.0, 4.0, 4.0]
    assert len(choose(good + 9 * bad, 6)) == 6
    assert sum(e.success for e in choose(good + 9 * bad, 6)) == 3
    assert len(choose(bad, 6)) == 1 and choose([], 6) == [] and choose(good, 0) == []


def test_outcomes_in_words():
    assert outcome(shown(True)) == 'arrived' and outcome(shown(False)) == 'gave up'
    assert outcome(shown(False, declared=True)) == 'false stop'
    assert outcome(shown(True, declared=True)) == 'stopped at the goal'
    assert 'never stopped' in outcome(shown(False, declared=False, reached=True))

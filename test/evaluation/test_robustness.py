"""What a policy bears: each level changes what it says and nothing else, and is kept."""

import contextlib
import dataclasses
import json

import cv2
import numpy as np
import pytest
from small_env import make
from small_search import ROBOT, write_small_search

from vn_nav.cli import main
from vn_nav.cli.robustness import env_maker
from vn_nav.errors import UserError
from vn_nav.evaluation import robustness
from vn_nav.evaluation.robustness import (
    Factor,
    LateEnv,
    Level,
    Measured,
    Robustness,
    RobustnessConfig,
    Step,
    change,
    factors,
    held,
    measure_level,
)
from vn_nav.policy.checkpoint import load_checkpoint
from vn_nav.report.robustness_page import markdown, robustness_page, robustness_png, verdict
from vn_sim_bridge.render.randomisation import LIMITS, Randomisation, load_randomisation

SCENES = ['house:7?rooms=2']
FORWARD, LEFT = (ROBOT.action_names.index(name) for name in ('forward', 'rotate_left'))


@pytest.fixture(scope='module')
def checkpoint(tmp_path_factory):
    folder = write_small_search(tmp_path_factory.mktemp('robust') / 'model',
                                randomisation='standard')
    return load_checkpoint(folder)


@contextlib.contextmanager
def opened(checkpoint, level=None, count=4, stop='declared'):
    """An environment at a level, and its first observation."""
    env = env_maker(checkpoint, ROBOT)(level or Level(), SCENES, count, stop)
    with contextlib.closing(env):
        yield env, *env.reset(seed=3)


def test_every_factor_has_the_usual_once_and_changes_one_thing():
    for name, own in factors(1.0, 90.0, odometry=True).items():
        assert sum(step.usual for step in own.steps) == 1, name
        assert len({step.name for step in own.steps}) == len(own.steps) >= 4
        for step in own.steps:
            changed = [field.name for field in dataclasses.fields(Level)
                       if getattr(step.level, field.name) != field.default]
            assert len(changed) == (0 if step.usual else 1), (name, step)
    assert 'odometry' not in factors(1.0, 90.0, odometry=False)
    quiet = factors(1.0, 90.0, odometry=False, motion_noise=False)['motion_noise'].steps
    assert [step.usual for step in quiet] == [True, False, False, False]
    own = factors(0.6, 90.0, odometry=False)['camera_height'].steps
    assert [step.label for step in own] == ['0.4', '0.6', '0.7', '1', '1.4'] and own[1].usual


@pytest.mark.slow
def test_moves_without_noise_are_exact_and_noise_scales():
    def moved(noise, action):
        env = make(num_envs=16, noise=noise, scenes=('house:7?rooms=1',), size=8)
        with contextlib.closing(env):
            _, info = env.reset(seed=5)
            *_, after = env.step(np.full(16, action))
            free = ~after['collided']
            gap = after['pose'][free] - info['pose'][free]
            assert free.sum() > 4
            return free, np.hypot(gap[:, 0], gap[:, 1]), (gap[:, 2] + np.pi) % (2 * np.pi) - np.pi
    _, way, _ = moved(0, FORWARD)
    _, _, turn = moved(0, LEFT)
    assert np.allclose(way, 0.5) and np.allclose(turn, np.radians(30))
    _, _, once = moved(1, LEFT)
    _, _, four = moved(4, LEFT)
    assert np.std(once) > 0
    assert np.allclose(four - np.radians(30), 4 * (once - np.radians(30)))
    free, way, _ = moved(1, FORWARD)
    other, far, _ = moved(2, FORWARD)
    both = free & other
    assert np.allclose(far[both[other]] - 0.5, 2 * (way[both[free]] - 0.5))
    with pytest.raises(UserError, match='motion noise'):
        make(noise=-1)


def test_light_spreads_about_its_middles_within_the_limits():
    usual = load_randomisation('standard')
    none, double, wild = (usual.with_light(spread) for spread in (0, 2, 10))
    assert usual.with_light(1) == usual
    assert none.daylight == pytest.approx((0.6, 0.6)) and none.lamp_on == 1
    assert double.daylight == pytest.approx((0.2, 1.0))
    assert double.exposure == pytest.approx((-0.7, 0.7))
    assert double.lamp_on == pytest.approx(0.6) and double.white_balance == pytest.approx(0.06)
    for name in ('daylight', 'daylight_kelvin', 'sun', 'lamp', 'lamp_kelvin', 'exposure'):
        assert LIMITS[name][0] <= getattr(wild, name)[0] <= getattr(wild, name)[1] <= (
            LIMITS[name][1])
    for name in ('fov_deg', 'height', 'pitch_deg', 'noise', 'blur'):
        assert getattr(wild, name) == getattr(usual, name)


@pytest.mark.slow
def test_exposure_and_blur_are_of_the_robots_pictures_alone(checkpoint):
    with opened(checkpoint) as (usual, seen, info):
        goals, image = usual.goals.copy(), seen['image'].astype(float)
    for stops in (-2, 2):
        with opened(checkpoint, Level(exposure=stops)) as (env, other, there):
            assert np.array_equal(env.goals, goals)
            assert np.array_equal(there['pose'], info['pose'])
            assert np.array_equal(other['goal_index'], seen['goal_index'])
            ratio = other['image'].mean() / image.mean()
            assert ratio < 0.4 if stops < 0 else ratio > 1.3  # bright ones are cut off at white

    def detail(pictures):
        return np.abs(np.diff(pictures.astype(float), axis=-1)).mean()
    found = [detail(image)]
    for blur in (0.05, 0.2):
        with opened(checkpoint, Level(blur=blur)) as (env, other, _):
            assert np.array_equal(env.goals, goals)
            found.append(detail(other['image']))
    assert found[0] > found[1] > found[2]


@pytest.mark.slow
def test_goal_pictures_have_a_light_of_their_own_that_nobody_changes():
    """Also where nothing else varies: the sensor's noise is of the goal pictures alone then."""
    noisy = Randomisation(noise=(40.0, 40.0), goal_variants=1)
    plain, other = make(), make(goal_randomisation=noisy)
    with contextlib.closing(plain), contextlib.closing(other):
        assert np.array_equal(plain.reset(seed=1)[0]['image'], other.reset(seed=1)[0]['image'])
        gap = np.abs(plain.goals[:-1].astype(float) - other.goals[:-1])
        assert 10 < gap.mean() < 40


@pytest.mark.slow
def test_other_cameras_have_the_same_starts_and_goal_pictures_of_their_own(checkpoint):
    with opened(checkpoint) as (usual, _, info):
        goals = usual.goals.copy()
    with opened(checkpoint, Level(camera_height=0.4)) as (env, _, there):
        assert env.robot.camera_height == 0.4 and np.array_equal(there['pose'], info['pose'])
        assert np.array_equal(there['goal'], info['goal'])
        assert env.goals.shape == goals.shape and not np.array_equal(env.goals, goals)
    with opened(checkpoint, Level(camera_fov_deg=110)) as (env, seen, there):
        assert np.degrees(env.robot.camera_fov) == pytest.approx(110)
        assert seen['image'].shape[-1] > checkpoint.config.size  # to be cropped, not enlarged
        assert np.array_equal(there['pose'], info['pose'])
    with pytest.raises(UserError, match='deg'), opened(checkpoint, Level(camera_fov_deg=40)):
        pass


@pytest.mark.slow
def test_late_pictures_and_odometry_are_those_of_before(checkpoint):
    late, plain = (env_maker(checkpoint, ROBOT, max_decisions=6)(Level(), SCENES, 3, 'declared')
                   for _ in range(2))
    with contextlib.closing(plain), contextlib.closing(LateEnv(late, 2)) as late:
        begun = np.zeros(3, int)  # step at which each episode began
        past = []
        rng = np.random.default_rng(0)
        results = plain.reset(seed=4), late.reset(seed=4)
        for step in range(20):
            (now, info), (seen, _) = ((r[0], r[-1]) for r in results)
            begun[info['reset']] = step
            past.append(now)
            assert seen.keys() == now.keys()
            for name in ('goal_index', 'last_action', 'last_reward'):
                assert np.array_equal(seen[name], now[name])
            for n in range(3):
                old = past[max(step - 2, begun[n])]
                assert np.array_equal(seen['image'][n], old['image'][n])
                assert np.array_equal(seen['odometry'][n], old['odometry'][n])
            actions = rng.integers(0, 4, 3)
            actions[0] = 4 if step == 9 else actions[0]  # declared: an episode of its own length
            results = plain.step(actions), late.step(actions)
        assert len(set(begun.tolist())) > 1 and begun.min() > 0
        assert not np.array_equal(past[-1]['image'], past[-3]['image'])
        assert late.num_envs == 3 and late.declare_action == 4


@pytest.mark.slow
def test_odometry_errs_as_much_as_it_is_told(checkpoint):
    def errors(**options):
        with opened(checkpoint, Level(**options), count=24) as (env, seen, _):
            if 'odometry' not in seen:
                return None
            for k in range(8):
                seen, *_ = env.step(np.full(24, (FORWARD, LEFT)[k % 2]))
            return seen['odometry']
    true = errors(odometry='true')
    once, four = (np.abs(errors(drift=drift) - true) for drift in (1.0, 4.0))
    assert once.mean() > 0 and 3 < four.mean() / once.mean() < 5
    assert np.array_equal(errors(drift=0.0), true)
    assert not np.array_equal(errors(odometry='commanded'), true)
    assert errors(odometry='none') is None


@pytest.mark.slow
def test_levels_are_paired(checkpoint):
    config = RobustnessConfig(episodes=6, max_decisions=3)
    rows = [measure_level(checkpoint, level, SCENES, env_maker(checkpoint, ROBOT, max_decisions=3),
                          config)
            for level in (Level(), Level(camera_height=0.4), Level(latency=1), Level(light=3.0),
                          Level(motion_noise=4.0), Level(odometry='none'))]
    starts = [[(e.scene, e.goal, e.start_distance) for e in episodes] for episodes in rows]
    assert len(starts[0]) >= 6 and all(own == starts[0] for own in starts)
    assert all(e.declared is not None for episodes in rows for e in episodes)


@pytest.mark.slow
def test_a_second_run_goes_on_and_writes_the_page(checkpoint, monkeypatch, capsys, tmp_path):
    out, picture = tmp_path / 'out', tmp_path / 'charts.png'
    words = [str(checkpoint_folder(tmp_path)), '--out', str(out), '--houses', '2', '--episodes',
             '2', '--max-decisions', '2', '--png', str(picture)]
    levels = []
    real = robustness.measure_level

    def counted(checkpoint, level, *rest):
        levels.append(level)
        return real(checkpoint, level, *rest)
    monkeypatch.setattr(robustness, 'measure_level', counted)
    assert main(['robustness', *words, '--factors', 'latency']) == 0
    assert levels == [Level(), Level(latency=1), Level(latency=2), Level(latency=3)]
    kept = {path.name for path in out.iterdir()}
    assert kept == {'page.html', 'usual.json', *(f'latency_{k}.json' for k in (1, 2, 3))}
    entry = json.loads((out / 'latency_2.json').read_text())
    assert entry['conditions']['level']['latency'] == 2 and len(entry['successes']) == 2
    assert entry['figures'].keys() >= {'success_interval', 'spl', 'false_stops', 'collisions'}
    capsys.readouterr()
    levels.clear()
    (out / 'latency_3.json').unlink()
    assert main(['robustness', *words, '--factors', 'latency', 'motion_noise']) == 0
    assert levels == [Level(motion_noise=0), Level(motion_noise=2), Level(motion_noise=4),
                      Level(latency=3)]
    table = [line for line in capsys.readouterr().out.splitlines() if line.startswith('|')]
    assert len(table) == 2 + 4 + 4 and len({line.count('|') for line in table}) == 1
    page = (out / 'page.html').read_text()
    assert page.count('<svg') == 2 and '>Latency</h2>' in page and 'as usual; ' in page
    height, width, _ = cv2.imread(str(picture)).shape
    assert width > 2 * height
    # Other episodes are measured anew.
    levels.clear()
    words[words.index('--max-decisions') + 1] = '1'
    assert main(['robustness', *words, '--factors', 'latency']) == 0
    assert len(levels) == 4


def checkpoint_folder(tmp_path):
    return write_small_search(tmp_path / 'model', randomisation='standard')


@pytest.mark.slow
def test_bad_arguments_are_one_line(capsys, tmp_path):
    folder, taken = checkpoint_folder(tmp_path), tmp_path / 'taken'
    taken.write_text('a file')
    good = ['robustness', str(folder), '--out', str(tmp_path / 'out')]
    for words, said in (
            ([*good, '--factors', 'gravity'], 'gravity'),
            ([*good, '--houses', '0'], '--houses'),
            ([*good, '--episodes', '0'], '--episodes'),
            ([*good, '--max-decisions', '0'], '--max-decisions'),
            ([*good, '--stop-threshold', '2'], 'threshold'),
            ([*good, '--split', 'nowhere'], 'nowhere'),
            ([*good, '--randomisation', 'nowhere'], 'nowhere'),
            ([*good, '--png', str(tmp_path / 'charts.jpg')], '.png'),
            ([*good, '--png', str(tmp_path / 'no' / 'charts.png')], 'folder'),
            (['robustness', str(folder), '--out', str(taken)], 'folder'),
            (['robustness', str(folder), '--out', str(tmp_path / 'no' / 'out')], 'folder'),
            (['robustness', str(tmp_path / 'nothing'), '--out', str(tmp_path / 'o')],
             'checkpoint')):
        assert main(words) == 2, words
        error = capsys.readouterr().err
        assert said in error and error.count('\n') == 1, (words, error)


def measured(step, successes, false_stops=0.0):
    mean = float(np.mean(successes))
    return Measured(step, {
        'episodes': len(successes), 'success': mean, 'success_interval': [mean - 0.1, mean + 0.1],
        'spl': 0.5, 'false_stops': false_stops, 'collisions': 0.03, 'decisions': 120.0},
        tuple(successes))


def test_the_page_says_what_is_held_and_draws_what_stands_apart():
    steps = (Step('1', '1 x', Level()), Step('2', '2 x', Level(drift=2.0)),
             Step('4', '4 x', Level(drift=4.0)), Step('none', 'none', Level(odometry='none')))
    usual = measured(steps[0], [True] * 8 + [False] * 2)
    curve = [usual, measured(steps[1], [True] * 7 + [False] * 3),
             measured(steps[2], [False] * 5 + [True] * 3 + [False] * 2, 0.4),
             measured(steps[3], [False] * 10)]
    assert change(curve[1], usual)[0] == pytest.approx(-0.1)
    assert change(usual, usual) == (0, 0, 0)
    mean, low, high = change(curve[2], usual)
    assert low < mean < high < 0
    assert [held(own, usual) for own in curve] == [True, True, False, False]
    found = Robustness('declared', {'odometry': Factor('Odometry', 'times the drift', 'As told.',
                                                       steps, apart=1)},
                       {'odometry': curve}, ['blur, 5%: a rule; <none>'], usual)
    assert verdict(found, 'odometry') == (
        'Success is 0.80 as usual; held at 2 x (0.70); lost at 4 x (0.30), none (0.00) '
        '(times the drift).')
    page = robustness_page(found, name='models/<mine>', place='2 scenes')
    assert 'models/&lt;mine&gt;' in page and '<mine>' not in page and '&lt;none&gt;' in page
    for label in ('>1 x*<', '>2 x<', '>none<', 'false stops'):
        assert label in page
    # Three curves: each has its scale and a stroke for what stands apart.
    assert page.count('stroke-width="2.2"') == 3 * 2
    assert 'false stops' not in markdown(dataclasses.replace(found, stop='arrival'))
    picture = cv2.imdecode(np.frombuffer(robustness_png(found), np.uint8), cv2.IMREAD_COLOR)
    assert picture.shape[1] > picture.shape[0] and len(np.unique(picture)) > 50

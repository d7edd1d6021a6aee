"""The four tasks: their pure functions, and what an environment makes of them."""

import numpy as np
import pytest

from vn_nav.errors import UserError
from vn_nav.scenes import house_scenes
from vn_sim_bridge.floor.distance import FloorDistance
from vn_sim_bridge.houses.labels import LABEL, LABELS
from vn_sim_bridge.houses.objects import GOAL_OBJECTS, object_scene
from vn_sim_bridge.houses.procedural import generate_house
from vn_sim_bridge.navigation import tasks
from vn_sim_bridge.navigation.env import NavigationEnv
from vn_sim_bridge.navigation.env_config import EnvConfig


def make(task, **options):
    return NavigationEnv(EnvConfig(**{
        'scenes': ('house:7', 'house:3'), 'num_envs': 8, 'size': 48, 'task': task} | options))


def oracle_ends(env, steps):
    """Terminated and truncated episodes under the shortest-path action."""
    ends = [0, 0]
    for _ in range(steps):
        _, reward, terminated, truncated, info = env.step(env.oracle_actions())
        assert np.array_equal(reward, terminated.astype(np.float32))
        ends[0] += terminated.sum()
        ends[1] += truncated.sum()
    return ends


def test_arrival_needs_place_and_heading():
    assert tasks.arrived(np.array([0.6, 0.61, 0.1]), np.radians([30.0, 0.0, 31.0])).tolist() == [
        True, False, False]
    assert tasks.heading_error(np.pi - 0.1, -np.pi + 0.1) == pytest.approx(0.2)


def test_shaping_is_progress_and_contacts():
    reward = tasks.shaping_reward(np.array([3.0, 2.0]), np.array([2.5, 2.25]),
                                  np.array([False, True]), progress=2.0, collision=-0.1)
    assert np.allclose(reward, [1.0, -0.6])


@pytest.mark.parametrize('progress', [0.0, 2.0])
def test_a_distance_that_nobody_knows_is_no_progress(progress):
    reward = tasks.shaping_reward(np.array([np.inf, np.inf, 1.0]), np.array([2.5, np.inf, np.nan]),
                                  np.array([False, True, False]), progress=progress,
                                  collision=-0.1)
    assert np.allclose(reward, [0.0, -0.1, 0.0])


def test_a_room_is_seen_when_its_objects_fill_a_share_of_the_picture():
    labels = np.zeros((2, 20, 20), np.uint8)
    labels[0, 0, :18] = LABEL['toilet']  # 4.5 %
    labels[1, 0, :17] = LABEL['toilet']
    bathroom, kitchen = (tasks.room_classes(LABELS, kind) for kind in ('bathroom', 'kitchen'))
    assert tasks.shows_room(labels, bathroom).tolist() == [True, False]
    assert not tasks.shows_room(labels, kitchen).any()
    # Another simulator has other numbers, above 255 too.
    names = [*map(str, range(300)), 'toilet']
    wide = np.where(labels == LABEL['toilet'], np.uint16(300), np.uint16(44))
    assert tasks.shows_room(wide, tasks.room_classes(names, 'bathroom')).tolist() == [True, False]
    for kind in ('kitchen', 'cellar'):
        with pytest.raises(UserError, match='room_must_see'):
            tasks.room_classes(names, kind)


@pytest.mark.parametrize('objects', [1, 4])
def test_object_goal(objects):
    env = make('object', objects=objects)
    observation, info = env.reset(seed=0)
    present = env.simulator.object_models() >= 0
    assert (present.sum(axis=1) == objects).all()
    first = env.simulator.objects.pose[:, 0, :2].copy()
    assert (info['start_distance'] >= 2.0 - 0.2).all()
    arrived, gave_up = oracle_ends(env, 200)
    assert arrived > 20 and gave_up == 0
    _, later = env.reset()
    assert (np.hypot(*(env.simulator.objects.pose[:, 0, :2] - first).T) > 0.1).mean() > 0.8
    names = {env.goal_rooms[goal] for goal in [*info['goal'], *later['goal']]}
    assert names <= set(GOAL_OBJECTS) and len(names) > 1


def test_the_goal_picture_shows_the_object():
    env = make('object')
    for view, labels in zip(env.task.views, env.goal_segmentation, strict=False):
        share = (labels == LABEL[view.name]).mean()
        assert 0.004 < share < 0.5, (view.name, share)


def test_success_is_within_a_metre_of_the_object():
    env = make('object', num_envs=2, noise=False)
    env.reset(seed=3)
    target = env.simulator.objects.pose[:, 0]
    poses = env.simulator.poses.copy()
    poses[0, :2] = target[0, :2]
    env.simulator.place(np.arange(2), poses)
    *_, terminated, _, info = env.step(np.array([2, 2]))
    assert terminated.tolist() == [True, False]
    assert info['distance'][0] < 0.3 and info['distance'][1] > 1.0


@pytest.mark.parametrize('must_see', [False, True])
def test_room_goal(must_see):
    env = make('room', scenes=house_scenes((7, 3), 8), room_must_see=must_see)
    _, info = env.reset(seed=0)
    arrived, gave_up = oracle_ends(env, 150)
    assert arrived > 20 and gave_up == 0
    for n in range(8):
        goal = env._goal[n]
        kinds = {room.kind for room in env.places[env.place_index[n]].rooms
                 if room.rect in env.task.inside[goal]}
        assert kinds == {env.task.kinds[goal]}


def test_any_room_of_the_type_will_do():
    house = generate_house(3, rooms=12)
    kinds = [room.kind for room in house.rooms]
    twice = next(kind for kind in kinds if kinds.count(kind) > 1)
    rects = [room.rect for room in house.rooms if room.kind == twice]
    field = FloorDistance.to_rectangles(house.floor, rects)
    single = [FloorDistance.to_rectangles(house.floor, [rect]) for rect in rects]
    cells = house.floor.centres()
    nearest = np.min([one.at(cells) for one in single], axis=0)
    assert np.allclose(field.at(cells), nearest, atol=0.15)


def test_seeing_the_room_takes_two_decisions_in_a_row():
    house = generate_house(7)
    task = tasks.RoomGoal([house], 1, must_see=True, min_distance=1.0,
                          label_names=LABELS)
    task.begin(0, 0, (0, 0, 0), 1.0, 'right')
    goal = task.state['goal'][0]
    inside = np.array([[*task.views[goal].pose]])
    full = np.full((1, 8, 8), LABEL[tasks.ROOM_OBJECTS[task.kinds[goal]][0]], np.uint8)
    ends = []
    for labels, pose in ((full, inside), (0 * full, inside), (full, inside),
                         (full, inside + 100.0), (full, inside), (full, inside)):
        verdict = task.judge(tasks.Situation(
            np.array([True]), np.zeros(1), np.zeros(1), pose, labels,
            np.zeros((1, 0), np.int64), np.zeros((1, 0, 2))))
        ends.append(bool(verdict.success[0]))
    assert ends == [False] * 5 + [True]


def test_collect_counts_apples_and_lemons():
    env = make('collect', num_envs=4, objects=10, max_decisions=30, noise=False)
    observation, _ = env.reset(seed=0)
    assert (observation['goal_index'] == env.blank_goal).all() and len(env.goals) == 1
    models = env.simulator.object_models()
    assert ((models == 0).sum(axis=1) == 5).all() and ((models == 1).sum(axis=1) == 5).all()
    for model, value in ((0, 1.0), (1, -1.0)):
        item = np.argmax(env.simulator.object_models() == model, axis=1)
        poses = env.simulator.poses.copy()
        poses[:, :2] = env.simulator.objects.pose[np.arange(4), item, :2]
        env.simulator.place(np.arange(4), poses)
        observation, reward, terminated, _, _ = env.step(np.full(4, 2))
        assert np.allclose(reward, value) and not terminated.any()
        assert np.allclose(observation['last_reward'], value)
        assert (env.simulator.objects.scene[np.arange(4), item] == -1).all()
    for _ in range(28):
        _, reward, terminated, truncated, _ = env.step(np.full(4, 2))
    assert truncated.all() and not terminated.any()
    with pytest.raises(UserError, match='shortest-path'):
        env.oracle_actions()


@pytest.mark.parametrize('task', ['object', 'room', 'collect'])
def test_tasks_do_not_depend_on_the_number_of_environments_and_resume(task):
    options = {'scenes': ('house:7',), 'objects': 3, 'max_decisions': 12}
    small, large = make(task, num_envs=2, **options), make(task, num_envs=4, **options)
    one, _ = small.reset(seed=2)
    many, _ = large.reset(seed=2)
    rng = np.random.default_rng(0)
    for step in range(40):
        for key in one:
            assert np.array_equal(one[key], many[key][:2]), key
        if step == 20:
            copy = make(task, num_envs=4, **options)
            copy.reset(seed=8)
            copy.set_state(large.get_state())
            large = copy
        actions = rng.integers(0, 4, 4)
        one, *_ = small.step(actions[:2])
        many, *_ = large.step(actions)


def test_wrong_pictures_show_another_object():
    env = make('object', scenes=('house:7',), num_envs=16)
    right, info = env.reset(seed=0)
    env.set_shown_goal('wrong')
    wrong, other = env.reset(seed=0)
    assert np.array_equal(info['goal'], other['goal'])
    for n in range(16):
        assert env.task.views[right['goal_index'][n]].name == env.goal_rooms[info['goal'][n]]
        assert env.task.views[wrong['goal_index'][n]].name != env.goal_rooms[info['goal'][n]]


@pytest.mark.parametrize('options', [{'task': 'fly'}, {'objects': 0}, {'objects': 99}])
def test_bad_tasks_are_refused(options):
    with pytest.raises(UserError, match='received'):
        make(**({'task': 'object'} | options))
    with pytest.raises(UserError, match='an object is one of'):
        object_scene('unicorn')

"""Goal pictures with poses, written and read."""

import json

import numpy as np
import pytest

from vn_nav.errors import UserError
from vn_nav.robot import RobotSpec
from vn_sim_bridge.robot.goal_pictures import GoalPicture, load_goal_pictures, save_goal_pictures
from vn_sim_bridge.robot.simulated_robot import SimulatedRobot


def test_what_is_written_is_read(tmp_path):
    rng = np.random.default_rng(0)
    goals = [GoalPicture(rng.integers(0, 256, (20, 30, 3), np.uint8), (1.0, k, -0.5))
             for k in range(3)]
    save_goal_pictures(tmp_path / 'goals', goals)
    for wrote, read in zip(goals, load_goal_pictures(tmp_path / 'goals'), strict=True):
        assert np.array_equal(wrote.picture, read.picture) and wrote.pose == read.pose


@pytest.mark.parametrize('index', [
    None, '{', '[]', '{}', '[{"picture": "000.png"}]', '[{"picture": "000.png", "pose": [1, 2]}]',
    '[{"picture": "000.png", "pose": [1, 2, NaN]}]', '[{"picture": "no.png", "pose": [1, 2, 3]}]',
    '[{"picture": "goals.json", "pose": [1, 2, 3]}]'])
def test_what_is_none_is_refused(tmp_path, index):
    if index is not None:
        (tmp_path / 'goals.json').write_text(index)
    with pytest.raises(UserError, match='goal'):
        load_goal_pictures(tmp_path)


def test_episodes_go_to_these_poses_and_not_into_walls():
    house = SimulatedRobot('house:7?rooms=2', robot=RobotSpec(), size=16).place
    cells = house.floor.centres()
    poses = [(*cells[0], 0.5), (*cells[-1], 1.0)]
    robot = SimulatedRobot('house:7?rooms=2', robot=RobotSpec(), size=16, goal_poses=poses)
    seen = set()
    for index in range(12):
        episode = robot.begin_episode(index)
        assert robot.goal.pose[:3] == pytest.approx(poses[episode.goal])
        assert robot.distance() == pytest.approx(episode.start_distance) and (
            episode.start_distance >= 0.99)
        seen.add(episode.goal)
    assert seen == {0, 1}
    with pytest.raises(UserError, match='can stand'):
        SimulatedRobot('house:7?rooms=2', robot=RobotSpec(), size=16,
                       goal_poses=[(-50.0, 0.0, 0.0)])
    assert json.dumps(robot.goal.pose)  # as the bridge says it

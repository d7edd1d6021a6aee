"""The demo's control without ROS sees what the robot on ROS sees; what the demo prints fits."""

import json
import re

import numpy as np
import pytest
from paths import ROOT
from ros_harness import write_checkpoint

from vn_nav.cli import demo
from vn_nav.cli.world import make_env
from vn_nav.evaluation.bag_episodes import drives_from_bag
from vn_nav.evaluation.metrics import Episode, summarise
from vn_nav.policy.checkpoint import load_checkpoint
from vn_nav.report import demo_page as report
from vn_nav.report import terminal
from vn_nav.robot import load_robot
from vn_sim_bridge.render.randomisation import load_randomisation
from vn_sim_bridge.robot.simulated_robot import SimulatedRobot

EPISODES, HOUSE = 6, 'house:7'
BAG = ROOT / 'bags' / 'house_drive'


@pytest.mark.slow
@pytest.mark.parametrize('size', [84, 48])
def test_the_control_without_ros_has_the_same_goals_pictures_starts_and_lights(tmp_path, size):
    checkpoint = load_checkpoint(write_checkpoint(tmp_path / 'checkpoint', size=size))
    checkpoint.info['randomisation'] = 'standard'
    told = demo.bridge_parameters(checkpoint, HOUSE, EPISODES, 50)
    robot = SimulatedRobot(  # as the bridge makes it out of its parameters
        told['scene'], robot=load_robot(told['robot']), size=told['size'],
        seed=told['seed'], max_decisions=told['max_decisions'], stop=told['stop'],
        randomisation=load_randomisation(told['randomisation']))
    env = demo.control_env(make_env, checkpoint, HOUSE, EPISODES, 50)
    seen, info = env.reset(seed=demo.SEED)
    assert (env.action_names, env.config.stop) == (checkpoint.config.actions, robot.stop_rule)
    for k in range(EPISODES):
        episode = robot.begin_episode(k)
        assert episode.goal == info['goal'][k]
        assert episode.start == tuple(info['pose'][k])
        assert episode.start_distance == pytest.approx(info['start_distance'][k], abs=1e-6)
        goal = env.goals[seen['goal_index'][k]]
        np.testing.assert_array_equal(robot.goal_frames().rgb[0], goal)
        robot._shown = None  # a late camera shows the picture before
        np.testing.assert_array_equal(robot.observe().rgb[0], seen['image'][k])
        assert robot._motion_scale == env._motion_scale[k]
    assert len({goal.tobytes() for goal in env.goals[seen['goal_index']]}) > 1


def result(*, declared: bool) -> dict:
    """Figures as wide as they get."""
    own = summarise([Episode(True, 9.0, 9.0, 300, 250, 9.0, 0.1, 0.1,
                             declared=True if declared else None)] * 100)
    return {place: own | {'stop': 'declared' if declared else 'arrival', 'random': own,
                          'without_ros': own} for place in ('trained', 'unseen')}


@pytest.mark.parametrize('declared', [True, False])
def test_the_tables_fit_eighty_columns(capsys, declared):
    for figures in result(declared=declared).values():
        terminal.print_table('title', *demo._cells(figures), width=80)
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) <= 80 and not any('…' in line for line in lines)
    rows = [line for line in lines if line.startswith(('over ROS 2', 'without ROS', 'random'))]
    assert len(rows) == 6  # one table a house, not split
    assert all('100% (100-100)' in row and '300 (300-300)' in row for row in rows)
    assert not declared or 'declared' in lines[2]


def test_a_table_wider_than_the_terminal_is_split_and_loses_nothing(capsys):
    headings = ['policy', *(f'heading\n{k}' for k in range(9))]
    lines = [['right goal, sample', *(f'{k}.{row} (0.00-1.00)' for k in range(9))]
             for row in range(2)]
    terminal.print_table('a title of [some] length', headings, lines, width=80)
    printed = capsys.readouterr().out
    assert max(map(len, printed.splitlines())) <= 80 and '[some]' in printed
    assert all(printed.count(cell) == 1 for line in lines for cell in line[1:])
    assert printed.count('right goal, sample') == 6  # in each of three parts
    terminal.print_table('title', headings, lines)  # into a pipe: one table
    assert capsys.readouterr().out.count('right goal, sample') == 2
    terminal.print_table('title', ['a', 'b'], [['key', 'word ' * 30 + 'end']], width=40)
    assert 'end' in capsys.readouterr().out


def test_decisions_have_an_interval(tmp_path):
    episodes = [Episode(True, 5.0, 5.0, decisions, 0, 9.0, 0.1, 0.1) for decisions in
                (10, 20, 60, 110)]
    figures = summarise(episodes)
    low, high = figures['decisions_interval']
    assert figures['decisions'] == 50 and 10 <= low < 50 < high <= 110
    json.dumps(figures)


def test_the_film_strip_counts_decisions():
    drive, = drives_from_bag(BAG, pictures=True)
    recorded, = drive.episodes
    count = recorded.episode.decisions
    assert list(recorded.pictures) == list(range(1, count + 1))
    page = report._journey(recorded, {})
    assert f'after {count} decisions' in page
    captions = [int(n) for n in re.findall(r'<figcaption>(?:decision )?(\d+)</figcaption>', page)]
    assert captions[0] == 1 and captions[-1] == count and len(captions) == report.STRIP
    # Each is the picture at rest before its decision: as many motions lie between them.
    assert all((a != b).any() for a, b in zip(recorded.pictures.values(),
                                              list(recorded.pictures.values())[1:], strict=False))

"""The map of a policy that searches, as a picture and as a film."""

import dataclasses
import io
import math

import numpy as np
import pytest
from PIL import Image
from small_search import ROBOT, small_search

from vn_nav.errors import UserError
from vn_nav.evaluation.bag_episodes import Drive, RecordedEpisode
from vn_nav.evaluation.bag_searches import PlacedSearch
from vn_nav.evaluation.evaluator import PolicyActor
from vn_nav.evaluation.filming import film_episode
from vn_nav.evaluation.metrics import Episode, summarise
from vn_nav.policy.search.look import BINS, COLUMNS, RANGE_CENTRES, RANGE_EDGES, column_bearings
from vn_nav.policy.search.searcher import Searcher, Sight
from vn_nav.policy.search.snapshot import FREE, OCCUPIED, UNKNOWN, Guess, Snapshot, snapshot
from vn_nav.report.demo_page import write_report
from vn_nav.report.evaluation_page import search_map
from vn_nav.report.film import MOST_FRAMES, WIDTH, frames, gif
from vn_nav.report.search_map import (
    BEST_RGB,
    FREE_RGB,
    OCCUPIED_FROM,
    OCCUPIED_RGB,
    ROBOT_RGB,
    UNKNOWN_RGB,
    Window,
    draw,
    known_bounds,
)
from vn_sim_bridge.navigation.env import NavigationEnv
from vn_sim_bridge.navigation.env_config import EnvConfig


def searching(distance=2.0, steps=1):
    """A searcher that has seen an arc of obstacles so many metres away, and perhaps the goal."""
    searcher = Searcher(ROBOT.moves, column_bearings(math.radians(90)), RANGE_EDGES, 0.18)
    ranges = np.eye(BINS)[np.full(COLUMNS, np.argmin(np.abs(RANGE_CENTRES - distance)))]
    for _ in range(steps):
        searcher.step(Sight(ranges, np.array([1.5, 0.5]), 0.2, np.array([0.0, 1.0]), 0.9, 0.1), -1,
                      np.zeros(3))
    return searcher


def test_a_snapshot_is_what_the_searcher_knows_and_stays_so():
    searcher = searching(steps=2)
    seen = snapshot(searcher)

    def cell(x, y):
        column, row = np.floor((np.array([x, y]) - seen.origin) / seen.cell).astype(int)
        return seen.cells[row, column]
    assert FREE <= cell(1.0, 0.0) < OCCUPIED_FROM and cell(0.0, 0.0) == FREE
    end = seen.origin[0] + seen.cell * seen.cells.shape[1]
    arc = [cell(r, 0.0) for r in np.arange(1.5, end - 0.06, 0.1)]
    assert OCCUPIED in arc and UNKNOWN in seen.cells
    assert (np.array(arc) >= OCCUPIED_FROM).sum() < len(arc)  # an arc, not all behind it
    for edge in (seen.cells[0], seen.cells[-1], seen.cells[:, 0], seen.cells[:, -1]):
        assert (edge != UNKNOWN).any()  # cut to what is known
    guess = seen.guesses[0]
    assert guess.pose == pytest.approx([1.5, 0.5, math.pi / 2], abs=1e-6) and guess.weight > 0
    before = seen.cells.copy(), guess.pose.copy()
    searcher.step(Sight(np.eye(BINS)[np.full(COLUMNS, 3)], np.array([1.0, 0.0]), 0.1,
                        np.array([1.0, 0.0]), 0.9, 0.1), 0, np.array([0.5, 0.0, 0.0]))
    assert np.array_equal(seen.cells, before[0]) and np.array_equal(guess.pose, before[1])
    assert seen.pose == pytest.approx([0, 0, 0])


def colour(image, view, x, y):
    column, row = np.floor(view.pixels(np.array([[x, y]]))[0] / 16 + 0.5).astype(int)
    return tuple(image[row, column].tolist())


def one_wall(**fields):
    """Three metres of free floor ahead of the origin, and a wall behind them."""
    cells = np.full((21, 41), UNKNOWN, np.int8)
    cells[5:16, 10:40] = FREE
    cells[5:16, 40] = OCCUPIED
    return Snapshot(**{'cells': cells, 'origin': np.array([-1.05, -1.05]), 'cell': 0.1,
                       'pose': np.array([0.0, 0.0, 0.0]), 'guesses': (), 'aim': 'look',
                       'arrival': 0.0} | fields)


@pytest.mark.parametrize('yaw', [0.0, math.pi / 2, 2.0, -2.5])
def test_a_map_is_drawn_where_its_frame_lies(yaw):
    frame = np.array([3.0, -2.0, yaw])
    view = Window.about((-2, -7, 8, 3), 400, 400)
    image = draw(one_wall(guesses=(Guess(np.array([2.0, 0.2, 0.0]), 20.0),)), view, frame)
    along, left = (np.array([math.cos(a), math.sin(a)]) for a in (yaw, yaw + math.pi / 2))
    at = frame[:2]
    assert colour(image, view, *(at + 1.2 * along)) == FREE_RGB
    assert colour(image, view, *(at + 3.0 * along)) == OCCUPIED_RGB
    assert colour(image, view, *(at + 3.3 * along)) == UNKNOWN_RGB
    assert colour(image, view, *(at + 1.2 * along + 0.8 * left)) == UNKNOWN_RGB
    assert colour(image, view, *at) == ROBOT_RGB
    assert colour(image, view, *(at + 2.2 * along + 0.2 * left)) == BEST_RGB
    assert known_bounds(one_wall(), frame) == pytest.approx((
        *np.min([at + a * along + b * left for a in (-1.05, 3.05) for b in (-1.05, 1.05)], 0),
        *np.max([at + a * along + b * left for a in (-1.05, 3.05) for b in (-1.05, 1.05)], 0)))


def test_an_empty_map_is_drawn_as_well():
    seen = one_wall(cells=np.zeros((0, 0), np.int8))
    image = draw(seen, Window.about((-1, -1, 1, 1), 60, 60), np.zeros(3))
    assert colour(image, Window.about((-1, -1, 1, 1), 60, 60), 0.8, 0.8) == UNKNOWN_RGB
    assert (image != UNKNOWN_RGB).any()  # the robot


def test_more_evidence_is_a_larger_arrow():
    view = Window.about((-2, -2, 4, 2), 300, 200)
    guess = np.array([2.0, 0.2, 0.0])
    sizes = [(draw(one_wall(guesses=(Guess(guess, weight),)), view, np.zeros(3))
              == BEST_RGB).all(2).sum() for weight in (0.5, 5.0, 50.0)]
    assert 0 < sizes[0] < sizes[1] < sizes[2]


def filmed(limit=7, **options):
    def make(size, count=1):
        return NavigationEnv(EnvConfig(scenes=('house:3?rooms=2',), num_envs=count, size=size,
                                       max_decisions=limit, stop='declared', odometry='drift'))
    env, twin = make(48, options.pop('count', 1)), make(96)
    actor = PolicyActor(env, small_search(), 'greedy', 0, threshold=1.0)
    return film_episode(env, actor, seed=5, twin=twin)


@pytest.fixture(scope='module')
def film():
    return filmed()


def test_the_twin_sees_what_the_policy_sees_larger(film):
    assert film.pictures.shape == (7, 96, 96, 3) and film.seen == 48 and film.limit == 7
    assert len(film.searches) == film.episode.decisions == 7 and not film.episode.success
    assert len(film.episode.trajectory) == 8
    env = NavigationEnv(EnvConfig(scenes=('house:3?rooms=2',), num_envs=1, size=96))
    env.reset(seed=5)
    for pose, picture in zip(film.episode.trajectory, film.pictures, strict=False):
        env.simulator.place(np.arange(1), np.array([[*pose, 0.0]]))
        assert np.abs(env.simulator.observe().rgb[0].transpose(1, 2, 0).astype(int)
                      - picture).mean() < 3
    # It drifts, but not far in seven decisions.
    last = film.searches[-1].pose
    start, pose = film.episode.trajectory[0], film.episode.trajectory[-2]
    assert np.hypot(*last[:2]) == pytest.approx(np.hypot(*(pose[:2] - start[:2])), abs=0.15)
    known = [np.count_nonzero(search.cells != UNKNOWN) for search in film.searches]
    assert known == sorted(known) and known[0] < known[-1]


def test_a_film_is_a_gif_with_a_frame_a_decision_and_one_of_the_end(film):
    data = gif(film, 'a house, never seen')
    with Image.open(io.BytesIO(data)) as image:
        assert (image.format, image.size[0], image.n_frames) == ('GIF', WIDTH, 8)
        assert image.info['loop'] == 0
        shown = []
        for k in range(image.n_frames):
            image.seek(k)
            shown.append(np.asarray(image.convert('RGB'), int))
    for k, wanted in enumerate(frames(film, 'a house, never seen')):
        assert np.abs(shown[k] - wanted).mean() < 4, k  # few colours are lost
    assert np.abs(shown[0] - shown[-1]).mean() > 1
    assert len(data) < 8 * 60_000


def test_long_films_leave_decisions_out_but_not_the_end(film):
    long = dataclasses.replace(film, searches=film.searches * 40,
                               pictures=np.tile(film.pictures, (40, 1, 1, 1)))
    assert MOST_FRAMES // 2 < len(list(frames(long, ''))) <= MOST_FRAMES + 2


def test_only_a_search_is_filmed_and_one_at_a_time():
    with pytest.raises(UserError, match='one environment'):
        filmed(count=2)


PLAN = {'bounds': [0, 0, 6, 3], 'walls': [[0, 0, 6, 0.1]], 'obstacles': [[1, 1, 2, 2, 'bed']],
        'rooms_list': []}
EPISODE = Episode(
    success=True, start_distance=3.0, path_length=3.0, decisions=2, collisions=0, seconds=9.0,
    stop_distance=0.1, stop_heading=0.1, trajectory=np.array([[1.0, 1, 0], [1.5, 1, 0]]),
    goal_pose=(3.0, 1.0, 0.0), search=one_wall())


def test_a_page_shows_the_map_at_the_end():
    assert search_map(EPISODE, PLAN).startswith('<img alt="the map of the policy" src="data:')


@pytest.mark.parametrize('count, shown', [(0, 0), (1, 1), (3, 3), (9, 4)])
def test_the_demos_page_shows_how_the_map_grew(tmp_path, count, shown):
    known = {3 * k + 1: PlacedSearch(k, float(k), one_wall(), np.array([1.0, 1.0, 0.3]))
             for k in range(count)}
    look = np.zeros((8, 8, 3), np.uint8)
    goal = [3.0, 1.0, 0.0, 0.0]
    recorded = RecordedEpisode({'episode': 0, 'goal_pose': goal}, EPISODE, EPISODE.trajectory,
                               look, {1: look}, known)
    figures = summarise([EPISODE]) | {
        'random': summarise([EPISODE]), 'scene': 'house:7', 'checkpoint': 'mine',
        'max_decisions': 100, 'stop': 'arrival'}
    write_report(tmp_path / 'page.html', [Drive(PLAN | {
        'scene': 'house:7', 'area': 18.0, 'goals': [{'pose': goal}]}, [recorded])],
        {'unseen': figures, 'date': 'today', 'seconds': 1.0})
    page = (tmp_path / 'page.html').read_text()
    assert page.count('alt="map"') == shown and page.count('<svg') == 1
    assert ('map as it grew' in page) == (count > 0)
    if count == 9:
        assert 'its map at decision 1<' in page and '>25<' in page

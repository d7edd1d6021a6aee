"""What every figure means: against hand-made cases, and against loops over random episodes."""

import math

import numpy as np
import pytest

from vn_nav.arrival import radius_of
from vn_nav.evaluation.metrics import Episode, bootstrap_interval, path_efficiency, summarise


def episode(**fields):
    return Episode(**{'success': True, 'start_distance': 4.6, 'path_length': 8.0, 'decisions': 20,
                      'collisions': 2, 'seconds': 30.0, 'stop_distance': 0.3, 'stop_heading': 0.1,
                      'reward': 1.0} | fields)


def random_episodes(count=40, seed=0):
    rng = np.random.default_rng(seed)
    return [episode(success=bool(rng.random() < 0.6), start_distance=rng.uniform(1, 9),
                    path_length=rng.uniform(0, 20), decisions=int(rng.integers(1, 300)),
                    collisions=int(rng.integers(0, 3)), seconds=rng.uniform(1, 400),
                    stop_distance=rng.uniform(0, 8), stop_heading=rng.uniform(0, math.pi),
                    reward=rng.normal()) for _ in range(count)]


def test_path_efficiency_is_shortest_over_driven():
    assert path_efficiency(episode()) == pytest.approx(0.5)
    assert path_efficiency(episode(path_length=3.0)) == 1.0
    # Objects are reached from a metre away, rooms at their edge.
    ways = [path_efficiency(episode(start_distance=4.0, path_length=4.0, arrival_radius=radius_of(
        task))) for task in ('image', 'object', 'room')]
    assert ways == pytest.approx([0.85, 0.75, 1.0])
    assert path_efficiency(episode(success=False)) == 0.0
    assert path_efficiency(episode(start_distance=0.5, path_length=0.0)) == 1.0


def test_summary():
    figures = summarise([episode(), episode(success=False, collisions=0, decisions=60, reward=0)])
    assert figures['success'] == 0.5 and figures['spl'] == pytest.approx(0.25)
    assert figures['collisions'] == 2 / 80 and figures['contact_free_success'] == 0.0
    assert figures['decisions'] == 40 and figures['return'] == 0.5
    low, high = figures['success_interval']
    assert low <= 0.5 <= high
    assert 'false_stops' not in figures
    with pytest.raises(ValueError, match='at least one'):
        summarise([])


def test_summary_against_a_loop():
    episodes = random_episodes()
    total = dict.fromkeys(('success', 'spl', 'contact_free_success', 'stop_error_m',
                           'stop_error_deg', 'decisions', 'seconds', 'return',
                           'start_distance'), 0.0)
    touched = driven = 0
    for e in episodes:
        shortest = max(e.start_distance - 0.6, 0)
        total['success'] += e.success
        total['spl'] += shortest / max(shortest, e.path_length) if e.success else 0
        total['contact_free_success'] += e.success and not e.collisions
        total['stop_error_m'] += e.stop_distance
        total['stop_error_deg'] += e.stop_heading * 180 / math.pi
        total['decisions'] += e.decisions
        total['seconds'] += e.seconds
        total['return'] += e.reward
        total['start_distance'] += e.start_distance
        touched, driven = touched + e.collisions, driven + e.decisions
    figures = summarise(episodes)
    for name, value in total.items():
        assert figures[name] == pytest.approx(value / len(episodes)), name
    assert figures['collisions'] == pytest.approx(touched / driven)


def test_declared_stops_are_counted_and_never_mixed_with_arrival():
    right = episode(declared=True, reached=True)
    false = episode(declared=True, success=False)
    missed = episode(declared=False, success=False, reached=True)
    figures = summarise([right, false, false, missed])
    assert figures['success'] == 0.25 and figures['declared'] == 0.75
    assert figures['false_stops'] == 0.5 and figures['reached'] == 0.5
    with pytest.raises(ValueError, match='not mixed'):
        summarise([right, episode()])


def test_habitats_rule_asks_for_a_metre_whatever_the_heading():
    there = episode(declared=True, reached=True, path_length=9.2)  # of a start 4.6 m away
    turned = episode(declared=True, success=False, stop_distance=0.9, stop_heading=3.0)
    away = episode(declared=True, success=False, stop_distance=1.1)
    silent = episode(declared=False, success=False, reached=True)
    figures = summarise([there, turned, away, silent])
    assert figures['success'] == 0.25 and figures['within_1m'] == 0.5
    assert figures['spl_within_1m'] == pytest.approx((4.6 / 9.2 + 4.6 / 8) / 4)
    assert summarise([episode(declared=True, unit='steps')])['within_1m'] is None
    assert 'within_1m' not in summarise([episode()])


def test_stops_at_a_shown_picture_are_counted_where_another_was_shown():
    at = episode(declared=True, success=False, at_shown=True)
    passing = episode(declared=False, success=False, at_shown=True)
    figures = summarise([at, passing, episode(declared=True, success=False, at_shown=False)])
    assert figures['stops_at_shown'] == pytest.approx(1 / 3)
    assert 'stops_at_shown' not in summarise([episode(declared=True)])


def test_bootstrap_interval_narrows_with_episodes():
    few, many = (bootstrap_interval([0, 1] * n) for n in (10, 400))
    assert few[1] - few[0] > 3 * (many[1] - many[0])

"""How two policies differ along a recorded drive."""

import dataclasses
import json

import numpy as np
import pytest
from small_bags import FIXTURE, START

from vn_nav.bags.shadow.compare import (
    Answer,
    Shadow,
    as_json,
    compare,
    figures,
    markdown,
    read_shadow,
)
from vn_nav.errors import UserError


def shadow_of(choices, speed=0.0, episodes=None, done='forward'):
    """Answers a second apart, and a command at each."""
    episodes = episodes or [0] * len(choices)
    answers = [Answer(START + k * 10**9, episode, choice, done) for k, (choice, episode)
               in enumerate(zip(choices, episodes, strict=True)) if choice]
    return Shadow(answers, {a.time: np.array([speed, 0.0, -2 * speed, 0.0]) for a in answers})


def test_how_two_policies_differ_is_counted():
    a = shadow_of(['forward', 'forward', 'forward', 'arrived', 'arrived', 'forward', 'forward'],
                  0.1, [0, 0, 0, 0, 1, 1, 1])
    b = shadow_of(['forward', 'backward', 'backward', 'forward', 'backward', 'forward', None],
                  0.3, [0, 0, 0, 0, 1, 1, 1])
    b.commands[START + 1] = np.zeros(4)  # one that a did not give
    found = compare(a, b, ('old', 'new'), ([0.01, 0.03], [0.02]))
    assert found.decisions == 6 and found.alone == {'a': 1, 'b': 0}
    assert found.agree == pytest.approx(2 / 6)
    assert found.confusion == {'arrived': {'forward': 1, 'backward': 1},
                               'forward': {'forward': 2, 'backward': 2}}
    assert found.arrived == {'a': [3.0, 4.0], 'b': [], 'both': []}
    assert found.commands == 6
    assert found.mean_dv == pytest.approx(0.2) and found.mean_dw == pytest.approx(0.4)
    assert found.drive == {'a': pytest.approx(5 / 7), 'b': pytest.approx(3 / 6)}
    # An episode's end ends what is in a row.
    assert found.disagreements == 2
    assert found.first == found.longest[0]
    assert dataclasses.astuple(found.first) == (0, 1.0, 3.0, 3, 'forward', 'backward')
    assert dataclasses.astuple(found.longest[1]) == (1, 4.0, 4.0, 1, 'arrived', 'backward')
    assert found.latency['a'] == {'median': 0.02, 'p95': pytest.approx(0.029)}
    assert json.loads(as_json(found))['confusion'] == found.confusion
    rows = dict(figures(found))
    assert rows['of them the same'] == '33.3%' and rows['arrived'] == 'old 2, new 0, both 0'
    assert '1.00 to 3.00 s (episode 0)' in rows['the first']
    assert 'action filter' not in rows
    a.filtered = {'decisions': 6, 'acted': 4, 'changed': 1}
    found = compare(a, b, ('old', 'new'), ([], []))
    assert json.loads(as_json(found))['filtered'] == {'a': a.filtered, 'b': None}
    assert dict(figures(found))['action filter'] == (
        'old acted at 4 of 6 decisions, changed 1; new none')
    text = markdown(found)
    assert '| forward | 2 | 2 |' in text and r'mean \|dv\|' in text


def test_drives_with_nothing_in_common_are_refused(tmp_path):
    a = shadow_of(['forward'])
    b = Shadow([a.answers[0]._replace(time=1)], {})
    with pytest.raises(UserError, match='in common'):
        compare(a, b, ('a', 'b'), ([], []))
    with pytest.raises(UserError, match='vn_nav bag drive'):
        read_shadow(FIXTURE)
    same = compare(a, a, ('a', 'b'), ([], []))
    assert same.agree == 1.0 and same.first is None and same.longest == []

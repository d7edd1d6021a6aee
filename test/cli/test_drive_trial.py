"""`vn_nav drive-trial` for real, small: both bases, over ROS, and what is counted of them."""

import json
import threading
import time
from types import SimpleNamespace

import pytest
from ros_harness import write_checkpoint

from vn_nav.cli import drive_trial, main
from vn_nav.evaluation.bag_episodes import drives_from_bag
from vn_nav.report.trial_page import section

pytestmark = [pytest.mark.ros, pytest.mark.slow, pytest.mark.timeout(240)]  # drives over ROS


def test_both_bases_are_driven_once_and_counted_from_their_bags(tmp_path, capsys):
    sure = write_checkpoint(tmp_path / 'sure', arrival=0.93, stop_threshold=0.5)
    words = ['drive-trial', '--out', str(tmp_path / 'out'), '--checkpoint', str(sure),
             '--scene', 'house:7?rooms=2', '--episodes', '2', '--set', 'settle_time=0.2',
             '--keep', str(tmp_path / 'trial.json')]
    assert main(words) == 0
    result = json.loads((tmp_path / 'out' / 'result.json').read_text())
    assert list(result['bases']) == ['ideal', 'harsh'] and len(result['success_difference']) == 3
    starts = []
    for base, figures in result['bases'].items():
        # It declares at the first picture, where it stands.
        assert (figures['episodes'], figures['declared'], figures['false_stops'],
                figures['decisions'], figures['good_stop_m']) == (2, 1, 1, 1, None)
        (drive,) = drives_from_bag(tmp_path / 'out' / 'bags' / f'{base}-2027')
        starts.append([one.facts['start'] for one in drive.episodes])
        kept = json.loads((tmp_path / 'out' / f'{base}-2027.json').read_text())
        assert ('settle_time' in kept['conditions']['policy']) == (base == 'harsh')
    assert starts[0] == starts[1]
    page = (tmp_path / 'out' / 'page.html').read_text()
    assert page.count('<svg') == 2 and 'false stop' in page and '<script' not in page
    trial = json.loads((tmp_path / 'trial.json').read_text())
    (scene,) = trial['scenes']
    assert trial['result'] == result and len(scene['drives']) == 2
    assert scene['drives'][0]['way'][0] == pytest.approx(starts[1][0][:2], abs=0.02)
    shown = section(trial)
    assert shown.count('<svg') == 2 and 'false stop' in shown and result['date'] in shown
    begun = time.monotonic()
    assert main(words) == 0
    assert time.monotonic() - begun < 10, 'nothing is driven again'
    assert '2 episodes of each base' in capsys.readouterr().out


def test_a_job_that_is_free_takes_the_next_leg(tmp_path, monkeypatch):
    legs = [drive_trial.Leg('harsh', f'house:{k}', k, 1) for k in range(6)]
    others, others_done, by_domain = set(legs[1:]), threading.Event(), {}

    def drive_one(self, leg, domain, ended):
        by_domain.setdefault(domain, []).append(leg)
        others.discard(leg)
        if not others:
            others_done.set()
        if leg == legs[0]:  # takes as long as all the others together
            assert others_done.wait(30)

    monkeypatch.setattr(drive_trial._Driver, '_drive_one', drive_one)
    checkpoint = SimpleNamespace(info={'randomisation': 'none'})
    driver = drive_trial._Driver(tmp_path, tmp_path, checkpoint, tmp_path, {}, {})
    driver.drive(legs, 2)
    assert sorted(map(len, by_domain.values())) == [1, 5]


@pytest.mark.parametrize('words, what', [
    (['--episodes', '0'], '--episodes'),
    (['--bases', 'ideal', '--keep', 'x.json'], '--keep'), (['--set', 'nonsense=1'], 'nonsense'),
    (['--set', 'settle_time=long'], 'settle_time'), (['--set', 'settle_time=9'], 'settle_time')])
def test_bad_options_are_one_line(tmp_path, capsys, words, what):
    assert main(['drive-trial', '--out', str(tmp_path / 'out'), *words]) == 2
    said = capsys.readouterr().err.strip()
    assert what in said and '\n' not in said

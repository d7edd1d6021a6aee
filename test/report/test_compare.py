"""Learning curves: averages, and when a success was reached, on curves with known crossings."""

import csv
import json
import re

import cv2
import numpy as np
import pytest

from vn_nav.cli import main
from vn_nav.errors import UserError
from vn_nav.report.chart import log_ticks, short, ticks
from vn_nav.report.compare import cells
from vn_nav.report.curves import average, grouped, reached, read_runs, summary

FRAMES = np.arange(1000, 100_001, 1000)


def write_run(folder, success, *, tau=None, minutes_each=0.1, frames=FRAMES, **more):
    """A metrics.csv; columns that no figure uses come between."""
    folder.mkdir(parents=True, exist_ok=True)
    columns = {'frames': frames, 'minutes': minutes_each * np.arange(1, len(frames) + 1),
               'fps': np.ones(len(frames)), 'tau': np.ones(len(frames)) if tau is None else tau,
               'success': success, **more}
    with open(folder / 'metrics.csv', 'w', newline='') as file:
        rows = csv.writer(file)
        rows.writerow(columns)
        rows.writerows(zip(*columns.values(), strict=True))
    return folder


def ramp(begin, end):
    """0 until `begin` frames, then rising evenly to 1 at `end`."""
    return np.clip((FRAMES - begin) / (end - begin), 0, 1)


def test_a_known_crossing(tmp_path):
    [run] = read_runs([write_run(tmp_path / 'run', ramp(20_000, 40_000))])
    assert reached(run, 0.5) == (30_000, pytest.approx(3.0))
    assert reached(run, 0.9) == (38_000, pytest.approx(3.8))
    [low] = read_runs([write_run(tmp_path / 'low', 0.6 * ramp(20_000, 40_000))])
    assert reached(low, 0.5) == (37_000, pytest.approx(3.7)) and reached(low, 0.9) is None


def test_a_success_inside_the_curriculum_is_none(tmp_path):
    tau = np.where(FRAMES < 55_000, 0.9, 1.0)
    [run] = read_runs([write_run(tmp_path / 'run', ramp(20_000, 40_000), tau=tau)])
    assert reached(run, 0.5) == (55_000, pytest.approx(5.5))
    [never] = read_runs([write_run(tmp_path / 'never', np.ones(100), tau=np.full(100, 0.99))])
    assert reached(never, 0.5) is None


def test_early_finishers_and_single_peaks_do_not_count(tmp_path):
    success = np.maximum(ramp(60_000, 80_000), FRAMES <= 4000)
    success[0] = np.nan  # no episode had ended
    success[30] = 0.95
    [run] = read_runs([write_run(tmp_path / 'run', success)])
    assert reached(run, 0.5) == (70_000, pytest.approx(7.0))


def test_the_table(tmp_path):
    folders = [write_run(tmp_path / f'fast-seed{k}', ramp(10_000 + 2000 * k, 30_000 + 2000 * k))
               for k in (1, 2, 3)]
    folders += [write_run(tmp_path / 'slow_s1', 0.6 * ramp(20_000, 40_000)),
                write_run(tmp_path / 'slow_s2', 0.3 * ramp(20_000, 40_000), minutes_each=0.2)]
    groups = grouped(read_runs(folders))
    assert {label: len(runs) for label, runs in groups.items()} == {'fast': 3, 'slow': 2}
    result = json.loads(json.dumps(summary(groups)))
    assert result['fast']['reached']['0.5'] == {
        'frames': [22_000, 24_000, 26_000], 'minutes': pytest.approx([2.2, 2.4, 2.6])}
    assert result['slow']['reached']['0.5']['frames'] == [37_000, None]
    assert result['slow']['success'] == pytest.approx([0.6, 0.3])
    headings, (fast, slow) = cells(result)
    assert len(headings) == len(fast) == len(slow)
    assert fast[:4] == ['fast', '3', '24 (22-26)', '2.4 (2.2-2.6)']
    assert slow[2] == '37; 1 of 2 not reached within 100'
    assert slow[3] == '3.7; 1 of 2 not reached within 20.0'
    assert slow[4] == 'not reached within 100' and slow[5] == 'not reached within 10.0'
    assert slow[6] == '0.45 (0.30-0.60)'


def test_the_average_of_seeds(tmp_path):
    """Straight lines stay straight lines; the band holds the seeds; the grid ends with both."""
    runs = read_runs([write_run(tmp_path / 'a-seed1', ramp(0, 100_000)),
                      write_run(tmp_path / 'a-seed2', 0.5 * ramp(0, 100_000)[:50],
                                frames=FRAMES[:50], tau=np.where(FRAMES[:50] < 25_500, 0.5, 1))])
    curve = average(runs, 'frames', 'success')
    assert curve.x[0] == 1000 and curve.x[-1] == 50_000
    inner = slice(5, -5)  # a window at the ends lies on one side
    assert curve.mean[inner] == pytest.approx(0.75 * curve.x[inner] / 100_000, abs=1e-6)
    assert curve.low[inner] == pytest.approx(0.5 * curve.x[inner] / 100_000, abs=1e-6)
    assert curve.high[inner] == pytest.approx(curve.x[inner] / 100_000, abs=1e-6)
    assert (curve.full == (curve.x >= 26_000)).all()
    std = average(runs, 'minutes', 'success', band='std')
    assert std.x[-1] == pytest.approx(5.0)
    assert std.high[inner] - std.mean[inner] == pytest.approx(
        0.25 * std.x[inner] / 10, abs=1e-6)
    log = average(runs, 'frames', 'success', log=True)
    assert np.diff(np.log10(log.x)) == pytest.approx(np.full(239, np.log10(50) / 239))


def test_smoothing_keeps_the_mean_of_noise(tmp_path):
    noise = 0.5 + 0.3 * (-1.0) ** np.arange(len(FRAMES))
    [run] = read_runs([write_run(tmp_path / 'run', noise)])
    curve = average([run], 'frames', 'success')
    assert abs(curve.mean - 0.5).max() < 0.17 and abs(curve.mean.mean() - 0.5) < 0.01


@pytest.fixture
def folders(tmp_path):
    return [str(write_run(tmp_path / name, ramp(begin, 50_000), **{'return': ramp(0, 9e4) * 7}))
            for name, begin in (('new <b>-seed1', 10_000), ('new <b>-seed2', 20_000),
                                ('old', 40_000))]


def test_the_page(tmp_path, folders, capsys):
    out, figures = tmp_path / 'page.html', tmp_path / 'table.json'
    assert main(['compare', *folders, '--out', str(out), '--json', str(figures)]) == 0
    assert 'new <b>' in capsys.readouterr().out
    page = out.read_text()
    assert page.count('<svg') == 1 and page.count('<polygon') == 4  # a band a curve and panel
    assert 'new &lt;b&gt; (2 runs)' in page and 'new <b>' not in page and '(1 run)' in page
    for outside in ('src=', 'href=', '<script', '<link', '@import', 'url('):
        assert outside not in page
    assert json.loads(figures.read_text())['old']['reached']['0.5']['frames'] == [45_000]


def test_pictures(tmp_path, folders):
    svg, png = tmp_path / 'a.svg', tmp_path / 'a.png'
    assert main(['compare', *folders, '--out', str(svg), '--metric', 'return', '--log']) == 0
    text = svg.read_text()
    assert text.startswith('<svg xmlns="http://www.w3.org/2000/svg"')
    names = set(re.findall(r'var\(--(\w+)\)', text))
    assert all(f'--{name}:' in text for name in names)  # it brings its own colours
    assert main(['compare', *folders, '--out', str(png), '--labels', 'x', 'y', 'z']) == 0
    picture = cv2.cvtColor(cv2.imread(str(png)), cv2.COLOR_BGR2RGB)
    assert picture.shape[1] == 2080
    for colour in ((0x2a, 0x62, 0xc9), (0xc4, 0x57, 0x2c), (0x11, 0x80, 0x5a)):  # three curves
        assert (abs(picture.astype(int) - colour).max(axis=2) <= 2).sum() > 500


def test_ticks():
    assert ticks(0, 1) == pytest.approx([0, 0.2, 0.4, 0.6, 0.8, 1])
    assert ticks(0, 1.6e6) == [0, 5e5, 1e6, 1.5e6]
    assert log_ticks(2000, 1.6e6) == [1e4, 1e5, 1e6]
    assert log_ticks(1, 60) == [1, 2, 5, 10, 20, 50]
    assert [short(v) for v in (0, 0.25, 1500, 2e6)] == ['0', '0.25', '1.5 k', '2 M']


@pytest.mark.parametrize('spoil, options, expected', [
    (lambda text: text.replace('tau', 'tao'), {}, 'without tau'),
    (lambda text: text, {'metric': 'speed'}, 'without speed'),
    (lambda text: text.splitlines()[0], {}, 'two rows'),
    (lambda text: '', {}, 'two rows'),
    (lambda text: text + '1,2\n', {}, 'numbers'),
    (lambda text: text + text.splitlines()[1] + '\n', {}, 'grow'),
    (lambda text: '\0\n' + text, {}, 'without frames'),
    (lambda text: text, {'labels': ['a', 'b']}, 'label'),
])
def test_bad_runs_are_refused(tmp_path, spoil, options, expected):
    file = write_run(tmp_path / 'run', ramp(0, 9e4)) / 'metrics.csv'
    file.write_text(spoil(file.read_text()))
    with pytest.raises(UserError, match=expected):
        read_runs([tmp_path / 'run'], **options)


def test_bad_comparisons_are_one_line(tmp_path, folders, capsys):
    for words, expected in (
            ([str(tmp_path / 'nowhere')], 'metrics.csv'), ([folders[0], folders[0]], 'once'),
            ([*folders, '--out', 'a.pdf'], '.html'),
            ([*folders, '--out', str(tmp_path / 'no' / 'a.html')], 'folder'),
            ([str(write_run(tmp_path / f'run{k}', ramp(0, 9e4))) for k in range(9)], 'curves')):
        assert main(['compare', *words]) == 2
        message = capsys.readouterr().err
        assert len(message.splitlines()) == 1 and expected in message and 'received' in message

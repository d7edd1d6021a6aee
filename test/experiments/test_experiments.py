"""Experiments: their files, their commands, the runs and what stays of them."""

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from vn_nav.cli.commands import build_parser
from vn_nav.cli.commands import main as vn_nav
from vn_nav.cli.train import train_config, world_options
from vn_nav.errors import UserError
from vn_nav.experiments.experiment import (
    SIZES,
    arguments,
    experiment_names,
    load_experiment,
    slug,
)
from vn_nav.experiments.reproduction import Reproduction
from vn_nav.report.chart import to_picture
from vn_nav.report.compare import WIDTH, chart
from vn_nav.report.curves import Run, reached, read_runs, thin
from vn_nav.report.experiment_page import spread, write_results
from vn_nav.report.page import CURVES
from vn_nav.robot import load_robot

CURVES_OF_THE_DOCS = Path(__file__).parents[2] / 'docs' / 'curves' / 'reproduce'
SMALL = """
title: small
question: does it run
claim: nothing
metric: length
falls: true
reach: [1000, 1]
prepare:
  - makes: "{files}/house.glb"
    command: "house export --seed 3 --rooms 1 --out {files}/house.glb"
train:
  scene: "house:3?rooms=1"
  preset: a2c
  max_decisions: 12
  set: {hidden: 16, features: 16, start_difficulty: 1.0}
evaluate: {episodes: 4, max_decisions: 12}
arms:
  LSTM: {}
  Frame stack: {set: {stacked_frames: 4}}
sizes:
  quick: {size: 84, frames: 1300}
  full: {size: 174, frames: 1_000_000}
"""


def small(tmp_path: Path, text: str = SMALL) -> Path:
    path = tmp_path / 'small.yaml'
    path.write_text(text)
    return path


def reproduction(path: str | Path, tmp_path: Path, size: str = 'quick', **options) -> Reproduction:
    return Reproduction(load_experiment(str(path)), size, tmp_path / 'runs', tmp_path / 'results',
                        **options)


def test_the_four_experiments_of_the_thesis_and_the_ablation_are_there():
    assert experiment_names() == ['ablation', 'fig5.4', 'fig5.5', 'fig5.6', 'fig5.7']


@pytest.mark.parametrize('size', SIZES)
@pytest.mark.parametrize('name', experiment_names())
def test_every_arm_is_a_training_that_the_command_line_takes(name, size, tmp_path):
    own = reproduction(name, tmp_path, size)
    parser = build_parser('train')
    for arm in own.experiment.arms:
        args = parser.parse_args(own.train_command(arm, 1))
        config, world = train_config(args), world_options(args)
        assert config.seed == 1 and config.threads == 1
        sized = own.experiment.sizes[size]
        assert config.frames == sized.get('arms', {}).get(arm, sized)['frames']
        assert args.size in (84, 174) and world['envs'] == 16  # table 5.1
        assert '{' not in ' '.join(own.train_command(arm, 1))
        if args.robot:
            assert set(args.actions.split(',')) <= set(load_robot(args.robot).action_names)
        evaluated = build_parser('evaluate').parse_args(own.evaluate_command(arm, 1))
        assert evaluated.robot == args.robot


def test_what_the_thesis_says_of_each_experiment():
    def options(name, arm):
        return train_config(build_parser('train').parse_args(
            Reproduction(load_experiment(name), 'full', Path('a'), Path('b')).train_command(
                arm, 0)))
    memory, stack = options('fig5.4', 'LSTM'), options('fig5.4', 'frame stack')
    assert (memory.stacked_frames, stack.stacked_frames) == (1, 4)
    assert memory.architecture == stack.architecture == 'unreal'  # one picture, no goal
    for config in (memory, stack):  # UNREAL's tasks in both
        assert min(config.value_replay, config.pixel_control, config.reward_prediction) > 0
    for name in ('fig5.4', 'fig5.5', 'fig5.6'):  # no curriculum
        assert options(name, next(iter(load_experiment(name).arms))).start_difficulty == 1.0
    ours, plain = options('fig5.7', 'A2CAT-VN'), options('fig5.7', 'UNREAL')
    assert (ours.curriculum, ours.start_difficulty) == ('frames', 0.3)
    assert ours.depth > 0 and ours.segmentation > 0 and ours.goal_segmentation > 0
    assert plain.depth == plain.segmentation == plain.goal_segmentation == 0
    assert options('fig5.5', 'ICRA 2017').scenes == len(
        load_experiment('fig5.5').train['scene']) == 4
    assert len(load_experiment('fig5.7').train['scene']) == 16


@pytest.mark.parametrize('size, houses', [('quick', 4), ('full', 16)])
def test_pictures_are_collected_where_is_trained(size, houses, tmp_path):
    own = reproduction('fig5.7', tmp_path, size)
    words = own.train_command('A2CAT-VN', 0)
    trained = [words[k + 1] for k, word in enumerate(words) if word == '--scene']
    assert len(trained) == houses and own._scenes()[1::2] == trained


def test_each_arm_of_the_ablation_has_one_task_more_than_none():
    experiment = load_experiment('ablation')
    parser = build_parser('train')
    own = Reproduction(experiment, 'quick', Path('a'), Path('b'))
    tasks = [set(train_config(parser.parse_args(own.train_command(arm, 0))).tasks)
             for arm in experiment.arms]
    assert tasks[0] == set() and all(len(one) == 1 for one in tasks[1:-1])
    assert set().union(*tasks[1:-1]) == tasks[-1] and len(tasks[-1]) == len(tasks) - 2


def test_options_become_a_command_line():
    assert arguments({'scene': ['a:{files}/x', 'b:y'], 'max_decisions': 9, 'bf16': False,
                      'overlap': True, 'channels': [1, 2, 3], 'set': {'depth': 0.1, 'x': True}},
                     {'files': '/f'}) == [
        '--scene', 'a:/f/x', '--scene', 'b:y', '--max-decisions', '9', '--no-bf16', '--overlap',
        '--channels', '1', '2', '3', '--set', 'depth=0.1', '--set', 'x=true']
    assert slug('ICRA 2017 (ours)') == 'icra-2017-ours'


@pytest.mark.parametrize('change, named', [
    (('title: small\n', ''), 'title'), (('metric: length', 'metric: [1]'), 'metric'),
    (('reach: [1000, 1]', 'reach: [much]'), 'reach'), (('falls: true', 'falls: maybe'), 'falls'),
    (('  full: {size: 174, frames: 1_000_000}\n', ''), 'sizes'), (('arms:', 'arm:'), 'arm'),
    (('  LSTM: {}', '  LSTM: 3'), 'arms'),
    (('{size: 84, frames: 1300}', '{size: 84, arms: {GRU: {frames: 3}}}'), 'GRU'),
    (('makes:', 'made:'), 'prepare'),
    (('  - makes:', '  - size: half\n    makes:'), 'half'),
])
def test_a_file_that_is_no_experiment_is_refused(change, named, tmp_path):
    with pytest.raises(UserError, match=named):
        load_experiment(str(small(tmp_path, SMALL.replace(*change))))


def test_bad_requests_are_one_line(tmp_path, capsys):
    path = str(small(tmp_path))
    for command in (['fig9.9'], [path, '--arms', 'GRU'], [path, '--seeds', '1', '1'],
                    [path, '--jobs', '0'], [path, '--page']):
        assert vn_nav(['reproduce', *command, '--out', str(tmp_path / 'runs')]) == 2
        said = capsys.readouterr().err
        assert said.startswith('vn_nav: ') and said.count('\n') == 1


@pytest.mark.slow
def test_an_experiment_runs_from_files_to_page_and_is_not_repeated(tmp_path, capsys):
    path, out = str(small(tmp_path)), tmp_path / 'runs'
    assert vn_nav(['reproduce', path, '--out', str(out), '--seeds', '0', '1']) == 0
    kept = out / 'results' / 'small-quick'
    assert (out / 'small-quick' / 'files' / 'house.glb').exists()
    runs = sorted(folder.name for folder in kept.iterdir() if folder.is_dir())
    assert runs == ['frame-stack-seed0', 'frame-stack-seed1', 'lstm-seed0', 'lstm-seed1']
    for name in runs:
        run, = read_runs([kept / name], 'length')
        assert run.columns['frames'][-1] >= 1300
    result = json.loads((kept / 'figures.json').read_text())
    assert list(result['arms']) == ['LSTM', 'Frame stack']
    own = result['arms']['LSTM']
    # In so few frames no mean is of 200 episodes: nothing is said to be reached.
    assert own['seeds'] == [0, 1]
    assert own['reached'] == {'1000': [None, None], '1': [None, None]}
    assert set(result['controls']) == {'random actions', 'shortest path', 'LSTM: blank goal',
                                       'Frame stack: blank goal'}
    assert result['controls']['shortest path']['decisions'] <= 12
    page, table = (kept / 'page.html').read_text(), (kept / 'table.md').read_text()
    for text in ('not held by', 'vn_nav train', 'vn_nav evaluate'):
        assert text in page
    assert str(tmp_path) not in table
    assert (kept / 'curves.png').stat().st_size > 5000

    # On another machine, with only what stayed: nothing is run again; a missing run is.
    shutil.rmtree(out / 'small-quick')
    capsys.readouterr()
    assert vn_nav(['reproduce', path, '--out', str(out), '--seeds', '0', '1']) == 0
    assert 'begins' not in capsys.readouterr().out
    shutil.rmtree(kept / 'lstm-seed1')
    assert vn_nav(['reproduce', path, '--out', str(out), '--seeds', '0', '1', '--arms',
                   'LSTM']) == 0
    said = capsys.readouterr().out
    assert 'lstm-seed1: begins' in said and 'lstm-seed0: begins' not in said


@pytest.mark.slow
@pytest.mark.parametrize('number', [signal.SIGTERM, signal.SIGHUP])
def test_a_stopped_experiment_stops_its_runs_and_goes_on(number, tmp_path):
    path = small(tmp_path, SMALL.replace('frames: 1300', 'frames: 20_000'))
    command = [sys.executable, '-m', 'vn_nav.cli', 'reproduce', str(path), '--out',
               str(tmp_path / 'runs'), '--seeds', '0', '--arms', 'LSTM']
    state = tmp_path / 'runs' / 'small-quick' / 'lstm-seed0' / 'training_state'
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    deadline = time.monotonic() + 120
    while not state.exists():
        assert process.poll() is None and time.monotonic() < deadline
        time.sleep(0.2)
    time.sleep(1.0)
    process.send_signal(number)
    process.communicate(timeout=90)
    log = state.parent.with_suffix('.log')
    assert not _alive(str(state.parent)) and 'evaluate' not in log.read_text()
    before = read_last_frames(state.parent)
    assert before < 20_000
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    assert '--resume' in log.read_text() and read_last_frames(state.parent) >= 20_000


def read_last_frames(folder: Path) -> float:
    lines = (folder / 'metrics.csv').read_text().splitlines()
    return float(lines[-1].split(',')[0]) if len(lines) > 1 else 0.0


def _alive(text: str) -> bool:
    """Whether a process runs whose command line has a text."""
    for folder in Path('/proc').iterdir():
        try:
            if folder.name.isdigit() and int(folder.name) != os.getpid() and (
                    text in (folder / 'cmdline').read_text()):
                return True
        except OSError:
            continue
    return False


@pytest.mark.slow
def test_a_command_that_fails_is_said_in_one_line(tmp_path, capsys):
    path = small(tmp_path, SMALL.replace('hidden: 16', 'hidden: none'))
    assert vn_nav(['reproduce', str(path), '--out', str(tmp_path / 'runs')]) == 2
    said = capsys.readouterr().err
    assert said.count('\n') == 1 and 'exit code 2' in said and '.log' in said


def test_a_value_is_reached_where_it_holds():
    frames = np.arange(1, 101) * 10_000.0
    length = np.where(frames < 500_000, 300.0, 50.0)
    length[9] = 40.0  # once, by luck
    columns = {'frames': frames, 'minutes': frames / 10_000,
               'tau': np.where(frames < 600_000, 0.5, 1.0), 'length': length}
    run = Run(Path('run'), 'run', columns)
    assert reached(run, 100, 'length', falls=True, in_curriculum=True) == (500_000.0, 50.0)
    # From tau 1 on 200 episodes of 50 frames each have to end before a mean is of them alone.
    assert reached(run, 100, 'length', falls=True) == (610_000.0, 61.0)
    assert reached(run, 45, 'length', falls=True) is None
    assert reached(run, 200, 'length') is None  # no row at tau 1 is so high
    # What is good at the end alone has not held yet.
    late = Run(Path('late'), 'late', columns | {'length': np.where(frames < 920_000, 300.0, 50.0)})
    assert reached(late, 100, 'length', falls=True) is None


def test_what_was_run_with_other_options_is_not_taken_for_a_run(tmp_path):
    path = small(tmp_path)
    own = reproduction(path, tmp_path)
    arm = next(iter(own.experiment.arms))
    kept = own.kept / own.run_name(arm, 0)
    kept.mkdir(parents=True)
    for said, rule in (({'options': own.options(arm) | {'size': 7}}, 'size: 7'),
                       ({}, 'says what options')):
        (kept / 'evaluation.json').write_text(json.dumps(said))
        with pytest.raises(UserError, match=rule):
            own.run([0], print)
    (kept / 'evaluation.json').unlink()
    begun = own.out / own.folder / own.run_name(arm, 0)
    begun.mkdir(parents=True)
    (begun / 'options.json').write_text(json.dumps(own.options(arm) | {'frames': 3}))
    with pytest.raises(UserError, match='frames: 3'):
        own.run([0], print)


def test_the_runs_that_ship_are_those_of_the_experiments():
    """What the page of the results shows was run with the options of the files of today."""
    for name in experiment_names():
        own = Reproduction(load_experiment(name), 'quick', Path('runs'), CURVES_OF_THE_DOCS)
        for path in own.kept.glob('*/evaluation.json'):
            found = json.loads(path.read_text())
            assert not re.search(r'["=]/', path.read_text()), f'{path}: a path of one machine'
            own._check(found['arm'], found['options'], path.parent)
            assert path.parent.name == own.run_name(found['arm'], found['seed'])


def test_a_short_try_has_folders_of_its_own(tmp_path):
    whole, tried = (reproduction(small(tmp_path), tmp_path, frames=frames)
                    for frames in (None, 700))
    assert tried.folder == 'small-quick-700' and tried.options('LSTM')['frames'] == 700
    assert whole.folder == 'small-quick' != tried.kept.name


def test_files_are_made_again_by_another_command(tmp_path, monkeypatch):
    made = []

    def run(jobs, cores, say):
        for job in jobs:
            made.append(job.commands[0])
            job.after()
    monkeypatch.setattr('vn_nav.experiments.jobs.run', run)
    for text in (SMALL, SMALL, SMALL.replace('--rooms 1', '--rooms 2'), SMALL):
        reproduction(small(tmp_path, text), tmp_path)._prepare([0], print)
    assert [command[5] for command in made] == ['1', '2', '1']


@pytest.mark.parametrize('size, houses', [('quick', 4), ('full', 16)])
def test_a_size_makes_what_it_needs(size, houses, tmp_path, monkeypatch):
    made = []
    monkeypatch.setattr('vn_nav.experiments.jobs.run',
                        lambda jobs, cores, say: made.extend(job.commands[0] for job in jobs))
    reproduction('fig5.7', tmp_path, size)._prepare([0], print)
    assert [words[0] for words in made] == ['house'] * houses + ['collect', 'pretrain']
    assert made[-2].count('--scene') == houses


def test_each_arm_is_shown_other_goals(tmp_path):
    own = reproduction(small(tmp_path), tmp_path, seeds=(0, 1))
    assert [[('--no-controls' in own.evaluate_command(arm, seed)) for seed in own.seeds]
            for arm in own.experiment.arms] == [[False, True]] * 2


def test_runs_that_stay_in_the_curriculum_are_measured_there(tmp_path):
    fig = Reproduction(load_experiment('fig5.7'), 'quick', tmp_path, tmp_path)
    words = fig.evaluate_command('UNREAL', 1)
    assert words[words.index('--difficulty') + 1] == '0.3'
    whole = Reproduction(load_experiment('fig5.7'), 'full', tmp_path, tmp_path)
    assert '--difficulty' not in whole.evaluate_command('UNREAL', 1)


def test_a_thinned_curve_keeps_its_last_row(tmp_path):
    rows = ['frames,minutes,tau,success', *(f'{k},{k},1,0.5' for k in range(1, 1002))]
    (tmp_path / 'metrics.csv').write_text('\n'.join(rows) + '\n')
    thin(tmp_path, tmp_path / 'kept')
    run, = read_runs([tmp_path / 'kept'])
    assert len(run.columns['frames']) <= 400 and run.columns['frames'][-1] == 1001


def test_lines_of_controls_find_a_colour_beside_as_many_curves_as_there_are():
    frames = np.arange(1.0, 101.0)
    columns = {'frames': frames, 'minutes': frames, 'tau': np.ones(100),
               'success': np.linspace(0, 1, 100)}
    groups = {str(k): [Run(Path(str(k)), str(k), columns)] for k in range(CURVES)}
    shapes, height = chart(groups, 'success', levels={'random': 0.1, 'shortest': 1.0})
    assert to_picture(shapes, WIDTH, height).std() > 0


def test_spread_is_not_of_some():
    assert spread([1.0, 2.0], '.1f') == '1.5 (1.0-2.0)' and spread([0.5], '.0%') == '50 %'
    assert spread([1.0, None], '.1f') == '-' and spread([], '.1f') == '-'


def test_no_page_of_nothing(tmp_path):
    own = reproduction(small(tmp_path), tmp_path)
    assert write_results(own.experiment, 'quick', own.kept) is None
    assert not own.kept.exists()

"""The training loop: collect, update, log, save, resume."""

from __future__ import annotations

import csv
import dataclasses
import math
import signal
import sys
import threading
import time
from collections import deque
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from vn_nav.errors import UserError
from vn_nav.learning.curriculum import Curriculum, FrameCurriculum
from vn_nav.learning.learner import BASIC_LOSSES, TASKS, Learner
from vn_nav.learning.pairs import PairConfig, PairSource, pretrain_pairs
from vn_nav.learning.presets import TrainConfig
from vn_nav.learning.replay import Replay
from vn_nav.learning.rollout import Collector, Episode
from vn_nav.learning.state_file import read_state, write_state
from vn_nav.policy.checkpoint import load_checkpoint, save_checkpoint, write_file
from vn_nav.policy.network import Policy

CHECKPOINT, STATE, REPLAY = 'checkpoint', 'training_state', 'replay'
FAILED_BATCH, PAIRS = 'failed_batch.pt', 'pairs'
METRICS, TENSORBOARD = 'metrics.csv', 'tensorboard'
COLUMNS = ('frames', 'minutes', 'fps', 'tau', 'success', 'return', 'length', 'collisions',
           *BASIC_LOSSES, 'collect_seconds', 'update_seconds', *TASKS)
RECENT = 200  # episodes that the shown success, return, length and collisions are means over


def train(env, config: TrainConfig, folder: str | Path, *, resume: bool = False, info: dict,
          init: str | Path | None = None,
          pairs: Callable[[], tuple[PairSource, PairSource]] | None = None,
          on_update: Callable[[dict], None] | None = None) -> Path:
    """Train a policy; SIGINT and SIGTERM save and end it early, cleanly.

    The folder gets `checkpoint/`, `training_state`, `metrics.csv` and, if asked for,
    `tensorboard/`. An interrupted and resumed training repeats the uninterrupted one bit for bit
    (one thread, no wall-clock limit) if the environment has `get_state() -> dict of arrays` and
    `set_state(dict)`; otherwise its episodes begin anew.

    Args:
        env: a vector environment as `vn_sim_bridge.env.NavigationEnv`: `num_envs`, `goals`,
            `action_names`, `world_version`, `set_difficulty`, NEXT_STEP autoreset.
        config: numbers of the training.
        folder: new or empty of an earlier training, unless `resume`.
        resume: go on from the folder's last save.
        info: what the checkpoint shall say, see `vn_nav.policy.checkpoint.INFO`; frames, minutes,
            seed and world version are filled in.
        init: a checkpoint to begin with.
        pairs: makes the picture pairs for `config.pair_minutes`, and those to judge by.
        on_update: called with each row of the metrics.

    Returns:
        The folder of the final checkpoint.

    Raises:
        UserError: a folder or resumption that does not fit, or a loss that is not finite.
    """
    folder = Path(folder)
    training = _Training(env, config, folder, info)
    # Interrupted before the first frame, a training goes on with its pairs.
    before_frames = (folder / PAIRS).exists() and not (folder / STATE).exists()
    if resume and not before_frames:
        training.load()
    else:
        if (folder / STATE).exists():
            raise UserError('a new training has a folder of its own', str(folder),
                            'resume the training there, or choose another folder')
        if init is not None:
            training.network.load_state_dict(_initial_weights(init, training.network))
        elif config.pair_minutes and pairs is not None:
            training.learn_pairs(*pairs())
        training.begin()
    with _Signals() as stopped, _Log(folder, config, training.frames) as log:
        saved = time.monotonic()
        while not stopped.is_set() and training.progress < 1.0:
            row = training.update()
            log.write(row)
            if on_update is not None:
                on_update(row)
            if time.monotonic() - saved >= config.checkpoint_seconds:
                training.save()
                saved = time.monotonic()
        training.save()
    return folder / CHECKPOINT


def _initial_weights(source: str | Path, network: Policy) -> dict[str, torch.Tensor]:
    """The weights of a checkpoint, and a network's own for heads that the checkpoint lacks."""
    own, given = network.state_dict(), load_checkpoint(source).network.state_dict()
    for name, tensor in own.items():
        if name not in given and name.startswith('heads.'):
            given[name] = tensor
        elif name not in given or given[name].shape != tensor.shape:
            raise UserError(
                f'a training begins with a checkpoint of the same network: {name} is '
                f'{tuple(tensor.shape)}', tuple(given[name].shape) if name in given else 'absent',
                'choose the same architecture, size, channels, features and hidden, or leave '
                'out --init')
    return {name: given[name] for name in own}


def has_fast_bfloat16() -> bool:
    """Whether this processor multiplies bfloat16 in hardware (Linux on x86; else False)."""
    try:
        flags = Path('/proc/cpuinfo').read_text()
    except OSError:
        return False
    return 'avx512_bf16' in flags or 'amx_bf16' in flags


class _Training:
    """Everything that changes while training, and its save file."""

    def __init__(self, env, config: TrainConfig, folder: Path, info: dict):
        torch.set_num_threads(config.threads)
        self.env, self.config, self.folder = env, config, folder
        self.info = {**info, 'seed': config.seed, 'world_version': env.world_version}
        size = env.single_observation_space['image'].shape[-1]
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(config.seed)
            self.network = Policy(config.network(tuple(env.action_names), size))
        bf16 = has_fast_bfloat16() if config.bf16 is None else config.bf16
        self.network.compute_dtype = torch.bfloat16 if bf16 else torch.float32
        self.generator = torch.Generator().manual_seed(config.seed)
        self.learner = Learner(self.network, config, self.generator, replay=self._replay(size))
        self.learner.failed_batch = folder / FAILED_BATCH
        self.collector = Collector(env, self.network, self.generator, config.privileged)
        if config.curriculum == 'frames':
            self.curriculum = FrameCurriculum(start=config.start_difficulty)
        else:
            self.curriculum = Curriculum(
                env.num_envs, start=config.start_difficulty, threshold=config.success_to_advance,
                step=config.difficulty_step, window=config.advance_window)
        self.recent: deque[Episode] = deque(maxlen=RECENT)
        self.frames, self.updates, self.seconds = 0, 0, 0.0
        self.clock = time.monotonic()

    def _replay(self, size: int) -> Replay | None:
        config, env = self.config, self.env
        if not config.from_replay:
            return None
        return Replay(
            -(-config.replay_steps // env.num_envs), env.num_envs, size,
            torch.from_numpy(np.ascontiguousarray(env.goals)),
            privileged=tuple(key for key in config.privileged
                             if key in ('depth', 'segmentation')),
            goal_segmentation=(torch.from_numpy(env.goal_segmentation)
                               if 'goal_segmentation' in config.privileged else None),
            directory=self.folder / REPLAY)

    def learn_pairs(self, source: PairSource, validation: PairSource) -> None:
        """Pre-train the encoder; its time counts."""
        def say(row: dict) -> None:
            print(f'pairs {row["pairs"]:,} · {row["minutes"]:.1f} min · in unseen houses: '
                  f'bearing {row["validation_bearing_deg"]:.0f} deg, heading '
                  f'{row["validation_heading_deg"]:.0f} deg, overlap '
                  f'{row["validation_overlap_accuracy"]:.0%}', flush=True)
        config = PairConfig(minutes=self.config.pair_minutes)
        pretrain_pairs(self.network, source, validation, self.folder / PAIRS, config, say)
        self.seconds = 60 * self.config.pair_minutes
        self.clock = time.monotonic()

    def begin(self) -> None:
        """Start from nothing."""
        self.env.set_difficulty(self.curriculum.tau)
        self.collector.begin(self.config.seed)

    @property
    def progress(self) -> float:
        """Share of the training that is over; at least 1 at its end."""
        share = self.frames / self.config.frames
        if self.config.minutes is not None:
            share = max(share, self.seconds / 60 / self.config.minutes)
        return share

    def update(self) -> dict:
        """Collect one rollout, learn from it, and say how it went (the keys of `COLUMNS`)."""
        start = time.monotonic()
        rollout, episodes = self.collector.collect(self.config.rollout_length)
        middle = time.monotonic()
        losses = self.learner.update(rollout, self.progress)
        end = time.monotonic()
        self.frames += rollout.frames
        self.updates += 1
        self.seconds += end - self.clock
        speed = rollout.frames / (end - self.clock)
        self.clock = end
        self.recent.extend(episodes)
        tau = self.curriculum.tau
        if self.curriculum.update(episodes, self.collector.number, self.progress):
            self.env.set_difficulty(self.curriculum.tau)
        decisions = max(sum(episode.decisions for episode in self.recent), 1)
        return dict(zip(COLUMNS, (
            self.frames, self.seconds / 60, speed, tau,
            _mean(episode.success for episode in self.recent),
            _mean(episode.reward for episode in self.recent),
            _mean(episode.decisions for episode in self.recent),
            sum(episode.collisions for episode in self.recent) / decisions,
            *(losses[name] for name in BASIC_LOSSES), middle - start, end - middle,
            *(losses.get(name, math.nan) for name in TASKS)), strict=True))

    def save(self) -> None:
        """Write the training state, then the checkpoint; each whole or not at all."""
        self.folder.mkdir(parents=True, exist_ok=True)
        write_state(self.folder / STATE, self._state_dict())
        save_checkpoint(self.folder / CHECKPOINT, self.network, {
            **self.info, 'frames': self.frames, 'minutes': round(self.seconds / 60, 2)})

    def load(self) -> None:
        """Go on from the last save.

        Raises:
            UserError: nothing to resume, a corrupt file, or another network, world or number of
                environments.
        """
        path = self.folder / STATE
        if not path.is_file():
            raise UserError('a training is resumed from its folder', str(path),
                            'start it without resume, or name the folder of one')
        state = read_state(path)
        for name, value in self._identity().items():
            if state['identity'].get(name) != value:
                raise UserError(f'a training is resumed with its own {name}: '
                                f'{state["identity"].get(name)}', value,
                                'resume it with the same options, or start a new one')
        self.network.load_state_dict(state['network'])
        self.learner.optimiser.load_state_dict(state['optimiser'])
        self.curriculum.load_state_dict(state['curriculum'])
        self.generator.set_state(state['generator'])
        self.recent.extend(Episode(*episode) for episode in state['recent'])
        self.frames, self.updates = state['frames'], state['updates']
        self.seconds = state['seconds']
        self.env.set_difficulty(self.curriculum.tau)
        self.collector.load_state_dict(state['collector'])
        if state['env'] is not None and hasattr(self.env, 'set_state'):
            self.env.set_state({name: rows.numpy() for name, rows in state['env'].items()})
        else:
            # Episodes never seen before: another seed for each resumption point.
            self.collector.begin(self.config.seed + 1_000_003 * self.updates)
        self.clock = time.monotonic()

    def _state_dict(self) -> dict:
        env = None
        if hasattr(self.env, 'get_state'):
            env = {name: torch.from_numpy(np.array(rows))
                   for name, rows in self.env.get_state().items()}
        return {
            'identity': self._identity(),
            'network': self.network.state_dict(),
            'optimiser': self.learner.optimiser.state_dict(),
            'curriculum': self.curriculum.state_dict(),
            'collector': self.collector.state_dict(),
            'generator': self.generator.get_state(),
            'recent': [tuple(episode) for episode in self.recent],
            'frames': self.frames, 'updates': self.updates, 'seconds': self.seconds,
            'env': env,
        }

    def _identity(self) -> dict:
        """What must not change between save and resumption."""
        network = dataclasses.asdict(self.network.config)
        return {
            'action names': list(network.pop('actions')),
            'network': {key: list(value) if isinstance(value, tuple) else value
                        for key, value in network.items()},
            'world version': self.env.world_version,
            'number of environments': self.env.num_envs,
        }


def _mean(values) -> float:
    values = list(values)
    return sum(values) / len(values) if values else math.nan


class _Signals:
    """An event that SIGINT and SIGTERM set while the context lasts (in the main thread)."""

    def __enter__(self) -> threading.Event:
        self.event, self.before = threading.Event(), {}
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGINT, signal.SIGTERM):
                self.before[number] = signal.signal(number, lambda *_: self.event.set())
        return self.event

    def __exit__(self, *_):
        for number, handler in self.before.items():
            signal.signal(number, handler)


class _Log:
    """Metrics to CSV, TensorBoard and the terminal."""

    def __init__(self, folder: Path, config: TrainConfig, frames: int):
        self.config = config
        self.writer = self.bar = None
        self.printed = -math.inf
        if config.tensorboard:
            try:
                from torch.utils.tensorboard import SummaryWriter
            except ImportError as error:
                raise UserError('logging to TensorBoard needs the package tensorboard', str(error),
                                'pip install "vn_nav[train]", or leave TensorBoard off') from error
            self.writer = SummaryWriter(folder / TENSORBOARD)
        folder.mkdir(parents=True, exist_ok=True)
        _cut_after(folder / METRICS, frames)
        self.file = open(folder / METRICS, 'a', newline='')
        self.rows = csv.DictWriter(self.file, COLUMNS)
        if self.file.tell() == 0:
            self.rows.writeheader()

    def __enter__(self) -> _Log:
        if sys.stdout.isatty():
            from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
            self.bar = Progress(BarColumn(24), TextColumn('{task.percentage:>3.0f}%'),
                                TimeElapsedColumn(), TextColumn('{task.description}'))
            self.task = self.bar.add_task('collecting the first frames', total=1.0)
            self.bar.start()
        return self

    def __exit__(self, *_):
        if self.bar is not None:
            self.bar.stop()
        if self.writer is not None:
            self.writer.close()
        self.file.close()

    def write(self, row: dict) -> None:
        """One update's figures."""
        self.rows.writerow({name: f'{value:.6g}' if isinstance(value, float) else value
                            for name, value in row.items()})
        self.file.flush()
        if self.writer is not None:
            for name in COLUMNS[1:]:
                if math.isfinite(row[name]):
                    self.writer.add_scalar(f'train/{name}', row[name], row['frames'])
        share = row['frames'] / self.config.frames
        if self.config.minutes is not None:
            share = max(share, row['minutes'] / self.config.minutes)
        line = (f'{row["frames"]:,} frames · {row["minutes"]:.1f} min · {row["fps"]:,.0f} fps · '
                f'tau {row["tau"]:.2f} · success {row["success"]:.2f} · '
                f'length {row["length"]:.0f} · collisions {row["collisions"]:.2f} · '
                f'entropy {row["entropy"]:.2f} · kl {row["kl"]:.4f} · '
                f'value {row["value_loss"]:.3f}')
        if self.bar is not None:
            self.bar.update(self.task, completed=share, description=line)
        elif time.monotonic() - self.printed >= 10 or share >= 1:
            print(f'{min(share, 1):4.0%} {line}', flush=True)
            self.printed = time.monotonic()


def _cut_after(path: Path, frames: int) -> None:
    """Drop the rows of a metrics file that lie beyond a resumption point."""
    if not path.exists():
        return
    if frames == 0:
        path.unlink()
        return
    lines = path.read_text().splitlines(keepends=True)
    kept = lines[:1] + [line for line in lines[1:] if int(line.split(',', 1)[0]) <= frames]
    write_file(path, ''.join(kept).encode())

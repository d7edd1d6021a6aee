"""The training loop: collect, update, log, save, resume."""

from __future__ import annotations

import csv
import dataclasses
import hashlib
import io
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
from vn_nav.learning.learner import Learner, LearnerConfig
from vn_nav.learning.rollout import Collector, Episode
from vn_nav.policy.checkpoint import save_checkpoint, write_file
from vn_nav.policy.network import NetworkConfig, Policy

CHECKPOINT, STATE = 'checkpoint', 'training_state'
METRICS, TENSORBOARD = 'metrics.csv', 'tensorboard'
COLUMNS = ('frames', 'minutes', 'fps', 'tau', 'success', 'return', 'length', 'collisions',
           'policy_loss', 'value_loss', 'entropy', 'kl', 'clipped', 'gradient_norm',
           'collect_seconds', 'update_seconds')
RECENT = 200  # episodes that the shown success, return, length and collisions are means over


@dataclasses.dataclass(frozen=True)
class TrainConfig(LearnerConfig):
    """All numbers of a training, beside those of the environment."""

    frames: int = 3_000_000  # agent decisions; the linear schedules end here
    minutes: float | None = None  # wall-clock limit; the schedules end with it if it comes first
    rollout_length: int = 64  # steps
    channels: tuple[int, int, int] = (32, 64, 32)
    features: int = 256
    hidden: int = 256
    curriculum: str = 'success'  # or 'frames': what raises the difficulty
    start_difficulty: float = 0.3  # tau of the curriculum; 1 switches it off
    success_to_advance: float = 0.75
    difficulty_step: float = 0.1
    advance_window: int = 200  # episodes
    seed: int = 0
    bf16: bool | None = None  # None: where the processor multiplies bfloat16 in hardware
    threads: int = 1  # of torch
    checkpoint_seconds: float = 60.0
    tensorboard: bool = False

    def __post_init__(self):
        super().__post_init__()
        rules = (
            (self.frames >= 1, 'a training has at least one frame', self.frames),
            (self.minutes is None or self.minutes > 0, 'a wall-clock limit is positive',
             self.minutes),
            (self.rollout_length >= 2, 'rollout_length is at least 2', self.rollout_length),
            (self.curriculum in ('success', 'frames'), 'the curriculum is success or frames',
             self.curriculum),
            (0 < self.start_difficulty <= 1, 'start_difficulty lies in (0, 1]',
             self.start_difficulty),
            (self.difficulty_step > 0, 'difficulty_step is positive', self.difficulty_step),
            (self.advance_window >= 1, 'advance_window is positive', self.advance_window),
            (self.threads >= 1, 'threads is at least 1', self.threads),
        )
        for kept, rule, received in rules:
            if not kept:
                raise UserError(rule, received, 'correct the training configuration')


def train(env, config: TrainConfig, folder: str | Path, *, resume: bool = False, info: dict,
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
        on_update: called with each row of the metrics.

    Returns:
        The folder of the final checkpoint.

    Raises:
        UserError: a folder or resumption that does not fit, or a loss that is not finite.
    """
    folder = Path(folder)
    training = _Training(env, config, folder, info)
    if resume:
        training.load()
    else:
        if (folder / STATE).exists():
            raise UserError('a new training has a folder of its own', str(folder),
                            'resume the training there, or choose another folder')
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
            self.network = Policy(NetworkConfig(
                actions=tuple(env.action_names), size=size, channels=config.channels,
                features=config.features, hidden=config.hidden))
        bf16 = has_fast_bfloat16() if config.bf16 is None else config.bf16
        self.network.compute_dtype = torch.bfloat16 if bf16 else torch.float32
        self.generator = torch.Generator().manual_seed(config.seed)
        self.learner = Learner(self.network, config, self.generator)
        self.collector = Collector(env, self.network, self.generator)
        if config.curriculum == 'frames':
            self.curriculum = FrameCurriculum(start=config.start_difficulty)
        else:
            self.curriculum = Curriculum(
                env.num_envs, start=config.start_difficulty, threshold=config.success_to_advance,
                step=config.difficulty_step, window=config.advance_window)
        self.recent: deque[Episode] = deque(maxlen=RECENT)
        self.frames, self.updates, self.seconds = 0, 0, 0.0
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
            *losses, middle - start, end - middle), strict=True))

    def save(self) -> None:
        """Write the training state, then the checkpoint; each whole or not at all."""
        self.folder.mkdir(parents=True, exist_ok=True)
        buffer = io.BytesIO()
        torch.save(self._state_dict(), buffer)
        data = buffer.getvalue()
        write_file(self.folder / STATE, hashlib.sha256(data).hexdigest().encode() + b'\n' + data)
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
        digest, _, data = path.read_bytes().partition(b'\n')
        if hashlib.sha256(data).hexdigest().encode() != digest:
            raise UserError('the training state has the SHA-256 of its first line', str(path),
                            'the file is corrupt: start a new training')
        state = torch.load(io.BytesIO(data), weights_only=True)
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

"""The training loop: collect, update, advance the curriculum, log, save; and resume."""

from __future__ import annotations

import collections
import csv
import dataclasses
import io
import signal
import time
from pathlib import Path

import torch
from rich.console import Console

from vn_nav.errors import UserError
from vn_nav.learning.learner import Learner, LearnerConfig
from vn_nav.learning.rollout import Collector
from vn_nav.policy.checkpoint import save_checkpoint, write_atomically
from vn_nav.policy.network import NetworkConfig, Policy

STATE = 'training_state.pt'


@dataclasses.dataclass(frozen=True)
class TrainConfig:
    """What a training run does beside the update itself."""

    frames: int = 1_500_000  # agent decisions over all environments
    rollout_length: int = 32
    seed: int = 0
    channels: tuple[int, int, int] = (16, 32, 64)
    learner: LearnerConfig = dataclasses.field(default_factory=LearnerConfig)
    # Success-driven curriculum on the start distance (thesis, section 4.5, by success instead of
    # frames): tau grows by `tau_step` when more than `advance_above` of the last `window` episodes
    # at this tau arrived. The window is emptied at each advance; its first episodes flatter (short
    # ones end first), so it is long: several episodes an environment.
    first_tau: float = 0.3
    tau_step: float = 0.1
    advance_above: float = 0.75
    window: int = 256
    minutes: float | None = None  # stop after this wall-clock time, whatever the frames
    checkpoint_seconds: float = 60.0
    threads: int = 1

    def __post_init__(self):
        rules = ((self.frames > 0, 'frames is positive', self.frames),
                 (self.rollout_length >= 2, 'a rollout has at least two steps',
                  self.rollout_length),
                 (0 < self.first_tau <= 1, 'first_tau lies in (0, 1]', self.first_tau))
        for kept, rule, received in rules:
            if not kept:
                raise UserError(rule, received, 'correct the training configuration')


class Trainer:
    """One run in one folder: metrics.csv, TensorBoard events, checkpoint/, training_state.pt.

    Args:
        env: a vector environment as `NavigationEnv`.
        config: what to do.
        folder: where everything is written.
        info: facts for the checkpoint; `world_version` and `command` among them.
        resume: go on from the folder's last state.

    Raises:
        UserError: a folder that holds another run, or nothing to resume.
    """

    def __init__(self, env, config: TrainConfig, folder: str | Path, info: dict, *,
                 resume: bool = False):
        torch.set_num_threads(config.threads)
        self.env, self.config, self.folder = env, config, Path(folder)
        self.info, self.console = dict(info), Console()
        torch.manual_seed(config.seed)
        self.generator = torch.Generator().manual_seed(config.seed)
        self.network = Policy(NetworkConfig(
            actions=env.action_names, size=env.goals.shape[-1], channels=config.channels))
        self.learner = Learner(self.network, config.learner, self.generator)
        self.frames = self.updates = 0
        self.seconds = 0.0  # of earlier sessions
        self.tau = config.first_tau
        self.window: collections.deque[bool] = collections.deque(maxlen=config.window)
        if resume:
            self._restore()
        elif (self.folder / STATE).exists():
            raise UserError('a new run starts in a folder without one', str(self.folder),
                            'add --resume to go on with it, or choose another --out')
        self.folder.mkdir(parents=True, exist_ok=True)
        self.collector = Collector(env, self.network, generator=self.generator)
        self._stop = False

    def run(self) -> Path:
        """Train until the frames, the minutes or a signal end it.

        Returns:
            The checkpoint's folder.
        """
        config = self.config
        previous = {number: signal.signal(number, self._on_signal)
                    for number in (signal.SIGINT, signal.SIGTERM)}
        writer = self._tensorboard()
        begun = saved = printed = time.monotonic()
        self.env.set_difficulty(self.tau)
        # After a resume, episodes nobody has seen yet: the counter's seed moves with the updates.
        self.collector.begin(config.seed + 1_000_003 * self.updates)
        earlier = self.seconds
        try:
            while self.frames < config.frames and not self._stop:
                row = self._iteration()
                self.seconds = earlier + time.monotonic() - begun
                row |= {'minutes': round(self.seconds / 60, 3),
                        'frames_per_second': round(self.frames / self.seconds, 1)}
                self._log(row, writer)
                now = time.monotonic()
                if now - printed > 10:
                    self._print(row)
                    printed = now
                if now - saved > config.checkpoint_seconds:
                    self.save()
                    saved = time.monotonic()
                if config.minutes is not None and self.seconds > 60 * config.minutes:
                    break
        finally:
            for number, handler in previous.items():
                signal.signal(number, handler)
            writer.close()
        self.save()
        self._print(row)
        return self.folder / 'checkpoint'

    def _on_signal(self, *_):
        self._stop = True  # the present update ends, then everything is saved

    def _iteration(self) -> dict:
        config = self.config
        rollout, ends = self.collector.collect(config.rollout_length)
        left = max(0.0, 1 - self.frames / config.frames)
        losses = self.learner.update(
            rollout, learning_rate=config.learner.learning_rate * (0.1 + 0.9 * left),
            entropy_weight=config.learner.entropy_weight * (0.3 + 0.7 * left))
        self.frames += rollout.frames
        self.updates += 1
        self.window.extend(ends.success)
        success = sum(self.window) / len(self.window) if self.window else float('nan')
        count = len(ends.success)
        row = {
            'frames': self.frames, 'updates': self.updates, 'tau': round(self.tau, 3),
            'episodes': count, 'success': round(success, 4),
            'decisions': round(sum(ends.decisions) / count, 1) if count else '',
            'collisions': round(self.collector.collisions / rollout.frames, 4),
            **{f'loss_{name}' if name in ('policy', 'value') else name: round(value, 5)
               for name, value in losses._asdict().items()},
        }
        if (len(self.window) == config.window and success > config.advance_above
                and self.tau < 1):
            self.tau = min(1.0, self.tau + config.tau_step)
            self.env.set_difficulty(self.tau)
            self.window.clear()
        return row

    # Logs.

    def _tensorboard(self):
        try:
            from torch.utils.tensorboard import SummaryWriter
        except ImportError as error:
            raise UserError('training logs to TensorBoard', str(error),
                            'pip install "vn_nav[train]"') from error
        return SummaryWriter(str(self.folder / 'tensorboard'), purge_step=self.frames)

    def _log(self, row: dict, writer) -> None:
        for name, value in row.items():
            if name not in ('frames', 'updates') and value != '' and value == value:
                writer.add_scalar(name, value, self.frames)
        path = self.folder / 'metrics.csv'
        new = not path.exists()
        with open(path, 'a', newline='') as file:
            table = csv.DictWriter(file, row)
            if new:
                table.writeheader()
            table.writerow(row)

    def _print(self, row: dict) -> None:
        self.console.print(
            f'{row["frames"]:>9,} frames  {row["minutes"]:6.1f} min  '
            f'{row["frames_per_second"]:6.0f}/s  tau {row["tau"]:.2f}  '
            f'success {row["success"]:.3f}  decisions {row["decisions"] or "-":>5}  '
            f'collisions {row["collisions"]:.3f}  entropy {row["entropy"]:.2f}', highlight=False)

    # State.

    def save(self) -> None:
        """Write the checkpoint and everything that resuming needs."""
        facts = {**self.info, 'seed': self.config.seed, 'frames': self.frames,
                 'minutes': round(self.seconds / 60, 1), 'decoding': 'sample'}
        save_checkpoint(self.folder / 'checkpoint', self.network, facts)
        state = {
            'network': self.network.state_dict(),
            'optimiser': self.learner.optimiser.state_dict(),
            'generator': self.generator.get_state(),
            'frames': self.frames, 'updates': self.updates, 'seconds': self.seconds,
            'tau': self.tau, 'window': list(self.window),
            'world_version': self.info.get('world_version'),
            'actions': list(self.network.config.actions),
        }
        buffer = io.BytesIO()
        torch.save(state, buffer)
        write_atomically(self.folder / STATE, buffer.getvalue())

    def _restore(self) -> None:
        path = self.folder / STATE
        if not path.is_file():
            raise UserError('a run to resume has a training state', str(path),
                            'start it without --resume')
        try:
            state = torch.load(path, weights_only=True)
        except Exception as error:
            raise UserError('the training state is readable', f'{path}: {error}',
                            'start again without --resume in another folder') from error
        for name, mine in (('world_version', self.info.get('world_version')),
                           ('actions', list(self.network.config.actions))):
            if state[name] != mine:
                raise UserError(f'a resumed run keeps its {name.replace("_", " ")} ({mine})',
                                state[name], 'train again in another folder')
        try:
            self.network.load_state_dict(state['network'])
        except RuntimeError as error:
            raise UserError('a resumed run keeps its network', str(error).splitlines()[0],
                            'give the options that it was started with') from error
        self.learner.optimiser.load_state_dict(state['optimiser'])
        self.generator.set_state(state['generator'])
        self.frames, self.updates = state['frames'], state['updates']
        self.seconds, self.tau = state['seconds'], state['tau']
        self.window.extend(state['window'])


def train(env, config: TrainConfig, folder: str | Path, info: dict, *,
          resume: bool = False) -> Path:
    """Run a `Trainer`; returns the checkpoint's folder."""
    return Trainer(env, config, folder, info, resume=resume).run()

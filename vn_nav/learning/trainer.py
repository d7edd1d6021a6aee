"""The training loop: collect, update, log, save, resume."""

from __future__ import annotations

import concurrent.futures
import contextlib
import copy
import dataclasses
import math
import signal
import threading
import time
from collections import deque
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from vn_nav.errors import EnvironmentLost, UserError
from vn_nav.learning.bag_mix import BagMix
from vn_nav.learning.curriculum import Curriculum, FrameCurriculum
from vn_nav.learning.distributed import Processes
from vn_nav.learning.learner import BASIC_LOSSES, TASKS, TEACHERS, Learner
from vn_nav.learning.log import Log
from vn_nav.learning.pairs import PairConfig, PairSource, pretrain_pairs
from vn_nav.learning.presets import TrainConfig
from vn_nav.learning.replay import Replay
from vn_nav.learning.rollout import Collector, Episode, Rollout
from vn_nav.learning.state_file import read_state, remove_partial, write_state, written
from vn_nav.policy.checkpoint import load_checkpoint, save_checkpoint
from vn_nav.policy.network import Policy
from vn_nav.policy.resnet import load_frozen_weights
from vn_nav.vector_env import NavigationVectorEnv

CHECKPOINT, STATE, REPLAY = 'checkpoint', 'training_state', 'replay'
FAILED_BATCH, PAIRS = 'failed_batch.pt', 'pairs'
ACTOR = 500_009  # between the seeds of a learner and of its actor
RANKS_APART, RESUMPTIONS_APART = 10_007, 1_000_003  # between the seeds of processes and lives
COLUMNS = ('frames', 'minutes', 'fps', 'tau', 'success', 'return', 'length', 'collisions',
           *BASIC_LOSSES, 'collect_seconds', 'update_seconds', *TASKS)
RECENT = 200  # episodes that the shown success, return, length and collisions are means over


def train(env: NavigationVectorEnv, config: TrainConfig, folder: str | Path, *,
          resume: bool = False, info: dict, init: str | Path | None = None,
          pairs: Callable[[], tuple[PairSource, PairSource]] | None = None,
          bags: BagMix | None = None, on_update: Callable[[dict], None] | None = None) -> Path:
    """Train a policy; SIGINT and SIGTERM save and end it early, cleanly.

    The folder gets `checkpoint/`, `training_state`, `metrics.csv` and, if asked for,
    `tensorboard/` and `replay/`. A killed training loses what came after the last save, at most
    `config.checkpoint_seconds`. Resumed, it repeats the uninterrupted one bit for bit (one
    thread, no wall-clock limit) if the environment is `restorable`, otherwise its episodes begin
    anew; of a replay memory it lacks the steps that the killed one had overwritten. It says what
    it found.

    Started by torchrun, several processes train one policy (`vn_nav.learning.distributed`):
    frames are those of all, the first one writes the files, and a process that died is replaced
    as torchrun was told, all going on from the last save. Then episodes begin anew and replay
    memories fill anew.

    Args:
        env: a vector environment as `vn_sim_bridge`'s `NavigationEnv`: `num_envs`, `goals`,
            `action_names`, `world_version`, `set_difficulty`, NEXT_STEP autoreset; or one whose
            rows are tensors on `config.device`, as its `WarpNavigationEnv`.
        config: numbers of the training.
        folder: new or empty of an earlier training, unless `resume`.
        resume: go on from the folder's last save.
        info: what the checkpoint shall say, see `vn_nav.policy.checkpoint.INFO`; frames, minutes,
            seed and world version are filled in.
        init: a checkpoint to begin with.
        pairs: makes the picture pairs for `config.pair_minutes`, and those to judge by.
        bags: recorded drives, which every step of the optimiser learns from as well.
        on_update: called with each row of the metrics.

    Returns:
        The folder of the final checkpoint.

    Raises:
        UserError: a folder or resumption that does not fit, a full disk, or a loss that is not
            finite; the last save stays as it is.
        EnvironmentLost: what was learned until then has been saved.
    """
    folder = Path(folder)
    with Processes.join(config.pair_minutes) as processes:
        training = Training(env, config, folder, info, processes, bags)
        training.start(resume, init, pairs)
        lost: EnvironmentLost | None = None
        with _Signals() as stopped, (Log(folder, config, training.columns, training.frames)
                                     if processes.leads else contextlib.nullcontext()) as log:
            if not training.updates:
                training.save(log)  # from here on there is something to resume
            saved = time.monotonic()
            while not processes.any(stopped.is_set()) and training.progress < 1.0:
                start = time.monotonic()
                try:
                    row = training.update()
                except EnvironmentLost as error:  # it ends a training as a signal does
                    lost = error
                    break
                if log is not None:
                    log.write(row)
                if on_update is not None:
                    on_update(row)
                now = time.monotonic()
                # The next update may end too late.
                if now + (now - start) - saved >= config.checkpoint_seconds:
                    training.save(log)
                    saved = time.monotonic()
            training.save(log)
            if lost is not None and not stopped.is_set():
                raise lost
    return folder / CHECKPOINT


def _initial_weights(source: str | Path, network: Policy) -> dict[str, torch.Tensor]:
    """The weights of a checkpoint, and a network's own for heads that the checkpoint lacks."""
    own = network.state_dict()
    given = load_checkpoint(source, network.config.actions).network.state_dict()
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


class Training:
    """Everything that changes while training, and its save file."""

    def __init__(self, env, config: TrainConfig, folder: Path, info: dict, processes: Processes,
                 bags: BagMix | None = None):
        torch.set_num_threads(config.threads)
        if bags is not None:
            config = dataclasses.replace(config, extra_heads=(*config.extra_heads, *bags.heads))
        self.bags, self.columns = bags, COLUMNS + (() if bags is None else bags.columns)
        self.env, self.config, self.folder, self.processes = env, config, folder, processes
        self.info = {**info, 'seed': config.seed, 'world_version': env.world_version}
        size = env.goals.shape[-1]
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(config.seed)
            self.network = Policy(config.network(tuple(env.action_names), size,
                                                 env.robot.moves if config.track_goal else ()))
        if config.frozen_weights:
            load_frozen_weights(self.network.encoder.frozen, config.frozen_weights)
        self.network.to(config.device)
        bf16 = config.bf16
        if bf16 is None:
            bf16 = has_fast_bfloat16() or self.network.device.type == 'cuda'
        self.network.compute_dtype = torch.bfloat16 if bf16 else torch.float32
        self.generator = torch.Generator(self.network.device)
        if bags is not None:
            bags.attach(self.network, processes.rank)
        self.learner = Learner(self.network, config, self.generator, replay=self._replay(size),
                               processes=processes, beside=bags and bags.loss)
        # All processes see that a gradient is not finite, whosever batch it came from.
        self.learner.failed_batch = folder / (
            f'{processes.rank}-{FAILED_BATCH}' if processes.count > 1 else FAILED_BATCH)
        # The actor, which collects while the learner learns, has weights and random numbers of its
        # own: both are as reproducible as one after the other.
        self.actor, self.drawn = self.network, self.generator
        if config.overlap:
            self.actor, self.drawn = copy.deepcopy(self.network), torch.Generator()
        self.ahead: tuple[Rollout, list[Episode]] | None = None  # collected, not yet learned from
        self.collector = Collector(env, self.actor, self.drawn, config.privileged)
        if config.curriculum == 'frames':
            self.curriculum = FrameCurriculum(start=config.start_difficulty)
        else:
            self.curriculum = Curriculum(
                env.num_envs * processes.count, start=config.start_difficulty,
                threshold=config.success_to_advance, step=config.difficulty_step,
                window=config.advance_window)
        self.recent: deque[Episode] = deque(maxlen=RECENT)
        self.frames, self.updates, self.seconds = 0, 0, 0.0
        self.clock = time.monotonic()

    def _replay(self, size: int) -> Replay | None:
        config, env = self.config, self.env
        if not config.from_replay:
            return None
        device, files = self.network.device, self.processes.count == 1

        def table(rows) -> torch.Tensor:
            return torch.as_tensor(rows, device=device)
        return Replay(
            # Many environments: at least a rollout and a window that is not all of it.
            max(-(-config.replay_steps // env.num_envs),
                config.rollout_length + config.replay_length + 1),
            env.num_envs, size, table(env.goals),
            privileged=tuple(key for key in config.privileged
                             if key in ('depth', 'segmentation')),
            goal_segmentation=(table(env.goal_segmentation)
                               if 'goal_segmentation' in config.privileged else None),
            # Files are the leading process's matter; resumed, all are to have the same share.
            directory=self.folder / REPLAY if files and device.type == 'cpu' else None,
            device=device)

    def start(self, resume: bool, init: str | Path | None,
              pairs: Callable[[], tuple[PairSource, PairSource]] | None) -> None:
        """Go on from the last save, or begin; the arguments are those of `train`."""
        state = self.processes.told(lambda: self._saved(resume))
        if state is not None:
            self._load(state)
            return
        if self.processes.leads:
            if init is not None:
                self.network.load_state_dict(_initial_weights(init, self.network))
            if self.config.pair_minutes and pairs is not None:
                self._learn_pairs(*pairs())
        self.processes.copy_weights(self.network)
        self._begin()

    def _saved(self, resume: bool) -> dict | None:
        """The state to go on from, if any."""
        path = self.folder / STATE
        if path.is_file() and not (resume or self.processes.restarted):
            raise UserError('a new training has a folder of its own', str(self.folder),
                            'resume the training there, or choose another folder')
        # Interrupted before the first frame, a training goes on with its pairs.
        if resume and not (path.is_file() or (self.folder / PAIRS).exists()
                           or self.processes.restarted):
            raise UserError('a training is resumed from its folder', str(path),
                            'start it without resume, or name the folder of one')
        for place in (self.folder, self.folder / PAIRS):
            remove_partial(place)
        return read_state(path) if path.is_file() else None

    def _learn_pairs(self, source: PairSource, validation: PairSource) -> None:
        """Pre-train the encoder; its time counts."""
        def say(row: dict) -> None:
            print(f'pairs {row["pairs"]:,} · {row["minutes"]:.1f} min · on others: '
                  f'bearing {row["validation_bearing_deg"]:.0f} deg, heading '
                  f'{row["validation_heading_deg"]:.0f} deg, overlap '
                  f'{row["validation_overlap_accuracy"]:.0%}', flush=True)
        config = PairConfig(minutes=self.config.pair_minutes,
                            learning_rate=self.config.pair_learning_rate)
        self.network.cpu()  # where pairs are drawn
        pretrain_pairs(self.network, source, validation, self.folder / PAIRS, config, say)
        self.network.to(self.config.device)
        self.seconds = 60 * self.config.pair_minutes
        self.clock = time.monotonic()

    def _begin(self, life: int = 0) -> None:
        """Start episodes and random numbers that no other process or life has seen."""
        seed = (self.config.seed + RANKS_APART * self.processes.rank + RESUMPTIONS_APART * life)
        self.generator.manual_seed(seed)
        if self.actor is not self.network:
            self.drawn.manual_seed(seed + ACTOR)
            self.actor.load_state_dict(self.network.state_dict())
        self.env.set_difficulty(self.curriculum.tau)
        self.collector.begin(seed)

    @property
    def progress(self) -> float:
        """Share of the training that is over; at least 1 at its end."""
        share = self.frames / self.config.frames
        if self.config.minutes is not None:
            share = max(share, self.seconds / 60 / self.config.minutes)
        return share

    def collect(self) -> tuple[Rollout, list[Episode]]:
        """One rollout of the actor, and the episodes that ended in it."""
        config = self.config
        share = config.teacher_share * max(1 - self.progress / config.teacher_until, 0.0)
        return self.collector.collect(
            config.rollout_length, TEACHERS[config.teacher][0] if config.teacher_share else None,
            share)

    def update(self) -> dict:
        """Collect one rollout, learn from it, and say how it went (the keys are `columns`).

        With `config.overlap` the next rollout is collected meanwhile, by the weights before this
        update.
        """
        start = time.monotonic()
        rollout, episodes = self.ahead or self.collect()
        self.ahead = None
        middle = time.monotonic()
        if self.bags is not None:
            self.bags.begin_update(self.progress)
        with contextlib.ExitStack() as stack:
            collecting = None
            if self.config.overlap:
                pool = stack.enter_context(concurrent.futures.ThreadPoolExecutor(1))
                collecting = pool.submit(self.collect)
            with written(self.folder / REPLAY):
                losses = self.learner.update(rollout, self.progress)
            if collecting is not None:
                self.ahead = collecting.result()
        if self.actor is not self.network:
            self.actor.load_state_dict(self.network.state_dict())
        end = time.monotonic()
        first = self.env.num_envs * self.processes.rank
        everyone = self.processes.gather((
            rollout.frames, self.seconds + end - self.clock, losses, self.collector.number,
            [tuple(episode._replace(env=first + episode.env)) for episode in episodes]))
        frames, seconds, losses, numbers, episodes = zip(*everyone, strict=True)
        speed = sum(frames) / (end - self.clock)
        self.frames += sum(frames)
        self.updates += 1
        self.seconds = seconds[0]  # the same for all: they have to end together
        self.clock = end
        episodes = [Episode(*episode) for part in episodes for episode in part]
        self.recent.extend(episodes)
        tau, present = self.curriculum.tau, np.concatenate(numbers)
        if self.curriculum.update(episodes, present, self.progress):
            self.env.set_difficulty(self.curriculum.tau)
        # The first episodes to end are the successful ones: they would flatter until every
        # environment has ended one.
        shown = self.recent if present.min() > 1 else ()  # the first is number 1
        decisions = sum(episode.decisions for episode in shown) or math.nan
        losses = {name: _mean(part[name] for part in losses) for name in losses[0]}
        return dict(zip(COLUMNS, (
            self.frames, self.seconds / 60, speed, tau,
            _mean(episode.success for episode in shown),
            _mean(episode.reward for episode in shown),
            _mean(episode.decisions for episode in shown),
            sum(episode.collisions for episode in shown) / decisions,
            *(losses[name] for name in BASIC_LOSSES), middle - start, end - middle,
            *(losses.get(name, math.nan) for name in TASKS)), strict=True)) | (
                {} if self.bags is None else self.bags.figures())

    def save(self, log: Log | None) -> None:
        """Write the training state, then the checkpoint; each whole or not at all."""
        if log is None:  # the leading process writes
            return
        log.sync()
        with written(self.folder):
            self.folder.mkdir(parents=True, exist_ok=True)
            if self.learner.replay is not None:
                self.learner.replay.flush()
        write_state(self.folder / STATE, self._state_dict())
        save_checkpoint(self.folder / CHECKPOINT, self.network, {
            **self.info, 'frames': self.frames, 'minutes': round(self.seconds / 60, 2)})

    def _load(self, state: dict) -> None:
        """Go on from a save.

        Raises:
            UserError: of another network, world or number of environments.
        """
        saved = {'kind of device': 'cpu', **state['identity']}
        for name, value in self._identity().items():
            if saved.get(name) != value:
                raise UserError(f'a training is resumed with its own {name}: {saved.get(name)}',
                                value,
                                'resume it with the same options, or start a new one')
        self.network.load_state_dict(state['network'])
        self.learner.optimiser.load_state_dict(state['optimiser'])
        self.curriculum.load_state_dict(state['curriculum'])
        self.recent.extend(Episode(*episode) for episode in state['recent'])
        self.frames, self.updates = state['frames'], state['updates']
        self.seconds = state['seconds']
        if self.bags is not None:
            self.bags.load_state_dict(state['bags'])
        if state.get('shown goals') is not None:
            self.env.recall_goals(state['shown goals'].numpy())
        words = [f'resumed at {self.frames:,} frames']
        if state['env'] is not None and self.processes.count == 1:
            self.generator.set_state(state['generator'])
            if self.config.overlap and state.get('ahead'):
                self.actor.load_state_dict(state['network'])
                self.drawn.set_state(state['actor_generator'])
                rollout, episodes = state['ahead']
                self.ahead = (Rollout.from_state(rollout, self.collector.goals),
                              [Episode(*episode) for episode in episodes])
            self.env.set_difficulty(self.curriculum.tau)
            self.collector.load_state_dict(state['collector'])
            self.env.set_state({name: rows.numpy() for name, rows in state['env'].items()})
        else:
            # No environment's first episode is an old one, wherever the counting begins.
            count = self.env.num_envs * self.processes.count
            self.curriculum.load_state_dict({
                **state['curriculum'], 'first': [0] * count, 'finished': [False] * count})
            self._begin(self.updates)
            words.append('episodes begin anew')
        replay = self.learner.replay
        if replay is not None:
            replay.load_state_dict(state.get('replay') or {'total': 0})
            words.append(
                f'the replay memory is mapped: {replay.count * replay.num_envs:,} steps are there'
                if replay.resumed == 'mapped' else 'the replay memory is refilled from now on')
        if self.processes.leads:
            print('; '.join(words), flush=True)
        self.clock = time.monotonic()

    def _state_dict(self) -> dict:
        env = None  # of many processes each has its own, which nobody saves
        if self.env.restorable and self.processes.count == 1:
            env = {name: torch.from_numpy(np.array(rows))
                   for name, rows in self.env.get_state().items()}
        return {
            'identity': self._identity(),
            'network': self.network.state_dict(),
            'optimiser': self.learner.optimiser.state_dict(),
            'curriculum': self.curriculum.state_dict(),
            'collector': self.collector.state_dict(),
            'generator': self.generator.get_state(),
            'actor_generator': self.drawn.get_state(),
            # Of many processes nobody saves what was collected, as nobody saves the environments.
            'ahead': None if self.ahead is None or self.processes.count > 1 else (
                self.ahead[0].state_dict(), [tuple(episode) for episode in self.ahead[1]]),
            'recent': [tuple(episode) for episode in self.recent],
            'frames': self.frames, 'updates': self.updates, 'seconds': self.seconds,
            'env': env,
            'bags': None if self.bags is None else self.bags.state_dict(),
            # Of an environment that does not know its goals before it has seen them.
            'shown goals': (torch.from_numpy(self.env.shown_goals.copy())
                            if hasattr(self.env, 'shown_goals') else None),
            'replay': None if self.learner.replay is None else self.learner.replay.state_dict(),
        }

    def _identity(self) -> dict:
        """What must not change between save and resumption."""
        network = dataclasses.asdict(self.network.config)
        return {
            'bags': None if self.bags is None else self.bags.identity,
            'action names': list(network.pop('actions')),
            'network': {key: list(value) if isinstance(value, tuple) else value
                        for key, value in network.items()},
            'world version': self.env.world_version,
            'number of environments': self.env.num_envs,
            'kind of device': self.network.device.type,  # random numbers differ
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
                self.before[number] = signal.signal(number, self._hear)
        return self.event

    def _hear(self, number: int, frame) -> None:
        self.event.set()
        before = self.before[number]
        if callable(before) and before is not signal.default_int_handler:
            before(number, frame)  # an environment that drives a robot wants to know at once

    def __exit__(self, *_):
        for number, handler in self.before.items():
            signal.signal(number, handler)

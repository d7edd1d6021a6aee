"""What a training consists of, and one step of it: collect a rollout, and learn from it."""

from __future__ import annotations

import concurrent.futures
import contextlib
import copy
import dataclasses
import math
import time
from collections import deque
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from vn_nav.errors import UserError
from vn_nav.labels import CLASSES, label_dtype
from vn_nav.learning.bag_mix import BagMix
from vn_nav.learning.curriculum import Curriculum, FrameCurriculum
from vn_nav.learning.distributed import Processes
from vn_nav.learning.learner import BASIC_LOSSES, Learner
from vn_nav.learning.learner_config import TASKS, TEACHERS
from vn_nav.learning.log import Log
from vn_nav.learning.pairs import PairConfig, PairSource, pretrain_pairs
from vn_nav.learning.precision import fast_dtype
from vn_nav.learning.presets import GIVEN, TrainConfig, check_not_search
from vn_nav.learning.replay import Replay
from vn_nav.learning.rollout import Collector, Episode, Rollout
from vn_nav.learning.state_file import read_state, remove_partial, write_state, written
from vn_nav.learning.training_state import restore, state_of
from vn_nav.learning.transfer import SEGMENTATIONS, initial_weights
from vn_nav.policy.checkpoint import save_checkpoint
from vn_nav.policy.resnet import load_frozen_weights
from vn_nav.policy.zhu import GivenFeatures
from vn_nav.policy.zhu_policy import ScenePolicy, build_policy
from vn_nav.report.curves import RECENT_EPISODES
from vn_nav.vector_env import GoalLabelsEnv, LabelledEnv, NavigationVectorEnv

CHECKPOINT, STATE, REPLAY = 'checkpoint', 'training_state', 'replay'
FAILED_BATCH, PAIRS = 'failed_batch.pt', 'pairs'
ACTOR_SEED_STEP = 500_009  # between the seeds of a learner and of its actor
RANK_SEED_STEP = 10_007  # between the seeds of processes
RESUMPTION_SEED_STEP = 1_000_003  # between the seeds of a run and its resumptions
COLUMNS = ('frames', 'minutes', 'fps', 'tau', 'success', 'return', 'length', 'collisions',
           *BASIC_LOSSES, 'collect_seconds', 'update_seconds', *TASKS)


class Training:
    """Everything that changes while training; `training_state` saves it."""

    def __init__(self, env: NavigationVectorEnv, config: TrainConfig, folder: Path, info: dict,
                 processes: Processes, bags: BagMix | None = None):
        torch.set_num_threads(config.threads)
        if bags is not None:
            settle_labels(env, bags)
            config = dataclasses.replace(config, extra_heads=(*config.extra_heads, *bags.heads))
        self.bags, self.columns = bags, COLUMNS + (() if bags is None else bags.columns)
        check_not_search(config.architecture, f'the preset {config.preset}')
        self.env, self.config, self.folder, self.processes = env, config, folder, processes
        self.info = {**info, 'seed': config.seed, 'world_version': env.world_version}
        size = env.goals.shape[-1]
        self.label_names = self._label_names()
        self.classes = max(CLASSES, len(self.label_names),
                           0 if bags is None else bags.classes)
        if self.label_names:
            self.info['label_names'] = list(self.label_names)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(config.seed)
            self.network = build_policy(config.network(
                tuple(env.action_names), size, env.robot.moves if config.track_goal else (),
                self.classes))
        if config.frozen_weights and config.frozen_weights != GIVEN:
            assert isinstance(self.network, ScenePolicy)  # no other has a frozen encoder
            load_frozen_weights(self.network.encoder.frozen, config.frozen_weights)
        _check_given(env, config)
        self.network.to(config.device)
        self.network.compute_dtype = (
            fast_dtype(self.network.device) if config.bf16 is None
            else torch.bfloat16 if config.bf16 else torch.float32)
        self.generator = torch.Generator(self.network.device)
        if bags is not None:
            bags.attach(self.network, processes.rank)
        self.learner = Learner(self.network, config, self.generator, replay=self._replay(size),
                               processes=processes,
                               auxiliary_loss=None if bags is None else bags.loss)
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
        self.curriculum: Curriculum | FrameCurriculum
        if config.curriculum == 'frames':
            self.curriculum = FrameCurriculum(
                start=config.start_difficulty, begin=config.curriculum_begin,
                end=config.curriculum_end)
        else:
            self.curriculum = Curriculum(
                env.num_envs * processes.count, start=config.start_difficulty,
                threshold=config.success_to_advance, step=config.difficulty_step,
                window=config.advance_window)
        self.recent: deque[Episode] = deque(maxlen=RECENT_EPISODES)
        self.frames, self.updates, self.seconds = 0, 0, 0.0
        self.clock = time.monotonic()

    def _label_names(self) -> tuple[str, ...]:
        """Behind the classes that segmentation heads draw; empty: there are none, or unknown."""
        if not {*self.config.heads, *self.config.extra_heads} & set(SEGMENTATIONS):
            return ()
        return named_classes(self.env) or (() if self.bags is None else self.bags.label_names)

    def _replay(self, size: int) -> Replay | None:
        config, env = self.config, self.env
        if not config.from_replay:
            return None
        device, files = self.network.device, self.processes.count == 1

        def table(rows) -> torch.Tensor:
            return torch.as_tensor(rows, device=device)

        labels = None
        if 'goal_segmentation' in config.privileged:
            if not isinstance(env, GoalLabelsEnv):
                raise UserError('the environment knows what its goal pictures show',
                                type(env).__name__, 'set goal_segmentation=0 (--set NAME=VALUE)')
            labels = table(env.goal_segmentation)
        return Replay(
            # Many environments: at least a rollout and a window that is not all of it.
            max(-(-config.replay_steps // env.num_envs),
                config.rollout_length + config.replay_length + 1),
            env.num_envs, size, table(env.goals),
            privileged=tuple(key for key in config.privileged
                             if key in ('depth', 'segmentation')),
            goal_segmentation=labels, label_type=_label_type(len(named_classes(env))),
            # Files are the leading process's matter; resumed, all are to have the same share.
            directory=self.folder / REPLAY if files and device.type == 'cpu' else None,
            device=device)

    def start(self, resume: bool, init: str | Path | None,
              pairs: Callable[[], tuple[PairSource, PairSource]] | None) -> None:
        """Go on from the last save, or begin; the arguments are those of `train`."""
        state = self.processes.from_leader(lambda: self._saved(resume))
        if state is not None:
            restore(self, state)
            return
        if self.processes.leads:
            if init is not None:
                start = initial_weights(init, self.network, self.label_names)
                self.network.load_state_dict(start.weights)
                for line in start.words:
                    print(f'{init}: {line}', flush=True)
            if self.config.pair_minutes and pairs is not None:
                self._learn_pairs(*pairs())
        self.processes.copy_weights(self.network)
        self.begin()

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

    def begin(self, life: int = 0) -> None:
        """Start episodes and random numbers that no other process or life has seen."""
        seed = (self.config.seed + RANK_SEED_STEP * self.processes.rank
                + RESUMPTION_SEED_STEP * life)
        self.generator.manual_seed(seed)
        if self.actor is not self.network:
            self.drawn.manual_seed(seed + ACTOR_SEED_STEP)
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
                losses = self.learner.update(rollout, self.progress, self.updates)
            if collecting is not None:
                self.ahead = collecting.result()
        if self.actor is not self.network:
            self.actor.load_state_dict(self.network.state_dict())
        end = time.monotonic()
        first = self.env.num_envs * self.processes.rank
        everyone = self.processes.gather((
            rollout.frames, self.seconds + end - self.clock, losses, self.collector.number,
            [tuple(episode._replace(env=first + episode.env)) for episode in episodes]))
        frames, seconds, parts, numbers, ended = zip(*everyone, strict=True)
        speed = sum(frames) / (end - self.clock)
        self.frames += sum(frames)
        self.updates += 1
        self.seconds = seconds[0]  # the same for all: they have to end together
        self.clock = end
        episodes = [Episode(*episode) for part in ended for episode in part]
        self.recent.extend(episodes)
        tau, present = self.curriculum.tau, np.concatenate(numbers)
        if self.curriculum.update(episodes, present, self.progress):
            self.env.set_difficulty(self.curriculum.tau)
        # The first episodes to end are the successful ones: they would flatter until every
        # environment has ended one.
        shown = self.recent if present.min() > 1 else ()  # the first is number 1
        decisions = sum(episode.decisions for episode in shown) or math.nan
        losses = {name: _mean(part[name] for part in parts) for name in parts[0]}
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
        write_state(self.folder / STATE, state_of(self))
        save_checkpoint(self.folder / CHECKPOINT, self.network, {
            **self.info, 'frames': self.frames, 'minutes': round(self.seconds / 60, 2)})


def named_classes(env: NavigationVectorEnv) -> tuple[str, ...]:
    """Names of an environment's classes of labels; empty: it has none, or nobody says."""
    return tuple(env.label_names) if isinstance(env, LabelledEnv) else ()


def settle_labels(env: NavigationVectorEnv, bags: BagMix) -> None:
    """Have bags teach no segmentation where their classes are known to be others than here."""
    own = named_classes(env)
    if own and bags.label_names and own != bags.label_names:
        for name in bags.leave_out(SEGMENTATIONS):
            print(f'bags do not teach {name}: their classes of labels are others than those of '
                  f'{env.simulator_name}', flush=True)


def _label_type(classes: int) -> torch.dtype:
    return {1: torch.uint8, 2: torch.uint16}[label_dtype(classes).itemsize]


def _mean(values) -> float:
    values = list(values)
    return sum(values) / len(values) if values else math.nan


def _check_given(env: NavigationVectorEnv, config: TrainConfig) -> None:
    """Whether the scenes bring the features that a network takes.

    Raises:
        UserError: they do not.
    """
    if config.frozen_weights != GIVEN:
        return
    features = getattr(env, 'goal_features', None)
    if features is None or features.shape[-1] != GivenFeatures.features:
        raise UserError(f'--frozen-weights {GIVEN} needs scenes whose files hold '
                        f'{GivenFeatures.features} features of each picture',
                        f'{"no" if features is None else features.shape[-1]} features',
                        'use grid scenes with the data set resnet_feature, or give a file of '
                        'weights')

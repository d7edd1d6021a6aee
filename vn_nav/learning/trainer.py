"""The training loop: collect, update, log, save, until the training or somebody ends it."""

from __future__ import annotations

import contextlib
import signal
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from vn_nav.errors import EnvironmentLost
from vn_nav.learning.bag_mix import BagMix
from vn_nav.learning.distributed import Processes
from vn_nav.learning.log import Log
from vn_nav.learning.pairs import PairSource
from vn_nav.learning.presets import TrainConfig
from vn_nav.learning.state_file import own_folder
from vn_nav.learning.training import CHECKPOINT, Training
from vn_nav.vector_env import NavigationVectorEnv


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
    as torchrun was asked for, all going on from the last save. Then episodes begin anew and replay
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
        UserError: a folder or resumption that does not fit, or where another process trains, a
            full disk, or a loss that is not finite; the last save stays as it is.
        EnvironmentLost: what was learned until then has been saved.
    """
    folder = Path(folder)
    with Processes.join(config.pair_minutes) as processes, (
            own_folder(folder) if processes.leads else contextlib.nullcontext()):
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


class _Signals:
    """An event that SIGINT and SIGTERM set while the context lasts (in the main thread)."""

    def __enter__(self) -> threading.Event:
        self.event = threading.Event()
        self.before: dict[int, Callable[..., Any] | int | None] = {}
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

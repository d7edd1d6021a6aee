"""`teach`: a policy for the place where a bag was driven, learned in the bag's pictures.

It makes a place of the drive, divides its minutes, learns, measures and keeps.

The simulator's half, which makes a place out of pictures with poses, comes from the caller
(`vn_sim_bridge.teach_place`).
"""

from __future__ import annotations

import dataclasses
import functools
import math
import time
from pathlib import Path
from typing import Any

import torch

from vn_nav.bags.mapping.recorded_place import read_place
from vn_nav.errors import UserError
from vn_nav.evaluation import evaluator
from vn_nav.evaluation.measurement import new_result, odometry_for
from vn_nav.learning.pairs import PairSource
from vn_nav.learning.places import BATCH, MAX_START_PICTURES, fit_paths, fit_places
from vn_nav.learning.presets import ENVIRONMENT, TrainConfig
from vn_nav.learning.stages import Stages
from vn_nav.learning.taught_place import Place, Watched
from vn_nav.learning.teach_evaluation import (
    DECODING,
    DRIVE_SPLITS,
    EVALUATION_SEED,
    MIN_EPISODES,
    Evaluation,
    Plan,
    cost_of,
    plan,
    rows_of,
)
from vn_nav.learning.teach_job import DEFAULT_SIZE_PX, PRESET, TeachJob, numbers
from vn_nav.learning.teach_network import OWN_LOGIT_SHARE, blend, network_for_place
from vn_nav.learning.trainer import train
from vn_nav.learning.training import CHECKPOINT, STATE
from vn_nav.policy.checkpoint import CONFIG, LoadedCheckpoint, load_checkpoint, save_checkpoint
from vn_nav.policy.network import Policy
from vn_nav.policy.network_config import SEARCH
from vn_nav.robot import DRIVE_ACTIONS, RobotSpec
from vn_nav.scenes import parse_scene

MIN_PICTURES_PER_CELL = 4  # for each place cell that the policy distinguishes
# Of all minutes: no round of the search for loop closures begins after this share. Reading the bag
# takes the time that it needs.
SEARCH_TIME_SHARE = 0.25
EVALUATION_TIME_SHARE = 0.25  # of the minutes left after that, at most
WRITE_TIME_S = 3.0  # to write what was learned
# Of learning, for place cells and for paths: where there is nothing else to learn (a policy that
# finds pictures anywhere needs no more), and before reinforcement learning from nothing.
PLACE_TIME_SHARES_ALONE, PLACE_TIME_SHARES = (0.4, 0.6), (0.07, 0.1)
REGRET_TIME_SHARE = 1 / 3  # of the time for paths, at most, to count what actions lose
# Pictures that paths begin at when the time for paths is shorter than this.
MIN_START_PICTURES, FULL_SEARCH_S = 512, 30.0
START = 'start'  # folder of the policy that knows the place, but no path there
MAX_DECISIONS = ENVIRONMENT[PRESET]['max_decisions']
COLLISION_REWARD = -0.05  # of leaving what the pictures cover


def teach(job: TeachJob, place: Place) -> Path:
    """Learn the place where a bag was driven, and measure what was learned.

    In the main thread SIGINT and SIGTERM end it between two steps.

    Args:
        job: the drive, the folder of the run, and numbers.
        place: the simulator's half.

    Returns:
        The folder of the checkpoint.

    Raises:
        UserError: options, a bag or a checkpoint that do not fit; a drive too short, of one
            spot, or of several places.
        KeyboardInterrupt: a signal came; what was learned and measured until then is kept.
    """
    bag, out = Path(job.bag), Path(job.out)
    if not job.resume and (out / STATE).is_file():
        raise UserError('a new run has a folder of its own', str(out),
                        'go on there with --resume, or choose another folder')
    given = load_checkpoint(job.checkpoint) if job.checkpoint else None
    kind = teaching_for(job, given)
    if kind is Teaching:
        numbers(job, given, job.minutes, job.minutes)  # refuse before hours what would fail then
    robot = _robot(job, given)
    with Stages(job.minutes) as stages:
        run = None
        try:
            size = given.config.size if given else job.size or DEFAULT_SIZE_PX
            graph = read_place(bag, job.options, place.build_graph, robot, size,
                               Path(job.cache or out / 'decoded'), stages,
                               stages.at(SEARCH_TIME_SHARE))
            run = kind(job, place, graph, given, robot, stages)
            run.learn()
            run.evaluate()
        except KeyboardInterrupt:
            stages.pause()
            print(f'interrupted after {stages.seconds / 60:.1f} min; '
                  + ('nothing is learned yet' if run is None else run.keep()), flush=True)
            raise
    return run.folder


def teaching_for(job: TeachJob, given: LoadedCheckpoint | None) -> type[Teaching]:
    """How a policy is taught.

    Raises:
        UserError: numbers of a training for a policy that is taught without one.
    """
    if given is None or given.config.architecture != SEARCH:
        return Teaching
    if job.changes:
        raise UserError('a policy that searches is taught without a training',
                        ', '.join(job.changes), 'leave out --set')
    from vn_nav.learning.teach_search import SearchTeaching
    return SearchTeaching


def _robot(job: TeachJob, given: LoadedCheckpoint | None) -> RobotSpec:
    """The robot with the actions of the policy."""
    robot = job.robot
    if given is None:
        return robot.with_actions(DRIVE_ACTIONS)
    if given.config.architecture == SEARCH:
        # A wider camera's pictures are cropped to the lens that the policy knows.
        robot = dataclasses.replace(robot, camera_fov=min(robot.camera_fov, given.config.view))
    before = given.info['camera_fov_deg'], given.info['camera_height']
    now = math.degrees(robot.camera_fov), robot.camera_height
    if any(abs(a - b) > 0.01 * b for a, b in zip(now, before, strict=True)):
        print(f'the camera ({now[0]:.0f} deg, {now[1]:g} m high) is not that of the policy '
              f'({before[0]:.0f} deg, {before[1]:g} m): '
              + ('what it sees is less exact' if given.config.architecture == SEARCH else
                 'the policy adapts to it'), flush=True)
    return robot.with_actions(given.config.actions, given.config.moves)


class Teaching:
    """From a place to a policy and its figures.

    Args:
        job: the drive, the folder of the run, and numbers.
        place: the simulator's half.
        graph: what it made of the drive.
        given: the policy to begin with.
        robot: with the actions of the policy.
        stages: of the command, and its minutes.

    Attributes:
        evaluation_share: of the minutes left when the bag is read, at most; the rest is learning.
    """

    evaluation_share = EVALUATION_TIME_SHARE

    def __init__(self, job: TeachJob, place: Place, graph: Any,
                 given: LoadedCheckpoint | None, robot: RobotSpec, stages: Stages):
        self.job, self.place, self.graph, self.given = job, place, graph, given
        self.robot, self.stages = robot, stages
        self.bag, self.out = Path(job.bag), Path(job.out)
        self.folder = self.out / CHECKPOINT
        self.own, self.others = place.held_out(graph)
        for line in (*graph.words, 'no goals are held out: there are too few'
                     if self.others is None else
                     f'{len(self.own.goals)} goals to learn, {len(self.others.goals)} held out'):
            print(line, flush=True)
        self.out.mkdir(parents=True, exist_ok=True)
        place.draw_map(self.out / 'map.png', self.own, self.others)
        self.begun = time.time()  # a checkpoint that is older is of another run
        self.evaluation: Evaluation | None = None
        self.advised = False  # whether any way was learned
        self._divide()

    def _divide(self) -> None:
        """Divide what is left of the minutes, and say how."""
        read, left = self.stages.seconds, self.stages.left - WRITE_TIME_S
        network = self._candidate(left)
        network.compute_dtype = torch.float32  # as of a checkpoint that is loaded
        self.stages('what an evaluation costs', 0.0)
        most = min(self.job.episodes, evaluator.ENVIRONMENTS)
        few = min(MIN_EPISODES, most)
        odometry = self._odometry(network)
        self.costs = [cost_of(functools.partial(self._env, self.own, stop=evaluator.ARRIVAL,
                                                odometry=odometry),
                              network, envs)
                      for envs in (few, max(most, few + 1))]
        splits = [name for name, graph in self._graphs().items() if graph is not None]
        self.rows = rows_of(splits, network, self.given.network if self.given else None)
        self.evaluated = min(self.evaluation_share * max(left, 0.0), self._plan(math.inf).seconds)
        self.learned = max(left - self.evaluated, 0.0)
        chosen = self._plan(self.evaluated)
        if left <= 0:
            print(f'{self.job.minutes:g} minutes are too few: reading the bag took '
                  f'{read / 60:.1f}; learning and evaluation are as short as possible', flush=True)
        elif chosen.missing:
            print(f'{self.job.minutes:g} minutes are few: all {len(self.rows)} rows of the '
                  f'evaluation, of {min(MIN_EPISODES, self.job.episodes)} episodes each, may take '
                  f'{self._least() / 60:.1f}; the first {len(chosen.rows)} are measured',
                  flush=True)
        print(f'{self.job.minutes:g} minutes: reading the bag {read / 60:.1f}, learning '
              f'{self.learned / 60:.1f}, evaluation {self.evaluated / 60:.1f} at most '
              f'(rows: {len(chosen.rows)}, of {chosen.episodes} episodes each)', flush=True)

    def learn(self) -> None:
        """The place, its ways, and from nothing the rest by reinforcement."""
        job = self.job
        config = self._config(self.learned, self.learned)
        if job.places and self.given is not None:
            self._learn_places(config, PLACE_TIME_SHARES_ALONE, self.folder)
            return
        world = ENVIRONMENT[PRESET] | {'collision_reward': COLLISION_REWARD}
        env = self._env(self.own, job.envs, seed=job.seed, privileged=config.privileged,
                        **{name: value for name, value in world.items() if name != 'envs'})
        init = job.checkpoint
        if job.places and not (job.resume and (self.out / STATE).is_file()):
            init = self.out / START
            self._learn_places(config, PLACE_TIME_SHARES, init)
        left = self.stages.left - WRITE_TIME_S - self.evaluated
        config = self._config(left, self.learned)
        self.stages('reinforcement', 0.0)
        self.stages.pause()  # a training has a bar of its own
        train(env, config, self.out, info=self._info(), resume=job.resume, init=init,
              pairs=self._pairs)
        self.stages('reinforcement', 1.0)

    def evaluate(self) -> None:
        """Measure the policy in the place, print, and write figures, page and checkpoint."""
        taught = load_checkpoint(self.folder)
        known = self.given.info['stop_threshold'] if self.given else None
        threshold = known or evaluator.STOP_THRESHOLD
        # The checkpoint is written again with what is measured: its checksum is not final.
        info = {key: value for key, value in taught.info.items() if key != 'sha256'}
        odometry = self._odometry(taught.network)
        result = new_result(info, checkpoint=str(self.folder), bag=self.bag.name,
                            max_decisions=MAX_DECISIONS, decoding=DECODING, seed=EVALUATION_SEED,
                            odometry=odometry, ranges='picture')
        graphs = {name: graph for name, graph in self._graphs().items() if graph is not None}
        self.evaluation = Evaluation(
            self.out, result, graphs,
            lambda graph, envs, stop: self._env(graph, envs, stop=stop, odometry=odometry),
            self.robot, threshold)
        try:
            self.evaluation.run(self._plan(self.stages.left - WRITE_TIME_S), taught.network,
                                self.given.network if self.given else None, self.stages)
        finally:
            self.stages.pause()
            info = {key: value for key, value in taught.info.items() if key != 'sha256'}
            info['results'] = self.evaluation.finish() or info['results']
            if taught.config.declares:
                info['stop_threshold'] = threshold
            save_checkpoint(self.folder, taught.network, info)

    def keep(self) -> str:
        """Make sure of a checkpoint after an interruption; returns a summary of it."""
        if self.evaluation is not None:
            count = sum(len(rows) for split in self.evaluation.result['splits'].values()
                        for rows in split['rows'].values())
            return f'kept: {self.folder}, with {count} of {len(self.rows)} rows'
        start = self.out / START
        if not self._fresh(self.folder) and self._fresh(start):
            policy = load_checkpoint(start)
            save_checkpoint(self.folder, policy.network, {
                key: value for key, value in policy.info.items() if key != 'sha256'})
        if not self._fresh(self.folder):
            return 'nothing is learned yet'
        return f'kept: {self.folder}, not measured (vn_nav evaluate {self.folder} --bag ...)'

    def _fresh(self, folder: Path) -> bool:
        """Whether a checkpoint is of this run, or of the one that it resumes."""
        card = folder / CONFIG
        return card.is_file() and (self.job.resume or card.stat().st_mtime >= self.begun - 1)

    def _graphs(self) -> dict[str, Any]:
        return dict(zip(DRIVE_SPLITS, (self.own, self.others), strict=True))

    def _plan(self, seconds: float) -> Plan:
        return plan(self.rows, self.costs, self.job.episodes, seconds, MAX_DECISIONS)

    def _least(self) -> float:
        return plan(self.rows, self.costs, min(MIN_EPISODES, self.job.episodes), math.inf,
                    MAX_DECISIONS).seconds

    def _config(self, seconds: float, learned: float) -> TrainConfig:
        config = numbers(self.job, self.given, seconds / 60, learned / 60)
        return dataclasses.replace(
            config, places=min(config.places, len(self.graph.poses) // MIN_PICTURES_PER_CELL))

    def _env(self, graph: Any, envs: int, **options) -> Any:
        options = {'max_decisions': MAX_DECISIONS} | options
        return self.place.make_env(graph, self.robot, envs, light=True, **options)

    def _odometry(self, network: Policy) -> str:
        """That the taught policy is measured with, and the one before it in the same places."""
        found = [odometry_for(one) for one in (network, *(
            [self.given.network] if self.given else []))]
        return next((name for name in found if name != 'none'), 'none')

    def _pairs(self) -> tuple[PairSource, PairSource]:
        source, judge = self.place.make_pairs(self.own, self.others, self.robot, self.job.seed)
        return Watched(source, lambda: self.stages('picture pairs', 0.0)), judge

    def _candidate(self, seconds: float) -> Policy:
        """A policy that costs as much as that to be measured, for so many seconds of learning."""
        return self._network(self._config(seconds, seconds))

    def _network(self, config: TrainConfig) -> Policy:
        return network_for_place(config, self.robot, self.graph.pictures.shape[-1],
                                 self.job.seed, None if self.given is None else self.given.network)

    def _learn_places(self, config: TrainConfig, shares: tuple[float, float], folder: Path
                      ) -> None:
        """Learn place recognition and paths, each for a share of the learning.

        Writes the checkpoint into the folder, after an interruption too.
        """
        network, begun = self._network(config), time.monotonic()
        facts: dict[str, float] = {}
        end, signal = begun + sum(shares) * self.learned, None
        try:
            self._learn_places_and_paths(network, shares[0] * self.learned, end, facts)
        except KeyboardInterrupt as error:
            signal = error
        info = self._info()
        if not self.advised:
            info['notes'] += (' Interrupted before any path was learned: it drives as it did '
                              'before.')
        elif self.given is not None:
            blend(network, own=1.0 if self.given.config.places else OWN_LOGIT_SHARE)
        save_checkpoint(folder, network, {
            **info, 'frames': 0, 'seed': self.job.seed,
            'minutes': round((time.monotonic() - begun) / 60, 2),
            'results': {'places': facts} if facts else {}})
        if signal is not None:
            raise signal

    def _learn_places_and_paths(self, network: Policy, seconds: float, end: float, facts: dict
                                ) -> None:
        """Fit the place classifier, then path advice; `facts` are filled on the way."""
        own, stages, say = self.own, self.stages, functools.partial(print, flush=True)
        views, others = self.place.make_views(own, self.robot, self.job.seed)
        facts |= fit_places(network, views, others, own.poses[:, :2],
                            minutes=max(seconds, 1e-3) / 60, say=say, least=BATCH,
                            show=functools.partial(stages, 'learning the place'))
        left = end - time.monotonic()
        pictures, poses = views.draw(
            MAX_START_PICTURES if left > FULL_SEARCH_S else MIN_START_PICTURES)
        regrets = self.place.regrets(
            own, poses, time.monotonic() + REGRET_TIME_SHARE * left,
            functools.partial(stages, 'counting the decisions that actions lose'))
        if len(regrets) < len(own.goals):
            print(f'paths to {len(regrets)} of the {len(own.goals)} goals: there is no time for '
                  'more', flush=True)
        goals = own.pictures[list(own.goal_nodes[:len(regrets)])]

        def show(share: float) -> None:
            stages('learning paths', share)
            self.advised = True
        facts |= fit_paths(network, pictures, goals, regrets, until=end, say=say,
                           seed=self.job.seed, show=show)

    def _info(self) -> dict:
        part = f', pictures {self.job.options.pictures}' if self.job.options.pictures else ''
        return {
            'camera_fov_deg': math.degrees(self.robot.camera_fov),
            'camera_height': self.robot.camera_height,
            'simulator': parse_scene(self.graph.name).simulator,
            'world_version': self.graph.world_version, 'preset': PRESET, 'stop_threshold': None,
            'command': self.job.command,
            'data': f'{len(self.graph.poses):,} recorded pictures of {self.bag.name}{part}',
            'notes': f'Taught in the pictures of {self.bag.name}{part}: '
                     f'{"; ".join(self.graph.words)}.'}

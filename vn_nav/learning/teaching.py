"""What `vn_nav teach` does with a place: divides its minutes, learns, measures, keeps.

The simulator's half, which makes a place out of pictures with poses, comes from the caller
(`vn_sim_bridge.teach_place`).
"""

from __future__ import annotations

import argparse
import dataclasses
import functools
import math
import shlex
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch

from vn_nav.evaluation import evaluator
from vn_nav.evaluation.command import DRIVE_SPLITS
from vn_nav.learning.pairs import PairSource
from vn_nav.learning.places import BANK, BATCH, Views, fit_places, fit_routes
from vn_nav.learning.presets import ENVIRONMENT, TrainConfig
from vn_nav.learning.stages import Stages
from vn_nav.learning.teach_evaluation import LEAST, Evaluation, Plan, cost_of, plan, rows_of
from vn_nav.learning.trainer import CHECKPOINT, STATE, has_fast_bfloat16, train
from vn_nav.policy.checkpoint import CONFIG, LoadedCheckpoint, load_checkpoint, save_checkpoint
from vn_nav.policy.network import Policy
from vn_nav.robot import RobotSpec
from vn_nav.scenes import parse_scene

PRESET = 'fast'
FOR_A_SPOT = 4  # pictures for each spot that the policy tells apart, at least
# How the minutes are divided. Reading the bag takes what it takes, but no round of the search for
# places seen again begins after this share of all. Of what is left then the evaluation gets this
# share at most, and learning the rest:
SEARCHED, EVALUATED = 0.25, 0.25
RESERVED = 3.0  # s to write what was learned
# of learning, shares for the spots and the ways between them: where that is all (a policy that
# finds pictures anywhere needs no more), and before reinforcement from nothing.
ALONE, FIRST = (0.4, 0.6), (0.07, 0.1)
COUNTED = 1 / 3  # of the time for ways, at most, to count what actions lose
LEAST_BANK, FOR_THE_BANK = 512, 30.0  # pictures that ways begin at; s below which there are fewer
# Of the logits: what that policy thinks, and what it is advised.
OWN, ADVISED = 0.75, 0.9
START = 'start'  # folder of the policy that knows the place, but no way there
DECISIONS = ENVIRONMENT[PRESET]['max_decisions']
COLLISION_REWARD = -0.05  # of leaving what the pictures cover


class Place(Protocol):
    """What the simulator's half makes of a drive; `vn_sim_bridge.teach_place` is one."""

    def build_graph(self, pictures, poses, episode, robot: RobotSpec, **options) -> Any:
        """A place out of pictures with poses."""

    def held_out(self, graph) -> tuple[Any, Any]:
        """The place with the goals to learn, and with those to judge by, or None."""

    def make_env(self, graph, robot: RobotSpec, envs: int, **options) -> Any:
        """A vector environment there."""

    def make_pairs(self, own, others, robot: RobotSpec, seed: int
                   ) -> tuple[PairSource, PairSource]:
        """Picture pairs to learn from, and to judge by."""

    def make_views(self, graph, robot: RobotSpec, seed: int) -> tuple[Views, Views]:
        """Pictures with poses to know the place by, and others to judge by."""

    def regrets(self, graph, poses: np.ndarray, until: float, show: Callable[[float], None]
                ) -> np.ndarray:
        """[G,N,A] float16 decisions that actions at poses [N,3] lose on the ways to the goals.

        To the first G goals, as many as there is time for until `time.monotonic()` is `until`.
        """

    def draw_map(self, path: Path, own, others) -> None:
        """A picture of the place."""


class Teaching:
    """From a place to a policy and its figures.

    Args:
        args: of `vn_nav teach`.
        place: the simulator's half.
        graph: what it made of the drive.
        given: the policy to begin with.
        robot: with the actions of the policy.
        stages: of the command, and its minutes.
        configure: (minutes of reinforcement, minutes of all learning) -> numbers of the training.
    """

    def __init__(self, args: argparse.Namespace, place: Place, graph: Any,
                 given: LoadedCheckpoint | None, robot: RobotSpec, stages: Stages,
                 configure: Callable[[float, float], TrainConfig]):
        self.args, self.place, self.graph, self.given = args, place, graph, given
        self.robot, self.stages = robot, stages
        self.folder = args.out / CHECKPOINT
        self.configure = configure
        self.own, self.others = place.held_out(graph)
        for line in (*graph.words, 'no goals are held out: there are too few'
                     if self.others is None else
                     f'{len(self.own.goals)} goals to learn, {len(self.others.goals)} held out'):
            print(line, flush=True)
        args.out.mkdir(parents=True, exist_ok=True)
        place.draw_map(args.out / 'map.png', self.own, self.others)
        self.begun = time.time()  # a checkpoint that is older is of another run
        self.evaluation: Evaluation | None = None
        self.advised = False  # whether any way was learned
        self._divide()

    def _divide(self) -> None:
        """Divide what is left of the minutes, and say how."""
        read, left = self.stages.seconds, self.stages.left - RESERVED
        config = self._config(left, left)
        network = self._network(config)
        network.compute_dtype = torch.float32  # as of a checkpoint that is loaded
        self.stages('what an evaluation costs', 0.0)
        most = min(self.args.episodes, evaluator.ENVIRONMENTS)
        few = min(LEAST, most)
        self.costs = [cost_of(functools.partial(self._env, self.own, stop=evaluator.ARRIVAL),
                              network, envs)
                      for envs in (few, max(most, few + 1))]
        splits = [name for name, graph in self._graphs().items() if graph is not None]
        self.rows = rows_of(splits, network, self.given.network if self.given else None)
        self.evaluated = min(EVALUATED * max(left, 0.0), self._plan(math.inf).seconds)
        self.learned = max(left - self.evaluated, 0.0)
        chosen = self._plan(self.evaluated)
        if left <= 0:
            print(f'{self.args.minutes:g} minutes are too few: reading the bag alone took '
                  f'{read / 60:.1f}; the least is learned and measured', flush=True)
        elif chosen.missing:
            print(f'{self.args.minutes:g} minutes are few: all {len(self.rows)} rows of the '
                  f'evaluation, of {min(LEAST, self.args.episodes)} episodes each, may take '
                  f'{self._least() / 60:.1f}; the first {len(chosen.rows)} are measured',
                  flush=True)
        print(f'{self.args.minutes:g} minutes: reading the bag {read / 60:.1f}, learning '
              f'{self.learned / 60:.1f}, evaluation {self.evaluated / 60:.1f} at most '
              f'(rows: {len(chosen.rows)}, of {chosen.episodes} episodes each)', flush=True)

    def learn(self) -> None:
        """The place, its ways, and from nothing the rest by reinforcement."""
        args = self.args
        config = self._config(self.learned, self.learned)
        if args.places and self.given is not None:
            self._learn_places(config, ALONE, self.folder)
            return
        world = ENVIRONMENT[PRESET] | {'collision_reward': COLLISION_REWARD}
        env = self._env(self.own, args.envs, seed=args.seed, privileged=config.privileged,
                        **{name: value for name, value in world.items() if name != 'envs'})
        init = args.checkpoint
        if args.places and not (args.resume and (args.out / STATE).is_file()):
            init = args.out / START
            self._learn_places(config, FIRST, init)
        left = self.stages.left - RESERVED - self.evaluated
        config = self._config(left, self.learned)
        self.stages('reinforcement', 0.0)
        self.stages.pause()  # a training has a bar of its own
        train(env, config, args.out, info=self._info(), resume=args.resume, init=init,
              pairs=self._pairs)
        self.stages('reinforcement', 1.0)

    def evaluate(self) -> None:
        """Measure the policy in the place, print, and write figures, page and checkpoint."""
        taught = load_checkpoint(self.folder)
        known = self.given.info['stop_threshold'] if self.given else None
        threshold = known or evaluator.STOP_THRESHOLD
        facts = {'checkpoint': str(self.folder), 'bag': self.args.bag.name,
                 'simulator': taught.info['simulator'],
                 'world_version': taught.info['world_version'], 'task': 'image',
                 'max_decisions': DECISIONS}
        graphs = {name: graph for name, graph in self._graphs().items() if graph is not None}
        self.evaluation = Evaluation(
            self.args.out, facts, graphs,
            lambda graph, envs, stop: self._env(graph, envs, stop=stop), self.robot, threshold)
        try:
            self.evaluation.run(self._plan(self.stages.left - RESERVED), taught.network,
                                self.given.network if self.given else None, self.stages)
        finally:
            self.stages.pause()
            info = {key: value for key, value in taught.info.items() if key != 'sha256'}
            info['results'] = self.evaluation.finish() or info['results']
            if 'arrival' in taught.config.heads:
                info['stop_threshold'] = threshold
            save_checkpoint(self.folder, taught.network, info)

    def keep(self) -> str:
        """Make sure of a checkpoint after an interruption; what there is, in words."""
        if self.evaluation is not None:
            count = sum(len(rows) for split in self.evaluation.result['splits'].values()
                        for rows in split['rows'].values())
            return f'kept: {self.folder}, with {count} of {len(self.rows)} rows'
        start = self.args.out / START
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
        return card.is_file() and (self.args.resume or card.stat().st_mtime >= self.begun - 1)

    def _graphs(self) -> dict[str, Any]:
        return dict(zip(DRIVE_SPLITS, (self.own, self.others), strict=True))

    def _plan(self, seconds: float) -> Plan:
        return plan(self.rows, self.costs, self.args.episodes, seconds, DECISIONS)

    def _least(self) -> float:
        return plan(self.rows, self.costs, min(LEAST, self.args.episodes), math.inf,
                    DECISIONS).seconds

    def _config(self, seconds: float, learned: float) -> TrainConfig:
        config = self.configure(seconds / 60, learned / 60)
        return dataclasses.replace(
            config, places=min(config.places, len(self.graph.poses) // FOR_A_SPOT))

    def _env(self, graph: Any, envs: int, **options) -> Any:
        options = {'max_decisions': DECISIONS} | options
        return self.place.make_env(graph, self.robot, envs, light=True, **options)

    def _pairs(self) -> tuple[PairSource, PairSource]:
        source, judge = self.place.make_pairs(self.own, self.others, self.robot, self.args.seed)
        return _Watched(source, lambda: self.stages('picture pairs', 0.0)), judge

    def _network(self, config: TrainConfig) -> Policy:
        """The policy with parts for the place; with the weights of the one that is given."""
        torch.set_num_threads(config.threads)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(self.args.seed)
            network = Policy(config.network(self.robot.action_names,
                                            self.graph.pictures.shape[-1],
                                            self.robot.moves if config.track_goal else ()))
        if self.given is not None:
            network.load_state_dict(_widened(self.given.network.state_dict(), network))
        network.compute_dtype = _fast_type()
        return network

    def _learn_places(self, config: TrainConfig, shares: tuple[float, float], folder: Path
                      ) -> None:
        """Know the place and its ways by its pictures, each for a share of the learning.

        Writes the checkpoint into the folder, after an interruption too.
        """
        network, begun = self._network(config), time.monotonic()
        facts: dict[str, float] = {}
        end, signal = begun + sum(shares) * self.learned, None
        try:
            self._learn_spots_and_ways(network, shares[0] * self.learned, end, facts)
        except KeyboardInterrupt as error:
            signal = error
        info = self._info()
        if not self.advised:
            info['notes'] += ' Interrupted before any way was learned: it drives as it did before.'
        elif self.given is not None:
            _blend(network, own=1.0 if self.given.config.places else OWN)
        save_checkpoint(folder, network, {
            **info, 'frames': 0, 'seed': self.args.seed,
            'minutes': round((time.monotonic() - begun) / 60, 2),
            'results': {'places': facts} if facts else {}})
        if signal is not None:
            raise signal

    def _learn_spots_and_ways(self, network: Policy, seconds: float, end: float, facts: dict
                              ) -> None:
        """Fit both; `facts` are filled as far as it comes."""
        own, stages, say = self.own, self.stages, functools.partial(print, flush=True)
        views, others = self.place.make_views(own, self.robot, self.args.seed)
        facts |= fit_places(network, views, others, own.poses[:, :2],
                            minutes=max(seconds, 1e-3) / 60, say=say, least=BATCH,
                            show=functools.partial(stages, 'learning the place'))
        left = end - time.monotonic()
        pictures, poses = views.draw(BANK if left > FOR_THE_BANK else LEAST_BANK)
        regrets = self.place.regrets(
            own, poses, time.monotonic() + COUNTED * left,
            functools.partial(stages, 'counting what actions lose'))
        if len(regrets) < len(own.goals):
            print(f'ways to {len(regrets)} of the {len(own.goals)} goals: for more there is no '
                  'time', flush=True)
        goals = own.pictures[list(own.goal_nodes[:len(regrets)])]

        def show(share: float) -> None:
            stages('learning the ways', share)
            self.advised = True
        facts |= fit_routes(network, pictures, goals, regrets, until=end, say=say,
                            seed=self.args.seed, show=show)

    def _info(self) -> dict:
        part = f', pictures {self.args.pictures}' if self.args.pictures else ''
        return {
            'camera_fov_deg': math.degrees(self.robot.camera_fov),
            'camera_height': self.robot.camera_height,
            'simulator': parse_scene(self.graph.name).simulator,
            'world_version': self.graph.world_version, 'preset': PRESET, 'stop_threshold': None,
            'command': 'vn_nav ' + shlex.join(word for word in sys.argv[1:]
                                              if word != '--resume'),
            'data': f'{len(self.graph.poses):,} recorded pictures of {self.args.bag.name}{part}',
            'notes': f'Taught in the pictures of {self.args.bag.name}{part}: '
                     f'{"; ".join(self.graph.words)}.'}


class _Watched:
    """Picture pairs that are drawn under somebody's eyes (a `PairSource`)."""

    def __init__(self, source: PairSource, look: Callable[[], None]):
        self._source, self._look = source, look

    @property
    def count(self) -> int:
        return self._source.count

    @count.setter
    def count(self, value: int) -> None:
        self._source.count = value

    def draw(self, count: int) -> dict[str, np.ndarray]:
        return self._source.draw(count)

    def draw_groups(self, count: int, robots: int) -> dict[str, np.ndarray]:
        self._look()
        return self._source.draw_groups(count, robots)


@torch.no_grad()
def _blend(network: Policy, own: float) -> None:
    """Weigh what a policy thinks, which one that was taught before has weighed, and the advice."""
    for layer, share in ((network.actor, own), (network.routes.advise, ADVISED)):
        for part in layer.parameters():
            part *= share


def _widened(given: dict[str, torch.Tensor], network: Policy) -> dict[str, torch.Tensor]:
    """Weights of a policy, for one whose memory is told of places as well: not yet listened to."""
    own = network.state_dict()
    for name, tensor in own.items():
        if name not in given or name.startswith(('places.', 'routes.')):  # of another place
            given[name] = tensor
        elif given[name].shape != tensor.shape:  # the inputs of the memory
            wide = torch.zeros_like(tensor)
            wide[:, :given[name].shape[1]] = given[name]
            given[name] = wide
    return {name: given[name] for name in own}


def _fast_type() -> torch.dtype:
    return torch.bfloat16 if has_fast_bfloat16() else torch.float32

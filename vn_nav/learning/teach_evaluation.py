"""The figures of `vn_nav teach`: as many rows and episodes as there is time for, as they come."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from vn_nav.evaluation import evaluator
from vn_nav.files import write_file
from vn_nav.learning.stages import Stages
from vn_nav.policy.network import Policy
from vn_nav.report import tables
from vn_nav.report.evaluation_page import evaluation_page
from vn_nav.robot import RobotSpec

DRIVE_SPLITS = ('seen_goals', 'unseen_goals')  # goals that are learned, and those held out
BEFORE = 'before teaching'
DECODING = 'sample'
RIGHT = f'right goal, {DECODING}'
ROWS = (RIGHT, BEFORE, evaluator.RANDOM, evaluator.SHORTEST, evaluator.WRONG)
WITHOUT_NETWORK = (evaluator.RANDOM, evaluator.SHORTEST)
EVALUATION_SEED = 10_000
MIN_EPISODES = 5  # episodes of a row
TIMED_STEPS = 3  # steps by which the cost of one is judged


class Row(NamedTuple):
    """One of the rows to measure."""

    split: str
    stop: str  # 'arrival' or 'declared'
    name: str


class Plan(NamedTuple):
    """What there is time for."""

    rows: list[Row]
    episodes: int  # of each
    seconds: float  # that it takes at most, where no episode ends before its limit
    missing: list[Row]  # for lack of time


class Cost(NamedTuple):
    """Seconds of a step with a number of environments."""

    envs: int
    act: float  # the network's part
    step: float  # the environment's


def rows_of(splits: Sequence[str], network: Policy, before: Policy | None) -> list[Row]:
    """All rows, the most important first."""
    found = []
    for stop in (evaluator.ARRIVAL, evaluator.DECLARED):
        for split in splits:
            for name in ROWS:
                drives = before if name == BEFORE else network
                if drives is not None and (stop == evaluator.ARRIVAL
                                           or drives.config.declares):
                    found.append(Row(split, stop, name))
    return [row for row in found
            if row.stop == evaluator.ARRIVAL or network.config.declares]


def cost_of(make_env: Callable[[int], Any], network: Policy, envs: int) -> Cost:
    """Drive a few steps, and look at the clock."""
    env = make_env(envs)
    actor = evaluator.PolicyActor(env, network, DECODING, EVALUATION_SEED)
    observation, info = env.reset(seed=EVALUATION_SEED)
    times = []
    for _ in range(1 + TIMED_STEPS):  # the first one warms up
        begun = time.monotonic()
        actions = actor(observation, info['reset'])
        middle = time.monotonic()
        observation, _, _, _, info = env.step(actions)
        times.append((middle - begun, time.monotonic() - middle))
    return Cost(envs, *np.mean(times[1:], axis=0).tolist())


def plan(rows: Sequence[Row], costs: Sequence[Cost], most: int, seconds: float, decisions: int
         ) -> Plan:
    """As many episodes a row as fit, and if the least of all rows do not, fewer rows.

    Args:
        rows: in the order of importance; the first is measured whatever it takes.
        costs: of few and of many environments.
        most: episodes of a row, at most.
        seconds: that there are.
        decisions: of an episode, at most.
    """
    few, many = costs[0], costs[-1]

    def needed(some: Sequence[Row], episodes: int) -> float:
        rounds = -(-episodes // evaluator.ENVIRONMENTS)
        share = ((-(-episodes // rounds) - few.envs) / max(many.envs - few.envs, 1))
        act, step = (max(a + share * (b - a), 0.0) for a, b in zip(few[1:], many[1:],
                                                                   strict=True))
        acting = sum(row.name not in WITHOUT_NETWORK for row in some)
        return rounds * decisions * (acting * act + len(some) * step)
    least = min(MIN_EPISODES, most)
    some = list(rows)
    while len(some) > 1 and needed(some, least) > seconds:
        some.pop()
    episodes = most
    while episodes > least and needed(some, episodes) > seconds:
        episodes -= 1
    return Plan(some, episodes, needed(some, episodes), list(rows[len(some):]))


class Evaluation:
    """Measures rows, prints each, and keeps what there is.

    Args:
        folder: of the run: gets `evaluation.json` after every row.
        result: without splits, as `measurement.new_result` makes it.
        graphs: the places with their goals by the split's name.
        make_env: (graph, environments, stop) -> vector environment.
        robot: for durations.
        threshold: of the arrival heads.
    """

    def __init__(self, folder: Path, result: dict, graphs: dict[str, Any], make_env: Callable,
                 robot: RobotSpec, threshold: float):
        self.folder, self.graphs, self.make_env = folder, graphs, make_env
        self.robot, self.threshold = robot, threshold
        self.measured: dict[str, evaluator.Rows] = {}
        self.result = result

    def run(self, chosen: Plan, network: Policy, before: Policy | None, stages: Stages) -> None:
        """Measure the rows of a plan, one after the other.

        Where the minutes are over nevertheless, the row under way is given up, but not the first.

        Raises:
            KeyboardInterrupt: a signal came; the rows before it are kept.
        """
        episodes = chosen.episodes
        rounds = -(-episodes // evaluator.ENVIRONMENTS)
        environments = -(-episodes // rounds)
        envs: dict[tuple[str, str], Any] = {}
        for count, row in enumerate(chosen.rows):
            def show(share: float, count: int = count, row: Row = row) -> None:
                # A signal counts also when the minutes are over: below, by `stages`.
                if count and stages.left < 0 and not stages.interrupted:
                    raise _OutOfTime
                stages(f'evaluation {count + 1} of {len(chosen.rows)}: '
                       f'{tables.SPLITS[row.split].lower()}, {row.stop}, {row.name}', share)
            graph = self.graphs[row.split]
            try:
                show(0.0)
                if row[:2] not in envs:
                    envs.clear()  # one is in memory at a time
                    envs[row[:2]] = self.make_env(graph, environments, row.stop)
                env = envs[row[:2]]
                actor, shown = self._actor(env, row, network, before)
                env.set_shown_goal(shown)
                found = evaluator.run_episodes(env, actor, rounds * environments,
                                               seed=EVALUATION_SEED, robot=self.robot, show=show)
            except _OutOfTime:
                left_out = len(chosen.rows) - count
                print(f'the minutes are over: {left_out} row{"s" * (left_out > 1)} of the '
                      'evaluation are left out', flush=True)
                return
            self._keep(row, found)

    def _actor(self, env, row: Row, network: Policy, before: Policy | None
               ) -> tuple[evaluator.Actor, str]:
        controls = (row.name,) if row.name in evaluator.CONTROLS else ()
        drives = before if row.name == BEFORE else network
        assert drives is not None  # `rows_of` lists no row without its policy
        actors = evaluator.make_actors(env, drives, DECODING, controls, self.threshold,
                                       EVALUATION_SEED)
        return actors[RIGHT if row.name == BEFORE else row.name]

    def _keep(self, row: Row, episodes: list) -> None:
        own = self.measured.setdefault(row.split, {}).setdefault(row.stop, {})
        own[row.name] = episodes
        split = evaluator.split_figures(self.measured[row.split], [self.graphs[row.split].name])
        rows, self.result['splits'][row.split] = split['rows'], split
        write_file(self.folder / 'evaluation.json', json.dumps(self.result, indent=2).encode())
        print(f'{tables.SPLITS[row.split]}, {row.stop} · '
              + tables.row_line(row.name, rows[row.stop][row.name], row.stop), flush=True)

    def finish(self) -> dict:
        """Print the tables, write the page; the figures by names, for a checkpoint."""
        for split, entry in self.result['splits'].items():
            tables.print_rows(entry['rows'], f'{self.folder}, {tables.SPLITS[split]}')
        plans = {name: {graph.name: graph.plan()} for name, graph in self.graphs.items()}
        write_file(self.folder / 'evaluation.html',
                   evaluation_page(self.result, self.measured, plans).encode())
        return {f'{split}: {stop}, {name}': figures
                for split, entry in self.result['splits'].items()
                for stop, own in entry['rows'].items() for name, figures in own.items()}


class _OutOfTime(Exception):
    """The minutes are over in the middle of a row."""

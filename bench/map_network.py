"""A network with the map as its input against the planner on the same map, and both together.

    python bench/map_network.py models/search                           # about two hours
    python bench/map_network.py models/search --minutes 9 --reinforce-minutes 5
    python bench/map_network.py models/search --print                   # what there is so far

Eyes, map and goal hypotheses are those of the checkpoint and of `vn_nav.policy.search` in every
row; so is the declared stop. Only who chooses the moves differs:

- **planner**: the policy as it is.
- **network**: a small network sees crops of the map about the robot, hypotheses, and numbers of
  the newest look (`map_views`). It imitates the explorer (true depth and co-visibility) by DAgger
  (Ross et al. 2011) in training houses: whole episodes are driven by teacher or learner, the
  teacher's share falls to nothing at half of the time. Then PPO: progress, contacts, a right stop
  +1, a false one costs; arriving without a stop ends nothing.
- **both**: the same, told the planner's action, which it begins by following.

All rows on the starts of `bench/search.py` at the same `--episodes`, `--houses` and `--seed`;
networks are decoded as `--decoding` says. State, at least once a minute, curves and rows go to
`--out`: a run that was ended goes on (DAgger's examples are gathered again), rows are measured
once. Prints a Markdown table.
"""

from __future__ import annotations

import argparse
import csv
import dataclasses
import datetime
import hashlib
import io
import json
import sys
import time
from pathlib import Path

import numpy as np
import torch
from map_learning import Examples, MapActor, MapNetwork, Ppo, Rollout, act, imitate, reinforce
from map_views import MapDriver, Views

from vn_nav.cli.scenes import split_scenes
from vn_nav.cli.world import load_for, machine, make_env, make_env_for
from vn_nav.errors import UserError
from vn_nav.evaluation.evaluator import DECLARED, parts_of, run_episodes
from vn_nav.evaluation.metrics import summarise
from vn_nav.files import write_file
from vn_nav.policy.checkpoint import LoadedCheckpoint
from vn_nav.policy.network_config import SEARCH
from vn_nav.report import tables
from vn_nav.report.tables import number
from vn_nav.scenes import rooms_of

PLANNER = 'planner'
VARIANTS = {'network': False, 'both': True}  # whether it is told the planner's action
RUNS = tuple(f'{variant}_{stage}' for variant in VARIANTS for stage in ('imitated', 'reinforced'))
EXAMPLES = 40_000  # kept; 16 kB each
BATCH = 256
LEARNING_RATES = 6e-4, 1e-4  # of the imitation, first and last
FALSE_STOP = -0.5  # reward
ENVIRONMENT = {'progress_reward': 1.0, 'collision_reward': -0.05}
SAVE_SECONDS = 30.0


@dataclasses.dataclass
class Training:
    """One network in one stage, as it is kept."""

    path: Path
    network: MapNetwork
    optimiser: torch.optim.Optimizer
    seconds: float = 0.0  # of this process's own work: a budget holds beside other work too
    wall: float = 0.0  # s on the clock
    frames: int = 0
    curve: list[dict] = dataclasses.field(default_factory=list)

    @classmethod
    def at(cls, path: Path, advised: bool, rate: float, seed: int, before: Path | None
           ) -> Training:
        """As it was left; else new, with the weights of the stage before."""
        torch.manual_seed(seed)
        network = MapNetwork(advised)
        own = cls(path, network, torch.optim.Adam(network.parameters(), rate))
        if path.exists():
            state = torch.load(path)
            network.load_state_dict(state['network'])
            own.optimiser.load_state_dict(state['optimiser'])
            own.seconds, own.wall = state['seconds'], state['wall']
            own.frames, own.curve = state['frames'], state['curve']
        elif before is not None:
            network.load_state_dict(torch.load(before)['network'])
        return own

    def save(self) -> None:
        """Keep it, whole or not at all."""
        data = io.BytesIO()
        torch.save({'network': self.network.state_dict(), 'seconds': self.seconds,
                    'wall': self.wall, 'optimiser': self.optimiser.state_dict(),
                    'frames': self.frames, 'curve': self.curve}, data)
        write_file(self.path, data.getvalue())


class Watch:
    """The time of a training, its curve, and when to save it."""

    def __init__(self, training: Training, seconds: float):
        self.training, self.most = training, seconds
        self._last, self._worked = time.monotonic(), time.process_time()
        self._saved = self._last
        self._ended: list[tuple[bool, bool, int]] = []  # success, false stop, decisions
        self._figures: list[dict] = []
        self._contacts: list[float] = []

    @property
    def share(self) -> float:
        """Of the time that is over."""
        return self.training.seconds / self.most

    def ended(self, info: dict, declared: np.ndarray, rows: np.ndarray) -> None:
        """Count episodes [K] of the learner that have ended."""
        self._ended += [(bool(info['success'][n]), bool(declared[n] and not info['success'][n]),
                         int(info['decisions'][n])) for n in rows]

    def tick(self, frames: int, figures: dict, contacts: float) -> None:
        """Some more frames; a line of the curve and the state once in a while."""
        now, worked = time.monotonic(), time.process_time()
        self.training.seconds += worked - self._worked
        self.training.wall += now - self._last
        self.training.frames += frames
        self._last, self._worked = now, worked
        self._contacts.append(contacts)
        if figures:
            self._figures.append(figures)
        if now - self._saved > SAVE_SECONDS or self.training.seconds >= self.most:
            self._write()
            self._saved = now

    def _write(self) -> None:
        ended = np.array(self._ended, float).reshape(-1, 3)
        row = {'minutes': self.training.seconds / 60, 'wall_minutes': self.training.wall / 60,
               'frames': self.training.frames, 'episodes': len(ended),
               'collisions': float(np.mean(self._contacts)),
               **({'success': ended[:, 0].mean(), 'false_stops': ended[:, 1].mean(),
                   'decisions': ended[:, 2].mean()} if len(ended) else {})}
        if self._figures:
            row |= {name: float(np.mean([own[name] for own in self._figures]))
                    for name in self._figures[0]}
        row = {name: round(float(value), 4) for name, value in row.items()}
        self.training.curve.append(row)
        self.training.save()
        self._ended, self._figures, self._contacts = [], [], []
        print(self.training.path.stem, *(f'{name} {value:g}' for name, value in row.items()),
              flush=True)


def imitation(training: Training, env, eyes, threshold: float, minutes: float, seed: int) -> None:
    """Imitate the explorer (DAgger) until the minutes are over."""
    watch = Watch(training, 60 * minutes)
    if watch.share >= 1:
        return
    network, count = training.network.train(), env.num_envs
    driver = MapDriver(eyes, count, plans=network.advised)
    examples, rng = Examples(EXAMPLES), np.random.default_rng((seed, training.frames))
    generator = torch.Generator().manual_seed(seed + training.frames)
    observation, info = env.reset(seed=seed + training.frames)
    taught, over = np.zeros(count, bool), np.zeros(count, bool)
    while watch.share < 1:
        begun = info['reset']
        taught[begun] = rng.random(begun.sum()) < 1 - 2 * watch.share
        views = driver.look(observation, env.goals, begun)
        own, _, _ = act(network, views, 'sample', generator)
        teacher = info['explorer_action']
        # Where it has arrived unannounced the teacher has nothing to teach.
        examples.add(views, teacher, np.flatnonzero(~over & ~info['arrived']))
        stop = np.where(taught, info['arrived'], views.arrival > threshold)
        acting = ~over
        observation, _, terminated, truncated, info = env.step(
            np.where(stop, env.declare_action, np.where(taught, teacher, own)))
        over = terminated | truncated
        watch.ended(info, stop, np.flatnonzero(over & ~taught))
        first, last = LEARNING_RATES
        training.optimiser.param_groups[0]['lr'] = first + watch.share * (last - first)
        figures = {}
        if examples.count >= 4 * BATCH:
            loss, agreement = imitate(network, training.optimiser, *examples.draw(BATCH, rng))
            figures = {'loss': loss, 'agreement': agreement, 'taught': float(taught.mean())}
        learner = acting & ~taught
        watch.tick(int(acting.sum()), figures,
                   float(info['collided'][learner].mean()) if learner.any() else 0.0)


def reinforcement(training: Training, env, eyes, threshold: float, minutes: float, seed: int
                  ) -> None:
    """PPO until the minutes are over."""
    watch, ppo = Watch(training, 60 * minutes), Ppo()
    if watch.share >= 1:
        return
    network = training.network.train()
    driver = MapDriver(eyes, env.num_envs, plans=network.advised)
    generator = torch.Generator().manual_seed(seed + training.frames)
    observation, info = env.reset(seed=seed + training.frames)
    over, rollouts = np.zeros(env.num_envs, bool), 0
    views: Views | None = None
    while watch.share < 1:
        steps: list[tuple] = []
        contacts = []
        for _ in range(ppo.steps):
            if views is None:
                views = driver.look(observation, env.goals, info['reset'])
            action, log, value = act(network, views, 'sample', generator)
            stop, valid = views.arrival > threshold, ~over
            observation, reward, terminated, truncated, info = env.step(
                np.where(stop, env.declare_action, action))
            over = terminated | truncated
            reward = reward + FALSE_STOP * (terminated & ~info['success'])
            steps.append((*views[:3], action, log, value, reward.astype(np.float32), terminated,
                          truncated, valid, ~stop))
            watch.ended(info, stop, np.flatnonzero(over))
            contacts.append(info['collided'][valid].mean())
            views = driver.look(observation, env.goals, info['reset'])
        _, _, value = act(network, views, 'sample', generator)
        parts = [torch.from_numpy(np.stack(part)) for part in zip(*steps, strict=True)]
        parts[5] = torch.cat([parts[5], torch.from_numpy(value)[None]])
        rollout = Rollout(*parts)
        figures = reinforce(network, training.optimiser, rollout, ppo,
                            rollouts < ppo.critic_first, generator)
        rollouts += 1
        watch.tick(int(rollout.valid.sum()),
                   {**figures, 'reward': rollout.reward.sum().item() / rollout.valid.sum().item()},
                   float(np.mean(contacts)))


def train(checkpoint: LoadedCheckpoint, options: argparse.Namespace) -> None:
    """Every network that is asked for, as far as it has not learned yet."""
    env, threshold = None, stop_threshold(checkpoint, options)
    info = checkpoint.info
    for name in options.runs:
        variant, stage = name.split('_')
        imitated = stage == 'imitated'
        minutes = options.minutes if imitated else options.reinforce_minutes
        before = None if imitated else options.out / f'{variant}_imitated.pt'
        if before is not None and not before.exists():
            raise UserError('what is reinforced has imitated before', name,
                            f'name {variant}_imitated among --runs as well')
        training = Training.at(options.out / f'{name}.pt', VARIANTS[variant],
                               LEARNING_RATES[0] if imitated else Ppo.learning_rate,
                               options.train_seed, before)
        if training.seconds >= 60 * minutes:
            continue
        if env is None:
            env = make_env(split_scenes(info['simulator'], 'train', options.train_houses),
                           options.robots, size=checkpoint.config.size, stop=DECLARED,
                           randomisation=info['randomisation'], odometry='drift',
                           actions=checkpoint.config.actions,
                           privileged=('explorer_action',), **ENVIRONMENT)
        learn = imitation if imitated else reinforcement
        learn(training, env, checkpoint.network, threshold, minutes, options.train_seed)
    if env is not None:
        env.close()


def stop_threshold(checkpoint: LoadedCheckpoint, options: argparse.Namespace) -> float:
    """Probability of having arrived above which every row declares."""
    return (checkpoint.info['stop_threshold'] if options.stop_threshold is None
            else options.stop_threshold)


def evaluate(checkpoint: LoadedCheckpoint, options: argparse.Namespace) -> None:
    """Measure every row that is not measured yet."""
    info, threshold = checkpoint.info, stop_threshold(checkpoint, options)
    scenes = split_scenes(info['simulator'], options.split, options.houses,
                          rooms_of(info['scenes'][0]) if info['scenes'] else None)
    envs: dict[int, object] = {}
    for name in (PLANNER, *options.runs):
        state = options.out / f'{name}.pt'
        decoding = 'greedy' if name == PLANNER else options.decoding
        wanted = {'checkpoint': info['sha256'], 'episodes': options.episodes, 'seed': options.seed,
                  'split': options.split, 'houses': options.houses, 'stop_threshold': threshold,
                  'max_decisions': options.max_decisions, 'decoding': decoding,
                  'weights': (hashlib.sha256(state.read_bytes()).hexdigest()
                              if name != PLANNER else None)}
        path = row_path(options, name)
        if path.exists() and json.loads(path.read_text())['conditions'] == wanted:
            continue
        training = None if name == PLANNER else torch.load(state)
        begun, episodes = time.monotonic(), []
        for chunk, (part, count, rounds) in enumerate(parts_of(scenes, options.episodes)):
            if chunk not in envs:
                envs[chunk] = make_env_for(checkpoint, part, count, stop=DECLARED, own=False,
                                           max_decisions=options.max_decisions)
            env = envs[chunk]
            network = None
            if training is not None:
                network = MapNetwork(VARIANTS[name.split('_')[0]])
                network.load_state_dict(training['network'])
            actor = MapActor(env, checkpoint.network, network, decoding, options.seed + chunk,
                             threshold, rounds)
            episodes += run_episodes(env, actor, rounds * count, seed=options.seed + chunk,
                                     robot=env.robot)
        entry = {'row': name, 'conditions': wanted, 'figures': summarise(episodes),
                 'successes': [int(episode.success) for episode in episodes],
                 'frames': training['frames'] if training else 0,
                 'train_minutes': round(training['seconds'] / 60, 1) if training else 0.0,
                 'train_wall_minutes': round(training['wall'] / 60, 1) if training else 0.0,
                 'minutes': round((time.monotonic() - begun) / 60, 1), 'machine': machine(),
                 'date': datetime.date.today().isoformat()}
        write_file(path, (json.dumps(entry, indent=2) + '\n').encode())
        print(name, json.dumps(entry['figures']), flush=True)
    for env in envs.values():
        env.close()


def row_path(options: argparse.Namespace, name: str) -> Path:
    """Where a row is kept."""
    return options.out / (f'{name}.json' if name == PLANNER else
                          f'{name}.{options.decoding}.json')


def markdown(options: argparse.Namespace) -> str:
    """The rows that there are as a table; differences are paired, episode by episode."""
    headings = ['', 'frames (minutes) of this stage', 'episodes', 'declared stop (95 %)', 'SPL',
                'less the planner, paired (95 %)', 'false stops', 'at the goal at some time',
                'collisions', 'decisions']
    lines, planner = [headings, ['---'] * len(headings)], None
    for name in (PLANNER, *RUNS):
        path = row_path(options, name)
        if not path.exists():
            continue
        entry = json.loads(path.read_text())
        own, difference = entry['figures'], ''
        if name == PLANNER:
            planner = np.array(entry['successes'], float)
        elif planner is not None and len(planner) == len(entry['successes']):
            difference = paired(np.array(entry['successes'], float) - planner)
        low, high = own['success_interval']
        lines.append([
            name.replace('_', ', '), f'{entry["frames"]:,} ({entry["train_minutes"]:g})'
            if entry['frames'] else '', str(own['episodes']),
            f'{own["success"]:.2f} ({low:.2f}-{high:.2f})', number(own['spl'], '.2f'), difference,
            f'{own["false_stops"]:.2f}', f'{own["reached"]:.2f}',
            f'{100 * own["collisions"]:.1f} %', f'{own["decisions"]:.0f}'])
    return tables.markdown(lines)


def paired(difference: np.ndarray) -> str:
    """Mean of differences [K] and its 95 % interval by resampling."""
    rng = np.random.default_rng(0)
    means = difference[rng.integers(len(difference), size=(2000, len(difference)))].mean(1)
    low, high = np.percentile(means, [2.5, 97.5])
    return f'{difference.mean():+.2f} ({low:+.2f} to {high:+.2f})'


def write_curves(options: argparse.Namespace) -> None:
    """All curves in one CSV file."""
    rows = []
    for name in RUNS:
        path = options.out / f'{name}.pt'
        if path.exists():
            rows += [{'run': name, **row} for row in torch.load(path)['curve']]
    columns = list(dict.fromkeys(column for row in rows for column in row))
    text = io.StringIO()
    writer = csv.DictWriter(text, columns, lineterminator='\n')
    writer.writeheader()
    writer.writerows(rows)
    write_file(options.out / 'curves.csv', text.getvalue().encode())


def main() -> int:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__.split('\n')[0])
    parser.add_argument('checkpoint', type=Path, help='of the architecture search')
    parser.add_argument('--runs', nargs='+', choices=RUNS, default=list(RUNS), metavar='RUN',
                        help=f'networks to train and to measure: {", ".join(RUNS)}')
    parser.add_argument('--minutes', type=float, default=25, help='of one core, of each imitation')
    parser.add_argument('--reinforce-minutes', type=float, default=15, help='of each PPO')
    parser.add_argument('--robots', type=int, default=32, help='that learn at once')
    parser.add_argument('--train-houses', type=int, default=64)
    parser.add_argument('--train-seed', type=int, default=1)
    parser.add_argument('--decoding', choices=('sample', 'greedy'), default='sample',
                        help='of the networks while they are measured')
    parser.add_argument('--episodes', type=int, default=100,
                        help='of a row at least; in 20 houses 100 make 116')
    parser.add_argument('--houses', type=int, default=20, help='of the split')
    parser.add_argument('--split', default='validation')
    parser.add_argument('--max-decisions', type=int, default=300)
    parser.add_argument('--stop-threshold', type=float, metavar='P')
    parser.add_argument('--seed', type=int, default=10_000, help='of the measured episodes')
    parser.add_argument('--out', type=Path, default=Path('runs/map_network'))
    parser.add_argument('--print', dest='only_print', action='store_true',
                        help='train and measure nothing: print what there is')
    options = parser.parse_args()
    torch.set_num_threads(1)
    try:
        checkpoint, _ = load_for(options.checkpoint)
        if checkpoint.config.architecture != SEARCH:
            raise UserError('the map is that of a policy of the architecture search',
                            f'{options.checkpoint}: {checkpoint.config.architecture}',
                            'name another checkpoint')
        options.out.mkdir(parents=True, exist_ok=True)
        if not options.only_print:
            train(checkpoint, options)
            evaluate(checkpoint, options)
        write_curves(options)
    except UserError as error:
        print(f'bench/map_network.py: {error}', file=sys.stderr)
        return 2
    table = markdown(options)
    write_file(options.out / 'table.md', (table + '\n').encode())
    print(table)
    return 0


if __name__ == '__main__':
    sys.exit(main())

"""Measures a policy in vector environments, beside random actions and the shortest path."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence

import numpy as np

from vn_nav.arrival import radius_of
from vn_nav.errors import UserError
from vn_nav.evaluation.metrics import Episode, summarise
from vn_nav.lens import zoom_of
from vn_nav.observation import preprocess
from vn_nav.policy.batched import BatchedPolicy
from vn_nav.policy.network import Policy
from vn_nav.policy.network_config import SEARCH
from vn_nav.policy.search.snapshot import Snapshot, snapshot
from vn_nav.policy.search.views import NONE
from vn_nav.policy.zhu import scene_numbers
from vn_nav.robot import RobotSpec
from vn_nav.vector_env import ExploringEnv, MeasuredVectorEnv

Actor = Callable[[dict, np.ndarray], np.ndarray]  # (observation, reset [N]) -> actions [N]
Rows = dict[str, dict[str, list[Episode]]]  # 'arrival' or 'declared', then a row's name
OnRow = Callable[[str, str, int], None]  # the same of a row, and its number of episodes so far
ARRIVAL, DECLARED = 'arrival', 'declared'  # what ends an episode before its limit
STOPS = (ARRIVAL, DECLARED)
OTHER, WRONG, ABSENT, BLANK, RANDOM, EXPLORER, SHORTEST = (
    'other decoding', 'wrong goal', 'absent goal', 'blank goal', 'random actions', 'explorer',
    'shortest path')
CONTROLS = (OTHER, WRONG, ABSENT, BLANK, RANDOM, EXPLORER, SHORTEST)
STOP_THRESHOLD = 0.5  # of the arrival head's probability, by default
SCENES_AT_ONCE = 16  # in memory
ENVIRONMENTS = 50  # at most at once, unless there are more scenes
SAME_FOV = 0.01  # share by which two fields of view may differ


def run_episodes(env: MeasuredVectorEnv, actor: Actor, episodes: int, *, seed: int,
                 robot: RobotSpec, show: Callable[[float], None] = lambda share: None
                 ) -> list[Episode]:
    """Run a fixed number of episodes in each environment (early finishers would flatter).

    Args:
        env: its rewards should be the sparse ones.
        actor: chooses the actions; what it says in an attribute `filtered`, as `PolicyActor` has
            it, is counted, and what its method `snapshot` says is kept of ended episodes.
        episodes: at least this many; rounded up to the same number in each environment.
        seed: of the environment: equal seeds give equal starts.
        robot: for the duration of actions at its default limits.
        show: is told the share of the episodes that is over before every step, and may raise
            there.

    Returns:
        Environment by environment, each in the order of time.
    """
    count = env.num_envs
    each = -(-episodes // count)
    durations = np.array([*(robot.with_actions(tuple(env.action_names)).nominal_duration(a)
                            for a in range(len(env.action_names))), 0.0])  # declaring: no time
    poses = _goal_poses(env)
    found: list[list[Episode]] = [[] for _ in range(count)]
    collisions, seconds, reward = np.zeros(count, int), np.zeros(count), np.zeros(count)
    filtered = np.zeros((2, count), int)
    reached = np.zeros(count, bool)
    look_inside = getattr(actor, 'snapshot', None)
    observation, info = env.reset(seed=seed)
    paths = [[pose[:3]] for pose in info['pose']]
    contacts: list[list[np.ndarray]] = [[] for _ in range(count)]
    while any(len(own) < each for own in found):
        show(sum(min(len(own), each) for own in found) / (each * count))
        actions = actor(observation, info['reset'])
        observation, rewards, terminated, truncated, info = env.step(actions)
        acting = ~info['reset']
        behind_filter = getattr(actor, 'filtered', None)  # random actions and oracle have none
        if behind_filter is not None:
            filtered += behind_filter & acting
        collisions += info['collided'] & acting
        seconds += np.where(acting, durations[actions], 0)
        reward += rewards
        reached |= info['arrived'] & acting
        for n in range(count):
            if info['reset'][n]:
                paths[n], contacts[n] = [], []
            paths[n].append(info['pose'][n, :3])
            if info['collided'][n]:
                contacts[n].append(info['pose'][n, :2])
        for n in np.nonzero(terminated | truncated)[0].tolist():
            found[n].append(Episode(
                success=bool(info['success'][n]), start_distance=float(info['start_distance'][n]),
                path_length=float(info['path_length'][n]), decisions=int(info['decisions'][n]),
                unit=env.distance_unit, arrival_radius=radius_of(env.config.task),
                collisions=int(collisions[n]), seconds=float(seconds[n]),
                stop_distance=float(info['distance'][n]),
                stop_heading=float(info['heading_error'][n]), reward=float(reward[n]),
                goal=env.goal_rooms[info['goal'][n]],
                scene=env.places[env.place_index[n]].name,
                declared=(None if env.declare_action is None
                          else bool(actions[n] == env.declare_action)),
                reached=bool(reached[n]),
                filtered=None if behind_filter is None else tuple(filtered[:, n].tolist()),
                at_shown=_at_shown(env, info, n),
                trajectory=np.array(paths[n]),
                contacts=np.array(contacts[n]).reshape(-1, 2),
                search=None if look_inside is None else look_inside(n),
                goal_pose=None if poses is None else tuple(poses[info['goal'][n]].tolist())))
            collisions[n], seconds[n], reward[n], reached[n] = 0, 0.0, 0.0, False
            filtered[:, n] = 0
    return [episode for own in found for episode in own[:each]]


def _at_shown(env: MeasuredVectorEnv, info: dict, n: int) -> bool | None:
    """See `Episode.at_shown`."""
    if env.declare_action is None or not info.get('shown_other', np.zeros(n + 1, bool))[n]:
        return None
    return bool(info['at_shown'][n])


def _goal_poses(env: MeasuredVectorEnv) -> np.ndarray | None:
    """[G,3] where the goals are; None where the task's goal is no pose."""
    return env.goal_poses[:, :3] if env.config.task == 'image' else None


def random_actor(env: MeasuredVectorEnv, seed: int) -> Actor:
    """Uniform random actions; where a stop is declared, that is one of them."""
    rng, choices = np.random.default_rng(seed), int(env.single_action_space.n)
    return lambda observation, reset: rng.integers(0, choices, env.num_envs)


class PolicyActor:
    """A trained policy.

    Args:
        env: where it acts; with `stop='declared'` it also declares that it has arrived.
        network: the policy.
        decoding: 'sample' or 'greedy'.
        seed: of the sampled actions.
        threshold: probability of having arrived above which it declares.
        known: scenes that it was trained in, for a network with layers for several scenes.
        camera_fov: field of view that it was trained with [rad]; None: that of the robots. Larger
            pictures of a robot with another one are made its own, as `policy_node` does.
        verify: see `PolicyRuntime`; the network is shown the robots' pictures shrunk.

    Attributes:
        filtered: [2,N] bool: where the action filter acted on the last actions, and where it
            changed them; None: the policy has no filter, or has not acted yet.
    """

    def __init__(self, env: MeasuredVectorEnv, network: Policy, decoding: str, seed: int,
                 threshold: float = STOP_THRESHOLD, known: Sequence[str] = (),
                 camera_fov: float | None = None, verify: str = NONE):
        self.env, self.threshold = env, threshold
        self._size, self._camera_fov = network.config.size, camera_fov
        self._verifies = verify != NONE
        self._goals: tuple[np.ndarray, np.ndarray] | None = None  # the robots', and the network's
        self.known = known if network.config.scenes > 1 else ()
        self.policy = BatchedPolicy(
            network, env.num_envs, decoding=decoding, seed=seed,
            scanner=getattr(env, 'scanner', None),
            zoom=(max(zoom_of(env.robot.camera_fov, network.config.view), 1.0)
                  if network.config.architecture == SEARCH else 1.0),
            verify=verify, camera_fov=env.robot.camera_fov, camera_pitch=env.robot.camera_pitch,
            max_decisions=env.config.max_decisions)
        self.filtered: np.ndarray | None = None

    def __call__(self, observation: dict, reset: np.ndarray) -> np.ndarray:
        scene = None
        if self.known:
            scene = scene_numbers([self.env.places[place].name for place in self.env.place_index],
                                  self.known)
        full = observation['image'], self.env.goals
        observation = {**observation, 'image': self._own(observation['image'])}
        if self._goals is None or self._goals[0] is not self.env.goals:
            self._goals = self.env.goals, self._own(self.env.goals)
        goals = self._goals[1]
        known = getattr(self.env, 'goal_features', None)
        if known is not None and self.policy.takes_features(known.shape[-1]):
            goals = known
        actions = self.policy.act(observation, goals, reset, scene, full)
        declares = np.zeros(len(actions), bool)
        declare = self.env.declare_action
        if declare is not None:
            declares = self.policy.arrival > self.threshold
        if self.policy.filtered is not None:
            self.filtered = np.stack(self.policy.filtered) & ~declares
        return actions if declare is None or not declares.any() else np.where(
            declares, declare, actions)

    def snapshot(self, n: int) -> Snapshot | None:
        """What a policy that searches knows in environment n; None: it is another."""
        search = self.policy.search
        return None if search is None else snapshot(search.searchers[n])

    def _own(self, pictures: np.ndarray) -> np.ndarray:
        """Pictures [K,3,H,H] of the robots' cameras as the network takes them."""
        if self._camera_fov is None or (
                self.env.robot.camera_fov <= (1 + SAME_FOV) * self._camera_fov):
            return self._shrunk(pictures)
        fov = self.env.robot.camera_fov
        return np.stack([preprocess(picture.transpose(1, 2, 0), self._size, fov=fov,
                                    target_fov=self._camera_fov) for picture in pictures])

    def _shrunk(self, pictures: np.ndarray) -> np.ndarray:
        if not self._verifies or pictures.shape[-1] == self._size:
            return pictures
        return np.stack([preprocess(picture.transpose(1, 2, 0), self._size)
                         for picture in pictures])


def measure(make_env: Callable, network: Policy, scenes: Sequence[str], *, decoding: str,
            episodes: int = 100, controls: Sequence[str] = CONTROLS,
            threshold: float | None = None, seed: int = 10_000, known: Sequence[str] = (),
            robot: RobotSpec | None = None, camera_fov: float | None = None,
            stops: Sequence[str] = STOPS, own: bool = True, verify: str = NONE,
            on_row: OnRow | None = None) -> Rows:
    """Episodes of a policy and of its controls, the same number in each scene.

    A network that can declare its stop is measured a second time, with declared stops.

    Args:
        make_env: (scenes, environments, stop) -> vector environment in which environment i lives
            in scene i modulo their number; `stop` is 'arrival' or 'declared'.
        network: the policy.
        scenes: their names.
        decoding: 'sample' or 'greedy'.
        episodes: at least this many a row.
        controls: which of `CONTROLS`, on the same starts.
        threshold: of the arrival head; None: 0.5.
        seed: of environments and sampled actions.
        known: scenes that the policy was trained in, see `PolicyActor`.
        robot: for durations; that of the environment if left out.
        camera_fov: see `PolicyActor`.
        stops: which of `STOPS`.
        own: the policy itself drives to its goals; else the controls alone.
        verify: see `PolicyActor`.
        on_row: called as a row gets longer; None: nobody is told.

    Returns:
        By kind of stop and by row: {'arrival': {'right goal, sample': episodes, ...},
        'declared': ...}; the second only where the policy can declare.

    Raises:
        UserError: declared stops alone, of a policy that cannot declare.
    """
    if ARRIVAL not in stops and not network.config.declares:
        raise UserError('a policy that declares its stop has the head arrival, or searches',
                        f'heads {", ".join(network.config.heads) or "none"}',
                        'measure arrival as well')
    rows: Rows = {}
    threshold = STOP_THRESHOLD if threshold is None else threshold
    for chunk, (part, environments, rounds) in enumerate(parts_of(scenes, episodes)):
        for stop in stops:
            if stop == DECLARED and not network.config.declares:
                continue
            with contextlib.closing(make_env(part, environments, stop)) as env:
                actors = make_actors(env, network, decoding, controls, threshold, seed + chunk,
                                     known, camera_fov, own, verify)
                for name, (actor, shown) in actors.items():
                    env.set_shown_goal(shown)
                    row = rows.setdefault(stop, {}).setdefault(name, [])
                    row.extend(run_episodes(env, actor, rounds * environments, seed=seed + chunk,
                                            robot=robot or env.robot))
                    if on_row is not None:
                        on_row(stop, name, len(row))
                if env.config.task != 'image' or env.simulator.capabilities.rewards:
                    break  # nothing to declare
    return rows


def parts_of(scenes: Sequence[str], episodes: int) -> list[tuple[list[str], int, int]]:
    """Scenes that are measured at once, with environments for them and episodes of each of these.

    Args:
        scenes: their names.
        episodes: at least this many in all, the same number in each scene.
    """
    each = -(-episodes // len(scenes))
    found = []
    for begin in range(0, len(scenes), SCENES_AT_ONCE):
        part = list(scenes[begin:begin + SCENES_AT_ONCE])
        rounds = -(-each // max(1, ENVIRONMENTS // len(part)))
        found.append((part, len(part) * -(-each // rounds), rounds))
    return found


def make_actors(env, network: Policy, decoding: str, controls: Sequence[str], threshold: float,
                seed: int, known: Sequence[str] = (), camera_fov: float | None = None,
                own: bool = True, verify: str = NONE) -> dict[str, tuple[Actor, str]]:
    """Who drives in each row, and which goal picture it is shown; the policy itself first.

    Args: see `measure`.
    """
    def policy(rule: str = decoding) -> Actor:
        return PolicyActor(env, network, rule, seed, threshold, known, camera_fov, verify)

    rows: dict[str, tuple[Actor, str]] = {}
    if own:
        rows[f'right goal, {decoding}'] = policy(), 'right'
    if OTHER in controls and network.config.architecture != SEARCH:  # which draws no lots
        other = 'greedy' if decoding == 'sample' else 'sample'
        rows[f'right goal, {other}'] = policy(other), 'right'
    # Where arriving is enough, an absent goal's picture says no more than a blank one.
    absent = env.declare_action is not None and len(env.places) > 1
    for name, shown in ((WRONG, 'wrong'), (ABSENT, 'absent'), (BLANK, 'blank')):
        if name in controls and (name != ABSENT or absent):
            rows[name] = policy(), shown
    if RANDOM in controls:
        rows[RANDOM] = random_actor(env, seed), 'right'
    if EXPLORER in controls and isinstance(env, ExploringEnv) and env.explores:
        rows[EXPLORER] = (lambda observation, reset: env.explorer_actions()), 'right'
    if SHORTEST in controls:
        rows[SHORTEST] = (lambda observation, reset: env.oracle_actions()), 'right'
    return rows


def figures(rows: Rows) -> dict[str, dict[str, dict]]:
    """The summary of every row, by kind of stop."""
    return {stop: {name: summarise(episodes) for name, episodes in own.items()}
            for stop, own in rows.items()}


def by_scene(rows: Rows) -> dict[str, Rows]:
    """The same rows for each scene alone, by its name."""
    scenes: dict[str, Rows] = {}
    for stop, own in rows.items():
        for name, episodes in own.items():
            for episode in episodes:
                scenes.setdefault(episode.scene, {}).setdefault(stop, {}).setdefault(
                    name, []).append(episode)
    return scenes


def split_figures(rows: Rows, scenes: Sequence[str]) -> dict[str, dict]:
    """What a result says of a split: all its rows, and those of each of its scenes.

    Args:
        rows: episodes, as `measure` returns them.
        scenes: names, in the order to be shown in.
    """
    own = by_scene(rows)
    return {'rows': figures(rows),
            'scenes': {scene: figures(own[scene]) for scene in scenes if scene in own}}

"""Presets: the method of the thesis, its baselines, and our best, as numbers of one learner.

A preset says how to learn and in what environments (`ENVIRONMENT`). `vn_nav train --preset NAME`
starts from it; every number can be changed from the command line.

| preset | what it is |
|---|---|
| `thesis` | A2CAT-VN: batched A2C, LSTM, off-policy critic, pixel control, reward prediction, depth, both segmentations (thesis, table 5.1) |
| `unreal` | the same without the three image heads (thesis, 5.7; Jaderberg et al. 2016) |
| `a2c` | the same without any auxiliary task |
| `framestack` | `unreal` with the last four pictures and a linear layer instead of the LSTM (thesis, 5.4) |
| `icra2017` | Zhu et al. 2017: frozen features of four pictures, siamese layers, layers of its own for each scene; 10 at the goal, -0.01 a step (sections IV-B and IV-C) |
| `fast` | PPO, early fusion, GAE, Adam, success-driven curriculum; goal poses, learned from picture pairs first |
| `anywhere` | `fast` for houses that no training saw: a correlation volume, the goal tracked, a teacher that explores (docs/results.md) |
| `search` | the networks of a policy that searches any house with a map: supervised on picture pairs, nobody drives (`vn_nav.learning.sight_training`); frames are pairs |
"""  # noqa: E501

from __future__ import annotations

import dataclasses
import math
import numbers
import re
import typing

from vn_nav.errors import UserError
from vn_nav.labels import CLASSES
from vn_nav.learning.learner_config import LearnerConfig
from vn_nav.policy.action_filter import NONE
from vn_nav.policy.encoders import LARGE_LAYOUT_PX
from vn_nav.policy.network_config import SEARCH, NetworkConfig


def _is_finite(value) -> bool:
    return (isinstance(value, numbers.Real) and not isinstance(value, bool)
            and math.isfinite(value))


# What a field may be: a text for people, and the test.
KINDS: dict[type, tuple] = {
    bool: ('true or false', lambda value: isinstance(value, bool)),
    int: ('a whole number', lambda value: _is_finite(value) and value == int(value)),
    float: ('a number', _is_finite),
    str: ('a text', lambda value: isinstance(value, str)),
}
GIVEN = 'scene'  # `TrainConfig.frozen_weights`: the scenes bring the features
BAG_WEIGHTS = ('bag_imitation', 'bag_goal_pose', 'bag_arrival', 'bag_distance', 'bag_image')


@dataclasses.dataclass(frozen=True)
class TrainConfig(LearnerConfig):
    """All numbers of a training, without those of the environment."""

    preset: str = 'fast'  # where the numbers come from
    frames: int = 3_000_000  # agent decisions; the linear schedules end here
    minutes: float | None = None  # wall-clock limit; the schedules end with it if it comes first
    rollout_length: int = 64  # steps
    # The network, see `NetworkConfig`.
    architecture: str = 'fused'
    channels: tuple[int, int, int] = (32, 64, 32)
    blocks: int = 0
    features: int = 256
    hidden: int = 256
    stacked_frames: int = 1
    # None: one below `LARGE_LAYOUT_PX` pixels, else two (table 5.1).
    deconvolutions: int | None = None
    pose_to_memory: bool = False
    places: int = 0  # place cells of a place that `vn_nav teach` has taught
    track_goal: bool = False  # by dead reckoning, see `vn_nav.policy.memory.GoalTracker`
    # Whether a policy that tracks its goal acts behind the filter of blocked actions, in rollouts
    # and wherever its checkpoint is used, see `vn_nav.policy.action_filter`.
    action_filter: bool = True
    # Of icra2017: the file with the weights of ResNet-50, or `scene`: the features that the files
    # of grid scenes hold (without one: the small random encoder); and the scenes with layers of
    # their own (place i of the environment is scene i).
    frozen_weights: str = ''
    scenes: int = 1
    pixel_mean: float = 120.0
    pixel_std: float = 36.0
    # Before the first frame: the encoder learns from picture pairs, see `vn_nav.learning.pairs`.
    pair_minutes: float = 0.0
    pair_houses: int = 256
    pair_learning_rate: float = 1e-3  # at the start
    # Bags in addition to rollouts, see `vn_nav.learning.bag_mix`: steps of drives for each step of
    # a rollout, and the weights of their losses.
    bag_share: float = 0.25
    bag_imitation: float = 0.1  # at the start; falls to 0 at `imitation_until`
    bag_goal_pose: float = 0.5
    bag_arrival: float = 0.2
    bag_distance: float = 0.1
    bag_image: float = 0.1  # of each image head whose key the bags have
    # Heads in addition to those of the tasks: of a checkpoint to begin with. Bags teach them, or
    # nothing does.
    extra_heads: tuple[str, ...] = ()
    curriculum: str = 'success'  # or 'frames': what raises the difficulty
    start_difficulty: float = 0.3  # tau of the curriculum; 1 switches it off
    # Of 'frames': shares of the training between which tau grows; beyond 1 it does not get there.
    curriculum_begin: float = 0.125
    curriculum_end: float = 0.25
    success_to_advance: float = 0.75
    difficulty_step: float = 0.1
    advance_window: int = 200  # episodes
    seed: int = 0
    device: str = 'cpu'  # of the network, and of `vn_nav train`'s simulator; or cuda:0
    bf16: bool | None = None  # None: where the processor multiplies bfloat16 in hardware
    threads: int = 1  # of torch
    # Collect the next rollout, by the weights before the update, while learning from this one: a
    # second core's work. The ratio of PPO accounts for it, A2C has no such correction.
    overlap: bool = False
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
            (0 <= self.curriculum_begin < self.curriculum_end,
             'the curriculum begins before it ends', (self.curriculum_begin, self.curriculum_end)),
            (self.difficulty_step > 0, 'difficulty_step is positive', self.difficulty_step),
            (self.advance_window >= 1, 'advance_window is positive', self.advance_window),
            (self.pair_minutes == 0 or (self.pair_minutes > 0 and 'goal_pose' in self.tasks),
             'picture pairs teach the task goal_pose: pair_minutes needs its weight',
             self.pair_minutes),
            (self.pair_houses >= 1, 'pair_houses is positive', self.pair_houses),
            (0 < self.bag_share <= 4, 'bag_share lies in (0, 4]', self.bag_share),
            *((getattr(self, name) >= 0, f'the weight {name} is not negative',
               getattr(self, name)) for name in BAG_WEIGHTS),
            (self.architecture == 'icra2017' or not self.frozen_weights,
             'only the architecture icra2017 has a frozen encoder to give weights to',
             self.frozen_weights),
            (self.architecture != 'icra2017' or not self.tasks,
             'the architecture icra2017 learns no auxiliary tasks', self.tasks),
            (self.threads >= 1, 'threads is at least 1', self.threads),
            (not self.overlap or self.device == 'cpu',
             'overlap gives simulator and learner a core each: on a GPU they share the device',
             self.device),
            (re.fullmatch(r'cpu|cuda(:\d+)?', self.device),
             'the device is cpu, or a GPU by its number, such as cuda:0', self.device),
        )
        for kept, rule, received in rules:
            if not kept:
                raise UserError(rule, received, 'correct the training configuration')

    @property
    def _frozen(self) -> str:
        return 'given' if self.frozen_weights == GIVEN else 'resnet50' * bool(self.frozen_weights)

    def network(self, actions: tuple[str, ...], size: int,
                moves: tuple[tuple[float, float, float], ...] = (),
                classes: int = CLASSES, *, view: float = 0.0, footprint: float = 0.0
                ) -> NetworkConfig:
        """The network for a robot's actions and a picture size, with the heads of the tasks.

        Args:
            actions: names; size: side of the pictures [pixels].
            moves: what the actions do, see `NetworkConfig.moves`; for `track_goal` alone.
            classes: of the labels that segmentation heads draw.
            view, footprint: of the robot, see `NetworkConfig`; for the architecture search.
        """
        deconvolutions = self.deconvolutions or (1 if size < LARGE_LAYOUT_PX else 2)
        heads = dict.fromkeys((*self.heads, *self.extra_heads))
        return NetworkConfig(
            actions=actions, size=size, architecture=self.architecture, channels=self.channels,
            blocks=self.blocks, features=self.features, hidden=self.hidden,
            frames=self.stacked_frames, heads=tuple(heads), classes=classes,
            deconvolutions=deconvolutions,
            pose_to_memory=self.pose_to_memory, places=self.places,
            moves=moves if self.track_goal else (),
            action_filter='' if self.action_filter else NONE, pixel_mean=self.pixel_mean,
            pixel_std=self.pixel_std, frozen=self._frozen,
            scenes=self.scenes, view=view, footprint=footprint)


_A2C = {
    'optimiser': 'rmsprop', 'learning_rate': 7e-4, 'final_learning_rate': 0.0, 'gamma': 0.99,
    'lam': 1.0, 'clip': None, 'epochs': 1, 'minibatches': 1, 'normalise_advantage': False,
    'value_coefficient': 0.5, 'entropy_coefficient': 0.001, 'final_entropy_coefficient': 0.001,
    'max_gradient_norm': 0.5, 'frames': 40_000_000, 'rollout_length': 20,
    'architecture': 'thesis', 'hidden': 512, 'pixel_mean': 0.0, 'pixel_std': 255.0,
    'curriculum': 'frames', 'start_difficulty': 0.3, 'bf16': False,
    'replay_steps': 32_000, 'replay_batch': 16, 'replay_length': 20, 'pixel_control_gamma': 0.9,
}
_UNREAL = _A2C | {'value_replay': 1.0, 'pixel_control': 0.05, 'reward_prediction': 1.0}
_FAST = {
    'learning_rate': 4e-4, 'final_learning_rate': 4e-5, 'clip': 0.2, 'epochs': 2,
    'minibatches': 4, 'entropy_coefficient': 0.008, 'final_entropy_coefficient': 0.003,
    'frames': 1_600_000, 'rollout_length': 32, 'channels': (16, 32, 64), 'features': 256,
    'hidden': 256, 'goal_pose': 0.5, 'arrival': 0.2, 'distance': 0.1,
    'pose_to_memory': True, 'pair_minutes': 2.0, 'pair_houses': 32,
}
PRESETS: dict[str, dict] = {
    'a2c': _A2C,
    'unreal': _UNREAL,
    'framestack': _UNREAL | {'stacked_frames': 4},
    'icra2017': _A2C | {
        'architecture': 'icra2017', 'stacked_frames': 4, 'rollout_length': 5,
        'entropy_coefficient': 0.01, 'final_entropy_coefficient': 0.01,
        # Theirs is 0.1 under the root, of sums over frames. Ours are means over 16 x 5 frames, and
        # it is added to the root: sqrt(0.1) / 80. With 0.1 the weights stay where they are.
        'rmsprop_epsilon': 0.004, 'max_gradient_norm': 40.0, 'start_difficulty': 1.0,
    },
    'thesis': _UNREAL | {'depth': 0.1, 'segmentation': 0.1, 'goal_segmentation': 0.1},
    'fast': _FAST,
    'anywhere': _FAST | {
        'architecture': 'matching', 'track_goal': True, 'channels': (32, 64, 32), 'blocks': 1,
        'features': 512, 'hidden': 512, 'rollout_length': 64, 'minibatches': 8,
        'imitation': 1.0, 'imitation_until': 0.75, 'teacher_share': 0.8, 'teacher_until': 0.5,
        'start_difficulty': 1.0, 'pair_minutes': 16.0, 'pair_houses': 384, 'frames': 4_200_000,
    },
    SEARCH: {
        'architecture': SEARCH, 'track_goal': True, 'channels': (32, 64, 32), 'blocks': 2,
        'features': 512, 'learning_rate': 8e-4, 'final_learning_rate': 2e-5,
        'max_gradient_norm': 2.0, 'pair_houses': 512, 'frames': 4_000_000,
    },
}
_THESIS_ENVIRONMENT = {'envs': 16, 'max_decisions': 900, 'progress_reward': 0.0,
                       'collision_reward': 0.0}
_FAST_ENVIRONMENT = {'envs': 64, 'max_decisions': 300, 'progress_reward': 1.0,
                     'collision_reward': -0.02}
# What each preset learns in, as options of `vn_nav train`.
ENVIRONMENT: dict[str, dict] = {
    **{name: _THESIS_ENVIRONMENT for name in PRESETS},
    'icra2017': _THESIS_ENVIRONMENT | {'goal_bonus': 9.0, 'step_reward': -0.01},
    'fast': _FAST_ENVIRONMENT,
    'anywhere': _FAST_ENVIRONMENT | {'collision_reward': -0.05},
}


def preset(name: str, /, **changes) -> TrainConfig:
    """The configuration of a preset with some numbers changed.

    Raises:
        UserError: an unknown preset or number, or a value of another kind.
    """
    if name not in PRESETS:
        raise UserError(f'a preset is one of {", ".join(PRESETS)}', name, 'choose one')
    known = typing.get_type_hints(TrainConfig)
    for key in changes:
        if key not in known:
            raise UserError(f'a training has only the numbers {", ".join(known)}', key,
                            'correct the name')
    changes = {key: _value(key, value, known[key]) for key, value in changes.items()}
    return TrainConfig(**{**PRESETS[name], 'preset': name, **changes})


def check_not_search(architecture: str, received: object) -> None:
    """Refuse the networks of search where a policy is to drive or remember while it learns.

    Raises:
        UserError: naming what was received.
    """
    if architecture == SEARCH:
        raise UserError('a policy of the architecture search has no actor and no memory to teach',
                        received, 'train its networks with vn_nav train --preset search')


def _value(name: str, value, kind):
    """A value as its field wants it.

    Raises:
        UserError: a value of another kind.
    """
    options = typing.get_args(kind)
    if type(None) in options:
        if value is None:
            return None
        (kind,) = (option for option in options if option is not type(None))
    if kind in KINDS:
        wanted, fits = KINDS[kind]
        if fits(value):
            return kind(value)
    else:  # a tuple of so many, or of any number
        parts = typing.get_args(kind)
        many = parts[-1] is ...
        wanted, fits = KINDS[parts[0]]
        wanted = f'a list; each of its {"" if many else f"{len(parts)} "}parts is {wanted}'
        if isinstance(value, (tuple, list)) and (many or len(value) == len(parts)) and all(
                map(fits, value)):
            return tuple(value)
    raise UserError(f'{name} is {wanted}', repr(value), f'correct the value of {name}')

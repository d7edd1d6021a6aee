"""Numbers of one update of the learner, and the auxiliary tasks that it may have."""

from __future__ import annotations

import dataclasses

from vn_nav.errors import UserError
from vn_nav.policy.network_config import IMAGE_HEADS

# Tasks whose weight is a field of `LearnerConfig`. The first three learn from the replay memory.
REPLAY_TASKS = ('pixel_control', 'value_replay', 'reward_prediction')
TASKS = (*REPLAY_TASKS, *IMAGE_HEADS, 'goal_pose', 'arrival', 'distance', 'imitation')
HEADLESS = ('value_replay', 'imitation')  # they learn through critic and actor
# Privileged outputs of the environment that a task needs.
PRIVILEGED = {'depth': ('depth',), 'segmentation': ('segmentation',),
              'goal_segmentation': ('goal_segmentation',), 'goal_pose': ('goal_pose', 'overlap'),
              'arrival': ('arrived',), 'distance': ('distance',)}
# Privileged outputs of each teacher; the first is the action by which it drives.
TEACHERS = {'explorer': ('explorer_action',), 'oracle': ('oracle_action',),
            'routes': ('oracle_action', 'oracle_regret')}


@dataclasses.dataclass(frozen=True)
class LearnerConfig:
    """Numbers of one update. A weight of 0 switches an auxiliary task off."""

    optimiser: str = 'adam'  # or 'rmsprop' (alpha 0.99)
    rmsprop_epsilon: float = 1e-5
    learning_rate: float = 4e-4  # at the start
    final_learning_rate: float = 4e-5
    # Updates in which the rate rises to its value. RMSprop begins with squares of 0, so its first
    # step moves every weight by ten times the rate: too much for weights that know something.
    warmup_updates: int = 0
    gamma: float = 0.99  # discount
    lam: float = 0.95  # of the advantage estimator
    clip: float | None = 0.2  # None: no clipping
    epochs: int = 3
    minibatches: int = 8  # by environments: sequences stay whole
    normalise_advantage: bool = True
    truncation_is_terminal: bool = False  # the published code's treatment of time-outs
    value_coefficient: float = 0.5
    entropy_coefficient: float = 0.01  # at the start
    final_entropy_coefficient: float = 0.005
    max_gradient_norm: float = 0.5
    # Weights of the auxiliary tasks (thesis, table 5.1; the last five are ours).
    pixel_control: float = 0.0
    value_replay: float = 0.0
    reward_prediction: float = 0.0
    depth: float = 0.0
    segmentation: float = 0.0
    goal_segmentation: float = 0.0
    reconstruction: float = 0.0
    goal_pose: float = 0.0
    arrival: float = 0.0
    distance: float = 0.0
    imitation: float = 0.0  # at the start
    # Whole episodes are driven by the teacher, so that the policy is shown where it should be: a
    # share of them at the start, falling to none.
    teacher_share: float = 0.0
    teacher_until: float = 0.5  # share of the training at which it has fallen to 0
    imitation_until: float = 0.7  # share of the training at which it has fallen to 0
    # Whom to imitate: one that knows what the robot has seen, or the shortest path, which only a
    # policy that knows the place can follow: its actions, or (routes) what each action
    # loses, where the simulator knows that.
    teacher: str = 'explorer'
    # The replay memory, used by `REPLAY_TASKS`, and by the image heads if `images_from_replay`.
    images_from_replay: bool = True
    replay_steps: int = 32_000  # of all environments together
    replay_batch: int = 16  # sequences that each task draws for an update
    replay_length: int = 20  # steps of a sequence
    pixel_control_gamma: float = 0.9
    pixel_change_grey: bool = True  # thesis; False: the published code's RGB
    unrewarded: float = 1 / 3  # share of reward prediction's samples

    def __post_init__(self):
        positive = ('learning_rate', 'final_learning_rate', 'max_gradient_norm', 'epochs',
                    'minibatches', 'replay_steps', 'replay_batch', 'replay_length',
                    'rmsprop_epsilon', 'imitation_until', 'teacher_until')
        for name in positive:
            value = getattr(self, name)
            if not value > 0 and not (name == 'final_learning_rate' and value == 0):
                raise UserError(f'{name} is positive', value, 'correct it')
        if not self.warmup_updates >= 0:
            raise UserError('warmup_updates is not negative', self.warmup_updates, 'correct it')
        if self.clip is not None and not self.clip > 0:
            raise UserError('clip is positive, or None', self.clip, 'correct it')
        for name in ('gamma', 'lam', 'pixel_control_gamma', 'unrewarded', 'imitation_until',
                     'teacher_share', 'teacher_until'):
            if not 0 <= getattr(self, name) <= 1:
                raise UserError(f'{name} lies in [0, 1]', getattr(self, name), 'correct it')
        for name in TASKS:
            if not getattr(self, name) >= 0:
                raise UserError(f'the weight {name} is not negative', getattr(self, name),
                                'correct it')
        if self.teacher_share and not self.imitation:
            raise UserError('a teacher drives episodes for the task imitation',
                            f'teacher_share {self.teacher_share:g} with imitation 0',
                            'set teacher_share to 0, or give imitation a weight')
        if self.teacher not in TEACHERS:
            raise UserError(f'the teacher is one of {", ".join(TEACHERS)}', self.teacher,
                            'choose one')
        if self.optimiser not in ('adam', 'rmsprop'):
            raise UserError('the optimiser is adam or rmsprop', self.optimiser, 'choose one')

    @property
    def tasks(self) -> tuple[str, ...]:
        """The auxiliary tasks that are on."""
        return tuple(name for name in TASKS if getattr(self, name) > 0)

    @property
    def heads(self) -> tuple[str, ...]:
        """The heads that the network needs for them."""
        return tuple(name for name in self.tasks if name not in HEADLESS)

    @property
    def privileged(self) -> tuple[str, ...]:
        """What batches must hold in addition to the observations."""
        keys = [key for name in self.tasks for key in PRIVILEGED.get(name, ())]
        return tuple(keys) + (TEACHERS[self.teacher] if self.imitation else ())

    @property
    def from_replay(self) -> tuple[str, ...]:
        """The tasks that learn from the replay memory."""
        return tuple(name for name in self.tasks if name in REPLAY_TASKS
                     or (name in IMAGE_HEADS and self.images_from_replay))

"""Everything that fixes a network's shape, and what its parts may be."""

from __future__ import annotations

import dataclasses
import math
import reprlib

from vn_nav.errors import UserError
from vn_nav.labels import CLASSES, MAX_CLASSES
from vn_nav.policy.action_filter import BLOCKED_ACTIONS, FILTERS, NONE
from vn_nav.policy.checkpoint_info import CONFIG, NUMBER, SEARCH

ARCHITECTURES = ('fused', 'matching', 'thesis', 'unreal', 'icra2017', SEARCH)
# Channels that each image head draws, and the width of its inner maps. The thesis says that depth
# has "only" 32, so the segmentation heads are wider.
IMAGE_HEADS = {'depth': (1, 32), 'segmentation': (3, 64), 'goal_segmentation': (3, 64),
               'reconstruction': (3, 32)}
FROZEN = ('', 'resnet50', 'given')  # encoders of icra2017
MAX_SIZE = 65_536  # of a layer, and whatever else a network counts
HEADS = ('pixel_control', 'reward_prediction', *IMAGE_HEADS, 'goal_pose', 'arrival', 'distance')


@dataclasses.dataclass(frozen=True)
class NetworkConfig:
    """Everything that fixes the network's shape; stored in the checkpoint."""

    actions: tuple[str, ...]
    size: int = 84  # pixels a side
    architecture: str = 'fused'  # of ARCHITECTURES, see `vn_nav.policy.encoders` and `zhu`
    channels: tuple[int, int, int] = (32, 64, 32)  # of the fused encoder
    blocks: int = 0  # residual blocks a stage of the fused encoder
    features: int = 256  # of the fused encoder's trunk
    hidden: int = 256  # of the LSTM
    frames: int = 1  # more: pictures stacked as channels, and no LSTM
    heads: tuple[str, ...] = ()  # of HEADS
    # Classes of labels: the colours that segmentation heads learn to draw depend on their number,
    # see `vn_nav.learning.pixel_change.label_colours`.
    classes: int = CLASSES
    deconvolutions: int = 1  # of pixel control and image heads: 84 px give 20 x 20, or 42 x 42
    pose_to_memory: bool = False  # the memory also sees what the head goal_pose says
    # [A,3] dx, dy [m], dyaw [rad] of the actions: with them the memory also sees where the goal
    # stands by dead reckoning since it was seen, see `GoalTracker`. Empty: it does not.
    moves: tuple[tuple[float, float, float], ...] = ()
    # Place cells of the one place that the policy recognises; more than none: the memory also sees
    # where there picture and goal were taken, see `vn_nav.policy.places`.
    places: int = 0
    # Of `vn_nav.policy.action_filter.FILTERS`: what whoever chooses actions by the logits puts in
    # between, no part of the network. '': blocked actions where there are moves, as it was before
    # checkpoints said so; else none.
    action_filter: str = ''
    # Grey levels. Standardised input is what made learning work; whole numbers up to 256 less a
    # whole mean stay exact in bfloat16.
    pixel_mean: float = 120.0
    pixel_std: float = 36.0
    # Of icra2017 alone.
    frozen: str = ''  # encoder, of `FROZEN`
    scenes: int = 1  # that have layers of their own
    # Of search alone: what its map is drawn by. 0: not given.
    view: float = 0.0  # horizontal field of view of the camera [rad]
    footprint: float = 0.0  # radius of the robot [m]

    def __post_init__(self):
        for name in ('actions', 'channels', 'heads'):
            object.__setattr__(self, name, tuple(getattr(self, name)))
        object.__setattr__(self, 'moves', tuple(map(tuple, self.moves)))
        if self.action_filter == self._usual_filter:  # said or not, it is the same
            object.__setattr__(self, 'action_filter', '')
        rules = (
            (len(self.actions) >= 2 and len(set(self.actions)) == len(self.actions),
             'a policy has at least two actions with distinct names', self.actions),
            (isinstance(self.size, int) and 36 <= self.size <= 1024,
             'the network takes pictures of 36 to 1024 pixels a side', self.size),
            (self.architecture in ARCHITECTURES,
             f'the architecture is one of {", ".join(ARCHITECTURES)}', self.architecture),
            (len(self.channels) == 3 and all(count >= 1 for count in self.channels),
             'the network has three convolutions, each with at least one channel', self.channels),
            (self.features >= 1 and self.hidden >= 1,
             'features and hidden are positive', (self.features, self.hidden)),
            (0 <= self.blocks <= 4, 'a stage has 0 to 4 residual blocks', self.blocks),
            (1 <= self.frames <= 8, 'a stack has 1 to 8 frames', self.frames),
            (set(self.heads) <= set(HEADS) and len(set(self.heads)) == len(self.heads),
             f'heads are some of {", ".join(HEADS)}, each once', self.heads),
            (CLASSES <= self.classes <= MAX_CLASSES,
             f'segmentation heads draw {CLASSES} to {MAX_CLASSES} classes', self.classes),
            (self.deconvolutions in (1, 2), 'heads have one or two deconvolutions',
             self.deconvolutions),
            (not self.pose_to_memory or 'goal_pose' in self.heads,
             'pose_to_memory needs the head goal_pose', self.heads),
            (not self.moves or self.architecture == SEARCH
             or (self.pose_to_memory and self.frames == 1),
             'a goal is tracked by a network with pose_to_memory and an LSTM', self.heads),
            (not self.moves or (len(self.moves) == len(self.actions)
                                and all(len(move) == 3 for move in self.moves)),
             'there is a move (dx, dy, dyaw) for each action', self.moves),
            (self.filter_name in FILTERS, f'the action filter is one of {", ".join(FILTERS)}',
             self.action_filter),
            (self.filter_name == NONE or self.moves,
             'an action filter needs the moves of the actions', self.action_filter),
            (self.places == 0 or (2 <= self.places <= 1024 and self.frames == 1
                                  and self.architecture != 'icra2017'),
             'a policy with an LSTM has no place cells, or 2 to 1024', self.places),
            (self.pixel_std > 0, 'the deviation of pixels is positive', self.pixel_std),
            (self.frozen in FROZEN, "the frozen encoder is resnet50, '' for the small random one, "
             'or given: features come with the pictures', self.frozen),
            (self.scenes >= 1, 'there is at least one scene', self.scenes),
            (self.architecture == 'icra2017' or (not self.frozen and self.scenes == 1),
             'a frozen encoder and layers of scenes belong to the architecture icra2017',
             self.architecture),
            (self.architecture != 'icra2017' or not self.heads,
             'the architecture icra2017 has no heads but actor and critic', self.heads),
            (self.architecture != SEARCH or not self.heads,
             'the architecture search has heads of its own alone', self.heads),
            (self.architecture != SEARCH or (self.frames == 1 and not self.places),
             'the architecture search sees one picture at a time and no place cells',
             (self.frames, self.places)),
            (self.architecture != SEARCH or bool(self.moves),
             'the architecture search plans with the moves of its actions', self.moves),
            (self.architecture != SEARCH or self.filter_name == NONE,
             'the architecture search has no action filter: contacts are on its map',
             self.action_filter),
            (self.architecture != SEARCH or self.size >= 40,
             'the architecture search takes pictures of at least 40 pixels a side', self.size),
            (0 < self.view < math.pi if self.architecture == SEARCH else self.view == 0,
             'view, the field of view, lies between 0 and pi for the architecture search, and is '
             'left out for others', self.view),
            (0 < self.footprint <= 10 if self.architecture == SEARCH else self.footprint == 0,
             "footprint, the robot's radius, lies between 0 and 10 m for the architecture search, "
             'and is left out for others', self.footprint),
        )
        for kept, rule, received in rules:
            if not kept:
                raise UserError(rule, received, 'correct the network configuration')

    @property
    def filter_name(self) -> str:
        """The action filter, by its name in `vn_nav.policy.action_filter.FILTERS`."""
        return self.action_filter or self._usual_filter

    @property
    def declares(self) -> bool:
        """Whether the policy says how likely it has arrived, and so can declare its stop."""
        return 'arrival' in self.heads or self.architecture == SEARCH

    @property
    def _usual_filter(self) -> str:
        return BLOCKED_ACTIONS if self.moves and self.architecture != SEARCH else NONE


def read_network(config: dict, where: str) -> NetworkConfig:
    """The network of a `config.json`.

    Args:
        config: all of it; where: its path, for people.

    Raises:
        UserError: unknown fields, or values of a wrong type or size.
    """
    names, given = config['action_names'], config['network']
    if not (isinstance(names, list) and len(names) <= 256
            and all(isinstance(name, str) for name in names)):
        raise UserError('action_names is a list of at most 256 names',
                        f'{where}: {reprlib.repr(names)}', 'get the checkpoint again')
    if not isinstance(given, dict):
        raise UserError(f'the network in {CONFIG} is a mapping', f'{where}: {reprlib.repr(given)}',
                        'get the checkpoint again')
    fields = {field.name: field.default for field in dataclasses.fields(NetworkConfig)
              if field.name != 'actions'}
    for name, value in given.items():
        if name not in fields:
            raise UserError(f'the network in {CONFIG} has only the fields {", ".join(fields)}',
                            f'{where}: {name}', 'use the version of vn_nav that wrote it, or '
                            'train again')
        if not _fits(value, fields[name]):
            raise UserError(f'{name} of the network in {CONFIG} is of the type and '
                            f'size of {fields[name]!r}', f'{where}: {reprlib.repr(value)}',
                            'get the checkpoint again')
    try:
        return NetworkConfig(actions=tuple(names), **given)
    except (TypeError, ValueError, OverflowError) as error:
        raise no_network(where, error) from error


def no_network(where: str, error: Exception) -> UserError:
    """What is said of a configuration that no network can be built from."""
    return UserError(f'the network in {CONFIG} can be built',
                     f'{where}: {" ".join(str(error).split())[:200]}', 'get the checkpoint again')


def _fits(value: object, default: object) -> bool:
    """Whether a value out of JSON has the type of a field of `NetworkConfig`."""
    if isinstance(default, tuple):
        return isinstance(value, list) and all(
            isinstance(part, (str, int)) or (isinstance(part, list) and all(
                _fits(number, 0.0) for number in part)) for part in value)
    if isinstance(default, float):
        return (isinstance(value, NUMBER) and not isinstance(value, bool)
                and math.isfinite(value))
    return type(value) is type(default) and not (type(value) is int and abs(value) > MAX_SIZE)

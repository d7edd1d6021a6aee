"""What `teach` is asked for, and the numbers of its training."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from vn_nav.bags.mapping.recorded_place import PlaceOptions
from vn_nav.errors import UserError
from vn_nav.learning.presets import ENVIRONMENT, TrainConfig, check_not_search, preset
from vn_nav.policy.action_filter import NONE
from vn_nav.policy.checkpoint import LoadedCheckpoint
from vn_nav.policy.network_config import SEARCH
from vn_nav.robot import RobotSpec

PRESET = 'fast'
# The policy shall recognise this place: there the shortest path is something to imitate.
TEACHER = {'imitation': 1.0, 'imitation_until': 1.0, 'teacher': 'routes', 'teacher_share': 0.5,
           'teacher_until': 0.6, 'start_difficulty': 1.0}
# Without a checkpoint much is learned from each rollout.
FROM_NOTHING = {'epochs': 4, 'minibatches': 8, 'learning_rate': 1e-3}
PAIR_SHARE = 0.1  # of learning from nothing, for picture pairs
PLACES = 64  # place cells that the policy distinguishes
DEFAULT_SIZE_PX = 84  # pixels a side of the pictures, by default


@dataclasses.dataclass(frozen=True)
class TeachJob:
    """The drive that a policy learns the place of, and how.

    Raises:
        UserError: numbers outside their range.
    """

    bag: str | Path  # rosbag2 folder or MCAP file
    out: str | Path  # folder of the run
    checkpoint: str | Path | None = None  # policy to begin with; None: from nothing
    minutes: float = 10.0  # that all of it takes: reading the bag, learning, evaluation
    robot: RobotSpec = RobotSpec()  # that drove, with its camera
    options: PlaceOptions = PlaceOptions()  # how the drive becomes a place
    places: int = PLACES  # place cells that the policy distinguishes; 0: none
    episodes: int = 50  # of each row of the evaluation, at most
    size: int | None = None  # without a checkpoint: side of the pictures [pixels]; None: 84
    envs: int = ENVIRONMENT[PRESET]['envs']  # robots that learn at a time
    # Other numbers of `TrainConfig`, by name.
    changes: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    cache: str | Path | None = None  # folder of decoded bags; None: `decoded` in that of the run
    resume: bool = False  # go on with the run in `out`
    seed: int = 0
    threads: int = 1  # of torch
    command: str = ''  # that the checkpoint shall name

    def __post_init__(self):
        object.__setattr__(self, 'bag', Path(self.bag))
        object.__setattr__(self, 'out', Path(self.out))
        rules = (
            (self.minutes > 0, 'there is some time to learn', self.minutes, 'raise --minutes'),
            (self.episodes >= 1, 'there is at least one episode', self.episodes,
             'raise --episodes'),
            (self.places == 0 or 2 <= self.places <= 1024,
             'there are 2 to 1024 place cells, or none', self.places, 'correct --places'),
            (self.envs >= 1, 'there is at least one robot', self.envs, 'raise --envs'),
            (self.size is None or self.checkpoint is None, 'the size is that of the checkpoint',
             self.size, 'leave out --size'),
        )
        for kept, rule, received, remedy in rules:
            if not kept:
                raise UserError(rule, received, remedy)


def numbers(job: TeachJob, given: LoadedCheckpoint | None, minutes: float,
            learned: float) -> TrainConfig:
    """The preset's numbers, for the network of a checkpoint if there is one.

    Args:
        job: what is taught.
        given: the checkpoint that it begins with.
        minutes: of reinforcement, picture pairs included.
        learned: minutes of all that is learning.

    Raises:
        UserError: numbers or a checkpoint that do not fit.
    """
    minutes = max(minutes, 1e-3)
    own = {'frames': 10**9, 'minutes': minutes, 'places': job.places, **TEACHER}
    if given is None:
        own |= FROM_NOTHING | {'pair_minutes': min(PAIR_SHARE * max(learned, 0.0) + 1e-4,
                                                   minutes / 3)}
    else:
        network = given.config
        if network.architecture == 'icra2017':
            raise UserError('an encoder that learns is taught', f'{job.checkpoint}, whose '
                            'encoder is frozen', 'choose another --checkpoint')
        own |= {'pair_minutes': 0.0, 'stacked_frames': network.frames,
                'track_goal': bool(network.moves),
                'action_filter': network.filter_name != NONE or not network.moves,
                **{name: getattr(network, name) for name in (
                    'architecture', 'channels', 'blocks', 'features', 'hidden', 'deconvolutions',
                    'pose_to_memory', 'pixel_mean', 'pixel_std')}}
    config = preset(PRESET, **{'seed': job.seed, 'threads': job.threads, **own, **job.changes})
    check_not_search(config.architecture, f'--set architecture={SEARCH}')
    return config

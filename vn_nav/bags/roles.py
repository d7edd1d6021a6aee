"""Which topics of a bag are its camera, its odometry and so on: by name and by type.

One check for every command: a topic that has a role and another type is refused by name, with
what to do, before anything is decoded.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path

import yaml

from vn_nav.errors import UserError

IMAGE, COMPRESSED = 'sensor_msgs/msg/Image', 'sensor_msgs/msg/CompressedImage'
ODOMETRY, CAMERA_INFO = 'nav_msgs/msg/Odometry', 'sensor_msgs/msg/CameraInfo'
TYPES = {  # of each role of `Topics`
    'image': (IMAGE, COMPRESSED), 'odometry': (ODOMETRY,),
    'command': ('geometry_msgs/msg/Twist', 'geometry_msgs/msg/TwistStamped'),
    'goal': (IMAGE, COMPRESSED), 'depth': (IMAGE,), 'labels': (IMAGE,),
    'episode_end': ('std_msgs/msg/UInt8',), 'camera_info': (CAMERA_INFO,),
    'goal_camera_info': (CAMERA_INFO,),
    'scan': ('sensor_msgs/msg/LaserScan',)}
MAX_PROPOSED_TOPICS = 4  # topics that are proposed, at most


@dataclasses.dataclass(frozen=True)
class Topics:
    """Names in the bag, with or without the leading slash; a small YAML file can give others.

    An empty name: the bag has none.
    """

    image: str = 'image_raw'
    odometry: str = 'odom'
    command: str = 'cmd_vel'  # stands in where odometry is not recorded
    goal: str = 'goal_image'
    depth: str = 'depth/image_raw'
    labels: str = 'labels/image_raw'
    episode_end: str = 'episode_end'
    camera_info: str = 'camera_info'
    goal_camera_info: str = 'goal_camera_info'  # of goals that another camera took
    scan: str = ''  # for a policy's map, where it is asked for; training reads none

    def within(self, recorded: Mapping[str, str]) -> Topics:
        """The same with the names as they are in a bag: slashes as there, pictures compressed.

        Args:
            recorded: types of the topics that have messages, by name.

        Raises:
            UserError: no camera picture, neither odometry nor command, or a topic that has
                another type than its role.
        """
        there = {name.strip('/'): name for name in recorded}
        found = {}
        for role, name in dataclasses.asdict(self).items():
            name = name.strip('/')
            if role in ('image', 'goal') and name not in there:
                name = f'{name}/compressed'
            found[role] = there.get(name, '')
        free = {name: kind for name, kind in recorded.items() if name not in found.values()}
        kinds = {role: recorded[name] for role, name in found.items() if name}
        for role, kind in kinds.items():
            if not fits(role, kind):
                raise UserError(fault(role), f'{found[role]}: {kind or "no type"}',
                                remedy(role, free, replaced(role, kinds)))
        if not found['image'] or not (found['odometry'] or found['command']):
            role = 'image' if not found['image'] else 'odometry or command'
            first = role.split()[0]
            raise UserError(f'a bag for learning holds the topic {getattr(self, first)} ({role})',
                            sorted(there), remedy(first, free))
        return Topics(**found)


def load_topics(path: str | Path) -> Topics:
    """Read a mapping from the roles of `Topics` to names in the bag; null: the bag has none.

    Raises:
        UserError: no such file, no such role, or a name that is none.
    """
    try:
        data = yaml.safe_load(Path(path).read_text())
    except (OSError, ValueError, yaml.YAMLError) as error:
        raise UserError('the topics of a bag are in a YAML file', f'{path}: {error}',
                        'write lines such as image: /camera/color/image_raw') from error
    known = [field.name for field in dataclasses.fields(Topics)]
    if not isinstance(data, dict) or not set(data) <= set(known) or not all(
            name is None or isinstance(name, str) and name.strip('/') for name in data.values()):
        raise UserError(f'a topics file maps some of {", ".join(known)} to names', data,
                        f'correct {path}')
    return Topics(**{role: name or '' for role, name in data.items()})


def full_name(kind: str) -> str:
    """A type's name as ROS 2 writes it; others leave out msg: nav_msgs/Odometry."""
    package, _, name = kind.partition('/')
    return f'{package}/msg/{name}' if name and '/' not in name else kind


def fits(role: str, kind: str) -> bool:
    """Whether a topic of a type can have a role; `kind` as `stream.Topic` has it."""
    kinds = {full_name(part) for part in kind.split(' and ')}
    return len(kinds) == 1 and kinds <= set(TYPES[role])


def fault(role: str) -> str:
    """The rule that a topic of another type breaks."""
    return f'the {role} of a bag is {" or ".join(TYPES[role])}'


def proposal(role: str, recorded: Mapping[str, str]) -> str:
    """To name a topic that could have a role; empty: there is none.

    Args:
        role: of `Topics`.
        recorded: types of the topics that could have it, by name.
    """
    others = sorted(name for name, kind in recorded.items() if fits(role, kind))
    return (f'name one of {", ".join(others[:MAX_PROPOSED_TOPICS])} in a YAML file '
            f'({role}: {others[0]}) and give it with --topics' if others else '')


def replaced(role: str, kinds: Mapping[str, str]) -> bool:
    """Whether odometry or commands are there in each other's place.

    Args:
        role: of `Topics`.
        kinds: types of the topics that are there, by their roles.
    """
    other = {'odometry': 'command', 'command': 'odometry'}.get(role)
    return other is not None and other in kinds and fits(other, kinds[other])


def remedy(role: str, recorded: Mapping[str, str], stand_in: bool = False) -> str:
    """What to do where a role has no topic, or one of another type; see `proposal`.

    Args:
        role: of `Topics`.
        recorded: types of the topics that could have it, by name.
        stand_in: another topic is there in its place, see `replaced`.
    """
    proposed = proposal(role, recorded)
    if role in ('image', 'odometry', 'command') and not stand_in:
        return proposed or (f'name the topic of the bag in a YAML file ({role}: /its/name) and '
                            'give it with --topics, or record it')
    leave = f'`{role}: null` to ' + ('leave it out' if role != 'odometry' else (
        'have the poses are integrated from commands and drift (teach needs odometry)'))
    return f'{proposed}, or {leave}' if proposed else (
        f'in a YAML file that you give with --topics, write {leave}')

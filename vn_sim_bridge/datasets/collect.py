"""Pictures from random poses as a bag: the pre-computed set of observations (thesis, 4.4).

Without ROS, and through the protocol of simulators (`simulator`). Poses are not spread evenly:
they come in groups about one place, as `PairSampler` puts them, so that any two pictures of a
group are a pair to learn from. A group is an episode of the bag, or several where it lies apart.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import math
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, NamedTuple, Protocol

import numpy as np
from rosbags.typesys import Stores, get_typestore

from vn_msgs_py.camera import intrinsics
from vn_msgs_py.images import label_encoding
from vn_msgs_py.motion import yaw_to_quaternion
from vn_msgs_py.topics import Topic, topic
from vn_nav.errors import UserError
from vn_nav.robot import RobotSpec
from vn_nav.scenes import parse_scene
from vn_sim_bridge.counter_random import Stream, key
from vn_sim_bridge.datasets.view_pairs import PairSampler
from vn_sim_bridge.floor.places import with_rooms
from vn_sim_bridge.navigation import tasks
from vn_sim_bridge.render.randomisation import Randomisation
from vn_sim_bridge.simulator import Frames, Simulator

VIEWS = 8  # pictures of a group
GROUPS = 8  # that are drawn at a time
# A reader of drives begins another episode where pictures lie more than a second apart, or where
# the pose jumps: faster than 5 m/s, beyond 0.3 m (`vn_nav.bags.drive`). Groups stay below both.
PERIOD_NS = 900_000_000  # between pictures
REACH = 4.5  # m between one picture and the next
BEGIN_NS = 1_000_000_000  # stamp of the first picture: zero would mean "no time yet"
COLLECTED = 2  # tells these pictures' random numbers from those of `PairSampler`, 0 and 1
CUT_OFF = 2  # in `episode_end`: nobody arrived
OPTICAL_FRAME = 'camera_optical_frame'


class Scene(Protocol):
    """A place to take pictures in; `RandomViews` is that of a simulator's scenes."""

    facts: dict  # for the topic `scene`, JSON

    @property
    def label_names(self) -> Sequence[str]:
        """Behind the class ids."""

    @property
    def simulator(self) -> Simulator:
        """That draws the pictures."""

    def look(self, number: int, groups: int) -> tuple[np.ndarray, Frames]:
        """Poses [groups * VIEWS,4] of the groups from a number on, and what is seen there."""


class Writer(Protocol):
    """A bag being written, as `vn_nav.bags.storage.writer.BagWriter`; a context manager."""

    def write(self, name: str, data: bytes, stamp: int) -> None:
        """Append a message; the stamp is in ns since 1970."""


class RandomViews:
    """Pictures of one scene of a simulator from random poses.

    Light, camera and noise are drawn anew for each picture, as a goal picture differs from what
    the robot sees of its place.

    Args:
        scene: its name.
        size: side of the pictures [pixels].
        robot: footprint and camera.
        randomisation: of light and camera.
        draws: seed of poses and light.
        threads: threads that draw.

    Raises:
        UserError: no such scene, or a simulator that cannot look from anywhere.
    """

    def __init__(self, scene: str, size: int, robot: RobotSpec,
                 randomisation: Randomisation, draws: int = 0, threads: int = 1):
        self._sampler = PairSampler((scene,), size=size, robot=robot, seed=draws,
                                    randomisation=randomisation, threads=threads)
        self._draws = draws
        self.simulator, (place,) = self._sampler.simulator, self._sampler.places
        can = self.simulator.capabilities
        self.label_names = self.simulator.label_names if can.labels else ()
        self.facts = {
            'simulator': parse_scene(scene).simulator, 'world_version': self.simulator.version,
            **({'rooms': len(with_rooms(place).rooms)} if can.rooms else {}),
            **(place.plan() or {'scene': place.name}),
            'arrival': {'radius': tasks.ARRIVAL_RADIUS,
                        'heading_deg': math.degrees(tasks.ARRIVAL_HEADING)},
            'camera_fov_deg': math.degrees(robot.camera_fov)}

    def look(self, number: int, groups: int) -> tuple[np.ndarray, Frames]:
        """See `Scene`."""
        around = VIEWS - 1
        numbers = np.arange(number * around, (number + groups) * around)
        _, poses, places = self._sampler.poses(numbers, around)
        poses = np.concatenate([places[::around, None], poses.reshape(groups, around, 4)], 1)
        poses = poses.reshape(-1, 4)
        views = number * VIEWS + np.arange(groups * VIEWS)
        looks = self.simulator.appearance(self._draws, Stream.PAIR_APPEARANCE, views, COLLECTED)
        return poses, self.simulator.view(
            np.zeros(len(poses), np.int64), poses, None, looks,
            key(self._draws, Stream.PAIR_SENSOR, views, COLLECTED))

    def close(self) -> None:
        """Let go of the simulator."""
        self.simulator.close()


def random_views(scenes: Iterable[str], size: int, robot: RobotSpec, randomisation: Randomisation,
                 seed: int, threads: int) -> Iterator[RandomViews]:
    """What is seen in some scenes, by their names, made and closed one at a time.

    Raises:
        UserError: a scene that there is not.
    """
    for scene in scenes:
        with contextlib.closing(RandomViews(scene, size, robot, randomisation, seed,
                                            threads)) as views:
            yield views


class Collected(NamedTuple):
    """What a collection wrote."""

    pictures: int
    episodes: int
    scenes: int


def collect(scenes: Iterable[Scene], count: int, pictures: int, robot: RobotSpec,
            open_bag: Callable[[Sequence[Topic]], Any]) -> Collected:
    """Write a bag of pictures from random poses.

    Args:
        scenes: so many as `count`.
        count: of the scenes; each gives an equal share of the pictures.
        pictures: in all.
        robot: its camera, for camera_info. That is the calibration of the robot's camera: what a
            randomisation changes of a camera, a robot does not know either.
        open_bag: makes the `Writer` of some topics, once the first scene stands.

    Returns:
        What was written.

    Raises:
        UserError: no scene, or fewer pictures than two a scene.
    """
    if count < 1 or pictures < 2 * count:
        raise UserError('a collection has at least one scene, and two pictures of each',
                        f'{pictures} pictures of {count} scenes', 'collect more pictures')
    scenes = iter(scenes)
    first = next(scenes)
    can = first.simulator.capabilities
    names = ['image_raw', 'camera_info', 'odom', 'episode_end', 'scene',
             *['depth/image_raw'] * can.depth, *['labels/image_raw', 'labels/names'] * can.labels]
    with open_bag([topic(name) for name in names]) as writer:
        bag = _Bag(writer, robot, names)
        number = 0  # of the next group
        for index, scene in enumerate(itertools.chain([first], scenes)):
            own = pictures // count + (index < pictures % count)
            bag.begin(scene)
            while own > 0:
                groups = min(GROUPS, -(-own // VIEWS))
                poses, frames = scene.look(number, groups)
                for k in range(groups):
                    views = k * VIEWS + np.arange(min(VIEWS, own))
                    bag.write_group(poses, frames, views)
                    own -= len(views)
                number += groups
    return Collected(bag.pictures, bag.episodes, count)


def legs(places: np.ndarray) -> list[list[int]]:
    """An order of places [V,2] in which each is the nearest to the one before, from the first on.

    Cut where the next one would be out of `REACH`.
    """
    left = list(range(1, len(places)))
    found = [[0]]
    while left:
        gaps = np.hypot(*(places[left] - places[found[-1][-1]]).T)
        nearest = int(np.argmin(gaps))
        if gaps[nearest] > REACH:
            found.append([])
        found[-1].append(left.pop(nearest))
    return found


class _Bag:
    """The messages of a collection."""

    def __init__(self, writer: Writer, robot: RobotSpec, names: Sequence[str]):
        self._writer, self._robot, self._names = writer, robot, set(names)
        self._store = get_typestore(Stores.ROS2_JAZZY)
        self._header: dict[str, Any] = {}  # of the present picture
        self._now = BEGIN_NS  # stamp of the next picture
        self.pictures = self.episodes = 0

    def begin(self, scene: Scene) -> None:
        """Say what is seen from now on."""
        if 'labels/names' in self._names:
            self._write('labels/names', data=json.dumps(list(scene.label_names)))
        # Readers take such a bag for pictures and poses alone, not for a drive.
        self._write('scene', data=json.dumps({**scene.facts, 'poses': 'random'}))

    def write_group(self, poses: np.ndarray, frames: Frames, views: np.ndarray) -> None:
        """Write some rows of poses and frames, an episode for each of their `legs`."""
        for leg in legs(poses[views, :2]):
            for view in views[leg]:
                self._write_picture(poses[view], Frames(*(part[view] for part in frames)))
            # Between two pictures, so that any order of equal stamps will do.
            self._write('episode_end', self._now - PERIOD_NS // 2, data=CUT_OFF)
            self.episodes += 1

    def _write_picture(self, pose: np.ndarray, seen: Frames) -> None:
        """The picture last: who reads on has then seen what belongs to it."""
        sec, nanosec = divmod(self._now, 1_000_000_000)
        self._header = {'stamp': self._make('builtin_interfaces/msg/Time', sec=sec,
                                            nanosec=nanosec)}
        self._write_odometry(*pose[:3])
        if 'depth/image_raw' in self._names:
            self._write_image('depth/image_raw', seen.depth, '32FC1')
        if 'labels/image_raw' in self._names:
            self._write_image('labels/image_raw', seen.labels,
                              label_encoding(seen.labels))
        rgb = seen.rgb.transpose(1, 2, 0)
        self._write_camera_info(*rgb.shape[:2])
        self._write_image('image_raw', rgb, 'rgb8')
        self._now += PERIOD_NS
        self.pictures += 1

    def _write_image(self, name: str, picture: np.ndarray, encoding: str) -> None:
        height, width = picture.shape[:2]
        data = np.ascontiguousarray(picture).view(np.uint8).reshape(-1)
        self._write(name, header=self._stamped(OPTICAL_FRAME), height=height, width=width,
                    encoding=encoding, is_bigendian=int(sys.byteorder == 'big'),
                    step=len(data) // height, data=data)

    def _write_camera_info(self, height: int, width: int) -> None:
        k, p = intrinsics(width, height, self._robot.camera_fov)
        self._write(
            'camera_info', header=self._stamped(OPTICAL_FRAME), height=height, width=width,
            distortion_model='plumb_bob', d=np.zeros(5),
            k=np.array(k), r=np.eye(3).reshape(-1), p=np.array(p), binning_x=0, binning_y=0,
            roi=self._make('sensor_msgs/msg/RegionOfInterest', x_offset=0, y_offset=0, height=0,
                           width=0, do_rectify=False))

    def _write_odometry(self, x: float, y: float, yaw: float) -> None:
        make, geometry = self._make, 'geometry_msgs/msg/'
        turned = dict(zip('xyzw', yaw_to_quaternion(float(yaw)), strict=True))
        still = make(geometry + 'Vector3', x=0.0, y=0.0, z=0.0)
        pose = make(geometry + 'Pose',
                    position=make(geometry + 'Point', x=float(x), y=float(y), z=0.0),
                    orientation=make(geometry + 'Quaternion', **turned))
        self._write('odom', header=self._stamped('odom'), child_frame_id='base_link',
                    pose=make(geometry + 'PoseWithCovariance', pose=pose,
                              covariance=np.zeros(36)),
                    twist=make(geometry + 'TwistWithCovariance',
                               twist=make(geometry + 'Twist', linear=still, angular=still),
                               covariance=np.zeros(36)))

    def _stamped(self, frame: str) -> Any:
        return self._make('std_msgs/msg/Header', frame_id=frame, **self._header)

    def _make(self, kind: str, **fields: Any) -> Any:
        return self._store.types[kind](**fields)

    def _write(self, name: str, stamp: int | None = None, /, **fields: Any) -> None:
        kind = topic(name).type
        data = self._store.serialize_cdr(self._make(kind, **fields), kind)
        self._writer.write(name, bytes(data), self._now if stamp is None else stamp)

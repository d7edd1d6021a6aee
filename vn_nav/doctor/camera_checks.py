"""Checks of the camera against the policy and the robot's file."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator
from pathlib import Path

from vn_msgs_py.camera import field_of_view
from vn_nav.doctor.seen import ERROR, OK, WARNING, Finding, Graph, Lens
from vn_nav.errors import UserError
from vn_nav.observation import SAME_LENS, check_lens, crop_fraction, fov_across, needed_side
from vn_nav.policy.checkpoint_info import SEARCH, read_config
from vn_nav.robot import RobotSpec

CHECK = 'camera'
SAME_HEIGHT_M = 0.15  # camera heights that differ by less are one


@dataclasses.dataclass(frozen=True)
class Policy:
    """What a checkpoint asks of camera and robot."""

    folder: str
    fov: float  # of the square picture [rad]
    camera_height: float  # m
    size: int  # side of the square picture [pixels]
    searches: bool  # it takes narrower cameras too, see `vn_nav.observation.through_lens`
    actions: tuple[str, ...]
    moves: tuple[tuple[float, float, float], ...]

    @classmethod
    def read(cls, folder: Path) -> Policy:
        """Of a checkpoint.

        Raises:
            UserError: it cannot be read.
        """
        whole, info = read_config(folder)
        network = whole['network']
        return cls(str(folder), math.radians(info['camera_fov_deg']), info['camera_height'],
                   network['size'], network.get('architecture') == SEARCH,
                   tuple(whole['action_names']), tuple(map(tuple, network.get('moves', ()))))


def camera(graph: Graph, policy: Policy | None, robot: RobotSpec | None) -> Iterator[Finding]:
    """The field of view that camera_info says, and what becomes of a picture."""
    if policy is not None:
        yield from _robot(policy, robot or RobotSpec())
    seen, lens = graph.topics.get('camera_info'), graph.lens
    if lens is None or seen is None:
        return  # `vn_nav.doctor.topic_checks.missing` says so
    if not (lens.width > 0 and lens.height > 0 and math.isfinite(lens.focal) and lens.focal > 0):
        yield Finding(CHECK, WARNING, seen.name, f'says a focal length of {lens.focal:g} pixels '
                      f'at {lens.width} x {lens.height}: the camera is not calibrated, and its '
                      'pictures are not cropped',
                      'ros2 run camera_calibration cameracalibrator --ros-args -r '
                      'image:=/camera/image_raw')
        return
    yield from _size(graph, lens, seen.name)
    fov = field_of_view(lens.width, lens.height, lens.focal)
    shown = (f'{lens.width} x {lens.height}, {math.degrees(fov):.0f} deg on the shorter side, '
             f'{math.degrees(fov_across(fov, lens.width / lens.height)):.0f} deg across')
    if robot is not None and _differ(fov, robot.camera_fov):
        yield Finding(CHECK, WARNING, seen.name, f'{shown}; the file of robot {robot.name} says '
                      f'{math.degrees(robot.camera_fov):.0f} deg',
                      f'camera_fov_deg: {math.degrees(fov):.1f} in that file')
    if policy is None:
        yield Finding(CHECK, OK, seen.name, shown, 'give --checkpoint DIR to compare it with')
        return
    try:
        yield _against(policy, lens, fov, shown, seen.name)
    except UserError as error:
        yield Finding(CHECK, ERROR, seen.name, f'{shown}: {error.rule}', error.remedy)


def _against(policy: Policy, lens: Lens, fov: float, shown: str, name: str) -> Finding:
    """What `preprocess` or `through_lens` make of a picture.

    Raises:
        UserError: they refuse this camera.
    """
    known = f'{policy.folder} was trained with {math.degrees(policy.fov):.0f} deg'
    side = min(lens.width, lens.height)
    if policy.searches:
        across = fov_across(fov, lens.width / lens.height)
        check_lens(across)
        share = math.tan(policy.fov / 2) / math.tan(across / 2)
        used = lens.width if share > SAME_LENS else round(lens.width * min(share, 1.0))
        what = f'a square of {used} pixels is used'
        if share > SAME_LENS:
            what += f' and taken as magnified {share:.2f} times'
        if used > lens.height:
            what += f', grey in {used - lens.height} rows beyond the picture'
    else:
        used = round(side * crop_fraction(fov, policy.fov))
        what = f'the middle {used} x {used} pixels are used'
    needed = policy.size if policy.searches else needed_side(policy.size, fov, policy.fov)
    if (used if policy.searches else side) < needed:
        return Finding(CHECK, WARNING, name, f'{shown}; {known}: {what}, and enlarged to '
                       f'{policy.size}', 'set the camera to a larger picture')
    return Finding(CHECK, OK, name, f'{shown}; {known}: {what}')


def _robot(policy: Policy, robot: RobotSpec) -> Iterator[Finding]:
    try:
        robot.with_actions(policy.actions, policy.moves)
    except UserError as error:
        yield Finding('robot', ERROR, '', f'{error.rule}; {error.received}', error.remedy)
    if abs(robot.camera_height - policy.camera_height) > SAME_HEIGHT_M:
        yield Finding(CHECK, WARNING, '', f'the camera of robot {robot.name} is '
                      f'{robot.camera_height:g} m above the floor; {policy.folder} was trained at '
                      f'{policy.camera_height:g} m', 'vn_nav train --robot with that file, or '
                      'vn_nav teach with a drive of this robot')


def _size(graph: Graph, lens: Lens, name: str) -> Iterator[Finding]:
    """Is camera_info of the pictures that come?"""
    image = graph.pictures
    if image is None or image.stream is None or len(image.stream.pictures) != 1:
        return
    if not image.stream.pictures[0].endswith(f' {lens.width} x {lens.height}'):
        beside = image.name.removesuffix('/compressed').rpartition('/')[0]
        yield Finding(CHECK, WARNING, name, f'is of {lens.width} x {lens.height} pixels, and '
                      f'{image.name} is {image.stream.pictures[0]}',
                      f'policy_node --ros-args -r camera_info:={beside}/camera_info, '
                      'the one beside the pictures')


def _differ(a: float, b: float) -> bool:
    ratio = math.tan(a / 2) / math.tan(b / 2)
    return not 1 / SAME_LENS <= ratio <= SAME_LENS

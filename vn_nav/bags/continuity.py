"""Where the odometry of a bag breaks off: stretches of a drive that it does not connect.

REP 105 has a base's odometry go on without jumps in one frame. Where it jumps as no robot drives,
changes its frame, starts again, or was silent while the robot may have been carried, nothing is
known of how the poses before lie to those after it.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import NamedTuple

import numpy as np

from vn_msgs_py.motion import MotionError, odometry_to_array
from vn_nav.arrival import wrap_angle
from vn_nav.bags.drive import ODOMETRY_JUMP_M, ODOMETRY_JUMP_M_PER_S
from vn_nav.bags.stamped import PAIRING_TIMEOUT_S, set_back
from vn_nav.bags.storage.stream import messages

# Like ODOMETRY_JUMP_M and ODOMETRY_JUMP_M_PER_S, for turns: the largest correction at once, and
# more than the turn rate of any robot.
TURN_JUMP_RAD, TURN_SPEED_RAD_PER_S = math.radians(45), 2 * math.pi  # rad, rad/s
# After so long without odometry the robot may have been carried, or its odometry restarted, ...
ODOMETRY_GAP_S = 10.0
STANDSTILL_M_RAD = (0.05, math.radians(3))  # m, rad: ... unless its pose is the same


class Break(NamedTuple):
    """Two messages of odometry in a row that do not go together."""

    before: float  # s, stamp of the first
    after: float  # s, stamp of the second
    reason: str
    back: bool = False  # the clock was set back in between


class Stretches(NamedTuple):
    """The pictures of a drive, N of them, in stretches that odometry connects."""

    number: np.ndarray  # [N] int64, 0 and up
    sound: np.ndarray  # [N] bool; False: taken within a break, where no pose is known
    reasons: list[str]  # why each of them begins, '' for the first


def find_breaks(bag: str | Path, topic: str) -> list[Break]:
    """The breaks of the odometry on a topic of a bag, in the order of recording."""
    found, last, frame = [], None, ''
    for message in messages(bag, (topic,), clocks=(topic,)):
        try:
            values = odometry_to_array(message.message)
        except MotionError:
            continue
        stamp, name = values[6] or message.time, message.message.header.frame_id.strip('/')
        if last is not None:
            back = set_back(stamp, last[3])
            if stamp <= last[3] and not back and name == frame:
                continue  # late or repeated
            reason = _reason(last, np.append(values[:3], stamp), frame, name)
            if reason:
                found.append(Break(last[3], stamp, reason, back))
        last, frame = np.append(values[:3], stamp), name
    return found


def divide(stamps: np.ndarray, breaks: list[Break], odometry: bool = True) -> Stretches:
    """Put pictures into the stretches between breaks.

    Args:
        stamps: [N] s, of the pictures in the order of recording.
        breaks: of the odometry.
        odometry: whether there is any; commands alone do not show what happened in a silence.
    """
    ends = np.cumsum([0, *(b.back for b in breaks)])[1:]  # run of the clock that each break is in
    run = np.append(0, np.cumsum(np.diff(stamps) <= -PAIRING_TIMEOUT_S))
    number, sound = np.zeros(len(stamps), np.int64), np.ones(len(stamps), bool)
    reasons = {0: ''}
    for k, cut in enumerate(breaks):
        # One that sets the clock back is where its run begins.
        here = run == min(ends[k], run[-1])
        if cut.back:
            begins = here | (run > ends[k])
        else:
            begins = (here & (stamps >= cut.after)) | (run > ends[k])
            sound &= ~(here & (stamps > cut.before) & (stamps < cut.after))
        number += begins
        reasons[k + 1] = cut.reason
    for k in np.flatnonzero(np.diff(run) if odometry else
                            (np.diff(run) != 0) | (np.diff(stamps) > ODOMETRY_GAP_S)).tolist():
        if number[k] == number[k + 1]:
            reasons = {n + (n > number[k]): why for n, why in reasons.items()}
            reasons[number[k] + 1] = ('the stamps of pictures go back' if run[k] != run[k + 1] else
                                      f'silent for {stamps[k + 1] - stamps[k]:.0f} s')
            number[k + 1:] += 1
    held, number = np.unique(number, return_inverse=True)  # those that have pictures
    return Stretches(number, sound, [reasons[n] if n else '' for n in held.tolist()])


def _reason(last: np.ndarray, now: np.ndarray, frame: str, name: str) -> str:
    """Why two poses with stamps [4] do not go together; '': they do."""
    if name != frame:
        return f'the frame of odometry changes from {frame!r} to {name!r}'
    seconds = now[3] - last[3]
    moved = math.hypot(*(now[:2] - last[:2]))
    turned = abs(wrap_angle(now[2] - last[2]))
    if -seconds >= PAIRING_TIMEOUT_S:
        return f'the clock of odometry goes back by {-seconds:.1f} s'
    if moved > ODOMETRY_JUMP_M + ODOMETRY_JUMP_M_PER_S * seconds:
        return f'odometry jumps by {moved:.1f} m in {seconds:.2f} s'
    if turned > TURN_JUMP_RAD + TURN_SPEED_RAD_PER_S * seconds:
        return f'odometry turns by {math.degrees(turned):.0f} deg in {seconds:.2f} s'
    if seconds > ODOMETRY_GAP_S and (moved > STANDSTILL_M_RAD[0] or turned > STANDSTILL_M_RAD[1]):
        return f'odometry is silent for {seconds:.0f} s and then {moved:.1f} m away'
    return ''

"""The state machine that drives one robot: when to look, when to move, when to stand still.

No torch, no ROS: `policy_node` feeds it frames, goals, odometry and decisions, and asks it for the
next velocity. Times called `now` are seconds of a steady clock; stamps are the messages'.

States:
    idle      not enabled: silent.
    running   enabled: looks, decides, moves.
    hold      enabled, zero velocity until the cause is gone by itself.
    arrived   enabled, zero velocity: the policy has declared that it is there; until another goal
              comes, or `enable`.
    failed    enabled, zero velocity: the goal was given up (see `goal_record`); likewise.
    stopped   latched: zero for a second, then silent, until `reset` and `enable`.
"""

from __future__ import annotations

import dataclasses
import enum
import math

import numpy as np

from vn_nav.arrival import wrap_angle
from vn_nav.policy.frame_gate import FrameGate, shorten
from vn_nav.policy.goal_record import ENDED, Code, GoalLimits, GoalRecord, Status
from vn_nav.policy.motion import ActionExecutor, cruise, ramp
from vn_nav.robot import RobotSpec

STOP_SECONDS = 1.0  # how long a stop repeats its zero before it falls silent
RESET_FIRST = 'call ~/reset first'  # in the refusal to enable what was stopped
ARMING_SECONDS = 1.0  # of healthy frames before `enable` is granted


class State(enum.Enum):
    """See the module's docstring."""

    IDLE = 'idle'
    RUNNING = 'running'
    HOLD = 'hold'
    ARRIVED = 'arrived'
    FAILED = 'failed'
    STOPPED = 'stopped'


ENABLED = (State.RUNNING, State.HOLD, State.ARRIVED, State.FAILED)
AT_THE_END = (State.ARRIVED, State.FAILED)
# Faster by odometry, a base still rolls; some that stand jitter, and are not waited for.
ROLLS_M_PER_S, ROLLS_RAD_PER_S, LONGEST_ROLL_S = 0.02, 0.03, 2.0


class Phase(enum.Enum):
    """Within `running`, stop and go."""

    LOOK = 'look'  # at rest, waiting for a frame and its decision
    MOVE = 'move'


@dataclasses.dataclass(frozen=True)
class Limits:
    """Times after which the robot stands still [s]."""

    frame_timeout: float = 0.25  # camera silence: zero
    frame_stop_timeout: float = 1.0  # camera silence: latched stop
    max_frame_age: float = 0.25
    max_frame_ahead: float = 0.05
    inference_timeout: float = 0.1
    odometry_timeout: float = 0.5  # odometry silence: zero; in motion a latched stop
    settle_time: float = 0.1  # after a motion, before a frame shows the robot at rest


class Navigator:
    """Drives one robot.

    Args:
        robot: with the policy's actions, in its order.
        limits: see `Limits`.
        continuous: decide at every frame and hold the action's velocity in between.
        exact: lock-step simulation: actions end within micrometres and frames carry exact stamps.
        goal_limits: when a goal is given up.

    Attributes:
        goal: the newest goal, and how it ended.
        goal_limits: when that one is given up; usual_limits: as given.
    """

    def __init__(self, robot: RobotSpec, limits: Limits, *, continuous: bool = False,
                 exact: bool = False, goal_limits: GoalLimits | None = None):
        self.goal_limits = self.usual_limits = goal_limits or GoalLimits()
        self.goal = GoalRecord()
        self.robot, self.limits, self.continuous, self.exact = robot, limits, continuous, exact
        self.executor = (ActionExecutor(robot, tolerance=1e-6, creep=0.0) if exact
                         else ActionExecutor(robot, tolerance=0.004, creep=0.02, learns=True))
        self.state, self.reason = State.IDLE, 'not enabled'
        self.phase = Phase.LOOK
        self.goal_ready = False
        self.velocity = np.zeros(4)
        self.decisions = 0  # in this episode
        self.cut_off = 0  # motions, or decisions to move, that were given up before their end
        self.arrival: float | None = None  # probability at which arrival was declared
        self.gate = FrameGate(limits.max_frame_age, limits.max_frame_ahead)
        self.epoch = 0  # grows when time was set: what the policy remembers is of another time
        self.goal_refusal = ''  # why the newest goal picture was unusable
        self._failure = ''  # why the goal was given up
        self._now = 0.0  # steady time, as last heard
        self._target = np.zeros(4)
        self._stopped_from: float | None = None  # steady time of a stop's first zero
        self._settles = False  # a motion was cut off: a picture at rest is still to come
        self._idle_from: float | None = -np.inf  # steady time of leaving motion; None: just now
        self._rolled: np.ndarray | None = None  # odometry in the last step at rest
        self._rolls_until = -np.inf  # stamp
        self._healthy_since: float | None = None
        self._last_frame: float | None = None  # steady time at which the newest good frame came
        self._refused = -np.inf  # steady time at which the newest frame was dropped
        self._admitted = -np.inf  # steady time at which the newest admitted one came
        self._thought = -np.inf  # steady time at which the newest decision was made
        self._look_after = -np.inf  # stamp that the next decision's frame must exceed
        self._bad_frames = self._late_inferences = 0
        self._ticket = 0
        self._inferring_since: float | None = None
        self._pending_action: int | None = None

    # Frames.

    @property
    def dropped(self) -> dict[str, int]:
        """Frames that were dropped, by kind."""
        return self.gate.dropped

    def admit(self, stamp: float, clock: float | None, now: float = -math.inf) -> bool:
        """May a frame be used? Judges its stamp against the last one and the clock [s].

        A frame that may not is counted in `dropped`, and is as good as none. One that comes from
        a time that was set back is the first of the new time.

        Args:
            stamp: of the frame; clock: the node's, None: nothing is late [s].
            now: steady time at which it came [s], see `_heard`.
        """
        if back := self.gate.went_back(stamp, clock):
            self.time_jumped(f'camera stamps went back by {back:.4g} s')
        if admitted := self.gate.admit(stamp, clock):
            self._admitted = max(self._admitted, now)
        else:
            self._refused = max(now, self._now)
        return admitted

    def time_jumped(self, reason: str) -> None:
        """A clock was set: forget old stamps, and stand still until enabled again."""
        self.gate.forget()
        self._look_after = -np.inf
        self._healthy_since = None
        self.epoch += 1
        if self.state in ENABLED:
            self._idle(f'{reason}: enable again')

    def good_frame(self, now: float) -> None:
        """An admitted frame, which came at steady time `now`, has been decoded."""
        gap = None if self._last_frame is None else now - self._last_frame
        if self._healthy_since is None or gap is None or gap > max(
                self.limits.frame_timeout, self.limits.inference_timeout):
            self._healthy_since = now
        self._last_frame = now
        self._bad_frames = 0

    def bad_frame(self, reason: str, now: float) -> None:
        """An admitted frame could not be decoded. Three in a row stop the robot."""
        self.gate.unusable(reason)
        self._admitted, self._refused = -np.inf, now
        self._bad_frames += 1
        self._healthy_since = None
        if self._bad_frames >= 3 and self.state in ENABLED:
            self.stop(f'three bad frames in a row: {self.gate.last}', now, Code.CAMERA_LOST)

    # Goals.

    def new_goal(self, limits: GoalLimits | None = None) -> None:
        """Another goal picture came: a new episode, which begins with standing still.

        Args:
            limits: of this goal; None: the usual ones.
        """
        self.goal_limits = limits or self.usual_limits
        self.goal.end(Status.CANCELLED, self._now, message='another goal came')
        self.goal_ready, self.arrival, self.goal_refusal, self._failure = False, None, '', ''
        self._abandon()
        if self.state in (State.RUNNING, *AT_THE_END):
            self.state, self.reason = State.HOLD, 'goal changed'

    def accept_goal(self, stamp: float, again: bool = False) -> None:
        """The policy knows the goal. Frames up to `stamp` belong to the episode before.

        Args:
            stamp: of the goal [s].
            again: it is the same goal as before, cut for what the camera says of itself now.
        """
        self.goal_ready, self.decisions = True, 0
        if not again or self.goal.code is Code.GOAL_REFUSED:
            self.goal.accept()
            if self.state in ENABLED:
                self.goal.activate(self._now)
        self._look_after = max(self._look_after, stamp)

    def refuse_goal(self, why: str) -> None:
        """The goal picture was unusable: as if there were none."""
        self.goal_ready, self.goal_refusal = False, shorten(why)
        self.goal.refuse(self.goal_refusal)
        self._abandon()
        if self.state in ENABLED:
            self.state, self.reason = State.HOLD, f'goal refused: {self.goal_refusal}'

    # Commands of people.

    def enable(self, now: float, blockers: tuple[str, ...] = ()) -> tuple[bool, str]:
        """Allow motion, also on from where the policy has arrived.

        Refused with everything that is missing.
        """
        missing = list(blockers)
        if self.state is State.STOPPED:
            missing.append(f'stopped ({self.reason}): {RESET_FIRST}')
        if not self.goal_ready:
            missing.append('no usable goal: publish a picture on goal_image'
                           + (f' ({self.goal_refusal})' if self.goal_refusal else ''))
        silent = self._last_frame is None or now - self._last_frame > self.limits.frame_timeout
        if silent or self._healthy_since is None:
            drops = self.gate.summary()
            missing.append('no healthy frames: check image_raw' + (f' ({drops})' if drops else ''))
        elif now - self._healthy_since < ARMING_SECONDS:
            missing.append(f'frames are healthy for less than {ARMING_SECONDS:.0f} s: try again')
        if missing:
            return False, '; '.join(missing)
        self._now, self.arrival = now, None
        self._failure = ''
        if self.goal.status in ENDED:
            self.decisions = 0  # it has its budget once more
        if self.state in (State.IDLE, *AT_THE_END):
            self._abandon()
            self.state, self.reason = State.RUNNING, ''
        self.goal.activate(now)
        return True, 'enabled'

    def disable(self) -> None:
        """Zero at once, repeated for `STOP_SECONDS`, then silence; not latched."""
        self.goal.cancel(self._now, 'disabled')
        if self.state is not State.STOPPED:
            self._idle('disabled')

    def give_up(self, code: Code, why: str) -> None:
        """The goal has failed: zero velocity at once, until another one comes, or `enable`."""
        if self.state in ENABLED and self.goal.status is Status.ACTIVE:
            self.goal.end(Status.FAILED, self._now, code, shorten(why))
            self._failure = self.goal.message
            self._abandon()
            self._go_on()

    def stop(self, reason: str, now: float, code: Code = Code.STOPPED) -> None:
        """Zero at once, latched; the goal has failed."""
        self._now = now
        self.goal.end(Status.FAILED, now, code, shorten(reason))
        if self.state is not State.STOPPED:
            self.state, self.reason, self._stopped_from = State.STOPPED, shorten(reason), None
        self.arrival, self._failure = None, ''
        self._abandon()

    def reset(self) -> None:
        """Clear a latched stop; never enables."""
        self._bad_frames = self._late_inferences = 0
        self.goal.cancel(self._now, 'reset')
        self._idle('not enabled')

    def _idle(self, reason: str) -> None:
        self._abandon()
        if self.state in ENABLED:
            self._idle_from = None  # a command may be in force: the next step takes it back
        elif self.state is State.STOPPED:
            self._idle_from = self._stopped_from  # its second of zeros goes on
        self.goal.end(Status.FAILED, self._now, Code.STOPPED, reason)
        self.state, self.reason, self.arrival, self._failure = State.IDLE, reason, None, ''

    def _abandon(self) -> None:
        """Forget the action and the decision under way; velocity zero."""
        self.cut_off += self.phase is Phase.MOVE or self._pending_action is not None
        self.phase = Phase.LOOK
        self.executor.abandon()
        self._settles |= bool(self.velocity.any())
        self._ticket += 1
        self._inferring_since = self._pending_action = None
        self.velocity, self._target = np.zeros(4), np.zeros(4)

    # Decisions, made by another thread.

    def wants(self, stamp: float) -> bool:
        """Whether a decision from a frame with this stamp is wanted."""
        wanted = self._wants(stamp)
        if wanted and 0 < self.goal_limits.max_decisions <= self.decisions:
            self.give_up(Code.BUDGET, f'{self.decisions} decisions are used up')
            return False
        return wanted

    def _wants(self, stamp: float) -> bool:
        return (self.state is State.RUNNING and self.goal_ready
                and self._inferring_since is None and stamp > self._look_after
                and (self.phase is Phase.LOOK or self.continuous)
                and self._pending_action is None)

    def is_since_rest(self, stamp: float) -> bool:
        """Whether what was measured at a stamp shows the place as a picture at rest does."""
        return self.continuous or stamp > self._look_after

    def request(self, stamp: float, now: float) -> int | None:
        """A ticket, when a decision from a frame with this stamp is wanted now."""
        if not self.wants(stamp):
            return None
        self._inferring_since = now
        return self._ticket

    def decided(self, ticket: int, action: int, now: float) -> bool:
        """The decision behind a ticket; False: discarded, as late or no longer wanted."""
        if not self._in_time(ticket, now):
            return False
        self._pending_action = action
        return True

    def declared(self, ticket: int, probability: float, now: float) -> None:
        """The decision behind a ticket is that the robot has arrived: zero velocity at once.

        Discarded as `decided` discards; it counts as a decision.
        """
        if self._in_time(ticket, now):
            self.decisions += 1
            self._abandon()
            self.arrival = probability
            self.goal.end(Status.SUCCEEDED, now)
            self._go_on()

    def _in_time(self, ticket: int, now: float) -> bool:
        if ticket != self._ticket or self._inferring_since is None:
            return False
        late = now - self._inferring_since > self.limits.inference_timeout
        self._inferring_since, self._thought = None, now
        if late:
            self._late(now)
            return False
        self._late_inferences = 0
        return True

    def _go_on(self) -> None:
        """With nothing in the way: drive, or stand where the goal has ended."""
        if self._failure:
            self.state, self.reason = State.FAILED, self._failure
        elif self.arrival is None:
            self.state, self.reason = State.RUNNING, ''
        else:
            self.state, self.reason = State.ARRIVED, f'p = {self.arrival:.2f}'

    def _late(self, now: float) -> None:
        self._ticket += 1
        self._inferring_since, self._thought = None, now
        self._late_inferences += 1
        self.velocity, self._target = np.zeros(4), np.zeros(4)
        if self._late_inferences >= 3:
            self.stop(f'three inferences in a row took longer than '
                      f'{self.limits.inference_timeout} s', now)

    @property
    def ready_to_move(self) -> bool:
        """A decision waits for the output thread."""
        return self._pending_action is not None and self.state is State.RUNNING

    def odometry_jumped(self, reason: str) -> None:
        """The pose is elsewhere at once: what is measured of the action under way is worthless."""
        if self.state is State.RUNNING and self.velocity.any():
            self._abandon()
            self.state, self.reason = State.HOLD, reason

    # Velocities, asked for by the output thread.

    def _heard(self, now: float) -> float:
        """Steady time at which the camera was last known to see.

        While the policy thinks no picture is decoded, and just after it none has been yet: there
        those count that were admitted.
        """
        known = -np.inf if self._last_frame is None else self._last_frame
        thinks = self._inferring_since is not None or (
            now - self._thought <= self.limits.frame_timeout)
        return max(known, self._admitted) if thinks else known

    def deadline(self) -> float:
        """The steady time at which `step` has to be asked again, whatever comes meanwhile."""
        if self.state is not State.RUNNING or self._last_frame is None:
            return np.inf
        return min(self._heard(self._now) + self.limits.frame_timeout,
                   np.inf if self._inferring_since is None
                   else self._inferring_since + self.limits.inference_timeout)

    def step(self, now: float, dt: float, odometry: np.ndarray | None, stamp: float,
             *, odometry_lost: bool = False) -> np.ndarray | None:
        """The velocity for the next period, or None to stay silent.

        Args:
            now: steady time [s]; dt: length of the period [s].
            odometry: [3] x, y, yaw, or None where there is none.
            stamp: present time in the frames' clock [s].
            odometry_lost: there was odometry, and it is stale: no motion without it.
        """
        self._now = now
        if self._settles:  # what moved gets a zero command now
            self._settles = False
            if not (self.continuous or self.exact):
                self._look_after = max(self._look_after, stamp + self.limits.settle_time)
        if odometry_lost and self.state is State.RUNNING and self.velocity.any():
            self.stop('odometry fell silent in motion', now, Code.ODOMETRY_LOST)
        if self.state is State.STOPPED:
            if self._stopped_from is None:
                self._stopped_from = now
            return np.zeros(4) if now - self._stopped_from < STOP_SECONDS else None
        if self.state is State.IDLE:
            if self._idle_from is None:
                self._idle_from = now
            return np.zeros(4) if now - self._idle_from < STOP_SECONDS else None
        self._watch(now, odometry_lost)
        if 0 < self.goal_limits.time_allowance < self.goal.seconds(now):
            self.give_up(Code.BUDGET, f'{self.goal_limits.time_allowance:g} s are over')
        if self.state is not State.RUNNING:
            return np.zeros(4)
        if self._inferring_since is not None and (
                now - self._inferring_since > self.limits.inference_timeout):
            self._late(now)
            return np.zeros(4)
        return self._cruise(dt) if self.continuous else self._stop_and_go(dt, odometry, stamp)

    def _watch(self, now: float, odometry_lost: bool) -> None:
        """Silence of camera and odometry, and holds whose cause is gone."""
        silence = now - self._heard(now)
        drops = now - self._refused <= self.limits.frame_timeout  # what comes is of no use
        if silence > self.limits.frame_stop_timeout:
            seconds = self.limits.frame_stop_timeout
            self.stop(f'no usable camera frame for {seconds} s: {self.gate.last}' if drops
                      else f'no camera frame for {seconds} s', now, Code.CAMERA_LOST)
        elif silence > self.limits.frame_timeout:
            if self.state is State.RUNNING:
                self._abandon()
            self.state, self.reason = State.HOLD, (
                f'no usable camera frame: {self.gate.last}' if drops else 'camera silent')
        elif odometry_lost:
            self._abandon()
            self.state, self.reason = State.HOLD, 'odometry silent'
        elif self.state is State.HOLD and self.goal_ready:
            self._go_on()

    def _stop_and_go(self, dt: float, odometry: np.ndarray | None, stamp: float) -> np.ndarray:
        if self.phase is Phase.LOOK:
            if self._pending_action is None:
                self._wait_for_rest(dt, odometry, stamp)
                return np.zeros(4)
            self.executor.begin(self._pending_action, odometry)
            self._pending_action = None
            self.decisions += 1
            self.phase = Phase.MOVE
        self.velocity, over = self.executor.velocity(dt, odometry)
        if over:
            self.phase = Phase.LOOK
            self._look_after = stamp + self.limits.settle_time
            self._rolled, self._rolls_until = odometry, stamp + LONGEST_ROLL_S
        return self.velocity

    def _wait_for_rest(self, dt: float, odometry: np.ndarray | None, stamp: float) -> None:
        """A base that rolls on by odometry is not at rest, whatever the time since its command."""
        if self.exact or odometry is None or self._rolled is None or stamp > self._rolls_until:
            return
        step = odometry - self._rolled
        self._rolled = odometry
        if (math.hypot(step[0], step[1]) > ROLLS_M_PER_S * dt
                or abs(wrap_angle(step[2])) > ROLLS_RAD_PER_S * dt):
            self._look_after = max(self._look_after, stamp + self.limits.settle_time)

    def _cruise(self, dt: float) -> np.ndarray:
        if self._pending_action is not None:
            self._target = cruise(self.robot, self._pending_action)
            self._pending_action = None
            self.decisions += 1
        self.velocity = ramp(self.velocity, self._target, self.robot, dt)
        return self.velocity

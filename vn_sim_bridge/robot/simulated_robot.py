"""One robot in one place of a simulator, driven by velocities in ticks: the bridge without ROS.

What a tick, a decision and an episode are is docs/architecture.md, "Time". This class judges
episodes exactly as `NavigationEnv` does, from whatever velocities it is given.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import numpy as np

from vn_nav.errors import UserError
from vn_nav.robot import AXES, RobotSpec
from vn_sim_bridge.counter_random import Stream, key, normal, uniform
from vn_sim_bridge.floor.contacts import motion_noise, nominal_sizes
from vn_sim_bridge.navigation import tasks
from vn_sim_bridge.navigation.episodes import (
    MIN_START_DISTANCE,
    GoalField,
    draw_delays,
    draw_goal,
    draw_grip,
    draw_motion_scale,
    draw_variant,
)
from vn_sim_bridge.render.randomisation import Randomisation
from vn_sim_bridge.robot.odometry import Uncertainty, advance, drift_errors
from vn_sim_bridge.robot.simulated_base import SimulatedBase
from vn_sim_bridge.simulator import Frames, Goal, Setup
from vn_sim_bridge.simulators import open_simulator

TICK = 0.05  # s of simulated time
TERMINATED, TRUNCATED = 1, 2


@dataclasses.dataclass
class Episode:
    """One journey to one picture."""

    index: int
    goal: int  # index into the goals; -1: a goal by pose
    start: tuple[float, ...]  # x, y, yaw, pitch
    start_distance: float | None  # m, geodesic; None: nobody knows it
    begun_at: float  # s, simulated
    decisions: int = 0
    collisions: int = 0  # decisions that touched something
    path_length: float = 0.0  # m


@dataclasses.dataclass(frozen=True)
class Decision:
    """The judgement at a decision's end."""

    collided: bool
    success: bool
    distance: float  # m, geodesic
    heading_error: float  # rad
    end: int  # 0: the episode goes on; TERMINATED or TRUNCATED


class SimulatedRobot:
    """Motion, odometry, decisions and episodes of one robot.

    Args:
        scene: its name, see `vn_nav.scenes`.
        robot: limits, camera, footprint; its action table gives the noise's nominal sizes.
        size: side of the pictures [pixels]; with `aspect` their height, or width if it is less.
        aspect: width of the pictures over their height. `camera_fov` is of the shorter side.
        noise: Gaussian motion noise; odometry reports the motion without it.
        seed: of starts, goals and noise. Episode e starts as environment e of a `NavigationEnv`
            with the same seed does.
        max_decisions: limit of an episode.
        stop: 'arrival' ends an episode, or 'declared': only `declare` does, as in `EnvConfig`.
        randomisation: of light, camera and base; default: nothing varies.
        odometry_drift: errors of odometry (`odometry.drift_errors`) besides motion noise; 0: none.
        goal_poses: x, y [m], yaw [rad] of the goals to draw from; default: the place's.

    Raises:
        UserError: a goal where the robot cannot stand; a simulator that is no robot's world: its
            robots cannot be put anywhere, or its actions are no motions.
    """

    def __init__(self, scene: str, *, robot: RobotSpec, size: int = 84, aspect: float = 1.0,
                 noise: bool = True, seed: int = 0, max_decisions: int = 300,
                 stop: str = 'arrival', randomisation: Randomisation | None = None,
                 odometry_drift: float = 0.0,
                 goal_poses: Sequence[tuple[float, float, float]] | None = None):
        self.stop_rule = stop
        self.robot, self.noise, self.seed, self.max_decisions = robot, noise, seed, max_decisions
        self.randomisation = randomisation or Randomisation()
        # Simulators draw squares: of a longer picture as wide as it is, which is cut.
        longer = round(size * max(aspect, 1 / aspect))
        self.picture_size = (longer, size) if aspect >= 1 else (size, longer)  # width, height
        self._rows, self._columns = (
            slice((longer - part) // 2, (longer - part) // 2 + part)
            for part in ((size, longer) if aspect >= 1 else (longer, size)))
        whole = 2 * math.atan(longer / size * math.tan(robot.camera_fov / 2))
        self.simulator = open_simulator([scene], Setup(
            1, robot if longer == size else dataclasses.replace(robot, camera_fov=whole), longer,
            randomisation=self.randomisation))
        try:
            self._check_simulator(scene)
        except UserError:
            self.simulator.close()
            raise
        self.place = self.simulator.places[0]
        self.fields = (
            [GoalField(self.place, goal, MIN_START_DISTANCE) for goal in self.place.goals]
            if goal_poses is None else [self._field_at(*pose) for pose in goal_poses])
        # On a grid nothing is noisy, slips or is worn.
        self._exact = not self.simulator.capabilities.continuous
        self.noise = noise and not self._exact
        self._nominal = nominal_sizes(robot)
        self.tick_count = 0
        self.odometry_drift = odometry_drift
        self.odometry = np.zeros(3)  # x, y, yaw in the odom frame
        self.uncertainty = Uncertainty(  # of the odometry
            odometry_drift, TICK, exact_turns=self.simulator.exact_turns)
        self.base = SimulatedBase(robot, TICK)
        self.velocity = np.zeros(4)  # of the body in the last tick: vx, vy, wz, tilt rate
        self.episode: Episode | None = None
        self._field = self.fields[0]
        self._in_decision = False
        self._touched = False
        self._share = self._motion_scale = 1.0  # metres driven per metre asked for
        self._shown: Frames | None = None
        self.camera_delay = 0.0  # s, of this episode: from a picture's stamp to its arrival
        # Compile the motion now, not when the first command is in force.
        self.simulator.move(np.zeros((1, 4)))

    def _check_simulator(self, scene: str) -> None:
        can = self.simulator.capabilities
        rules = (
            (can.teleport and not can.own_actions, 'a robot that is driven by velocities needs a '
             'simulator of motions that puts it anywhere'),
            (not can.rewards, 'the bridge judges arrival itself: no simulator that pays'),
            (can.appearance or not self.randomisation.varies_pictures,
             'light and camera vary in simulators that draw them: randomisation none'),
        )
        for kept, rule in rules:
            if not kept:
                raise UserError(rule, scene, 'choose another scene (vn_nav simulators)')

    def close(self) -> None:
        """Let go of the simulator."""
        self.simulator.close()

    @property
    def time(self) -> float:
        """Simulated seconds since the start."""
        return self.tick_count * TICK

    @property
    def pose(self) -> np.ndarray:
        """True x, y, yaw, pitch in the map frame, [4]."""
        return self.simulator.poses[0]

    @property
    def goal(self) -> Goal:
        """The goal of the present episode."""
        return self._field.goal

    def begin_episode(self, index: int, goal_pose: tuple[float, float, float] | None = None
                      ) -> Episode:
        """Draw goal and start of episode `index`, and put the robot there.

        Args:
            goal_pose: x, y [m], yaw [rad] of a goal instead of one of the place's.

        Raises:
            UserError: a goal where the robot cannot stand.
        """
        counter = (self.seed, index, 0)
        if goal_pose is None:
            chosen = draw_goal(len(self.fields), *counter)
            field = self.fields[chosen]
        else:
            chosen, field = -1, self._field_at(*goal_pose)
        self._field = field
        start = field.start(1.0, *counter)
        self.simulator.place(np.array([0]), start[None])
        self.base.stop()
        self.velocity = np.zeros(4)
        self._in_decision = self._touched = False
        self.simulator.apply_appearance(np.array([0]), self.seed, Stream.APPEARANCE, index, 0)
        self._motion_scale = float(draw_motion_scale(self.randomisation, *counter))
        delay, lag, self.camera_delay = draw_delays(self.randomisation, self.seed, index)
        self.base.respond(delay, lag)
        self._shown = None
        can = self.simulator.capabilities
        # Steps are no metres: who reads `start_distance` makes figures in metres of it.
        known = can.geodesic and not can.steps
        self.episode = Episode(index, chosen, tuple(float(v) for v in start),
                               self.distance() if known else None, self.time)
        return self.episode

    def place_freely(self, index: int) -> None:
        """Put the robot at the start of episode `index`, to be driven without any episode."""
        self.begin_episode(index)
        self.episode = None

    def _field_at(self, x: float, y: float, yaw: float) -> GoalField:
        spots = self.place.starts()[0]
        if not np.isfinite([x, y, yaw]).all() or (
                np.hypot(*(spots - [x, y]).T).min() > 0.1):
            corners = (*spots.min(axis=0).tolist(), *spots.max(axis=0).tolist())
            raise UserError('a goal lies where the robot can stand', (x, y, yaw),
                            f'choose a free place within {corners} (x0, y0, x1, y1 in metres); '
                            'the scene topic has the map')
        name = getattr(self.place, 'room_at', lambda x, y: 'goal')(x, y) or 'door'
        return GoalField(self.place, Goal((x, y, yaw, 0.0), name), MIN_START_DISTANCE)

    def goal_frames(self) -> Frames:
        """The goal picture (and its depth and labels), in a light of its own."""
        assert self.episode is not None  # a robot that is driven freely has no goal
        index, goal = self.episode.index, self.episode.goal
        variants = self.randomisation.pictures_per_goal
        variant = (index if goal < 0 else
                   draw_variant(variants, self.seed, index, 0))
        counter = (self.seed, Stream.GOAL_APPEARANCE, np.array([goal]), np.array([variant]))
        return self._cut(self.simulator.view(
            np.zeros(1, np.int64), np.array([self.goal.pose]), None,
            self.simulator.appearance(*counter), key(*counter, 99)))

    def observe(self) -> Frames:
        """The camera's picture; with a late camera at times the one before."""
        index = self.episode.index if self.episode else 0
        counter = (self.seed, Stream.LATE_PICTURE, index, 0, self.tick_count)
        if self._shown is None or uniform(*counter) >= self.randomisation.late_picture:
            frames = self.simulator.observe(keys=np.atleast_1d(
                key(self.seed, Stream.SENSOR, index, 0, self.tick_count)))
            self._shown = Frames(*(part.copy() for part in self._cut(frames)))
        return self._shown

    def _cut(self, frames: Frames) -> Frames:
        """Pictures of the camera's format out of the simulator's."""
        return Frames(*(part[..., self._rows, self._columns] for part in frames))

    def distance(self) -> float:
        """Geodesic distance to the goal [m; steps on a grid]."""
        return float(self._field.field.at(self.pose[None])[0])

    def drive(self, command: np.ndarray) -> Decision | None:
        """Advance by one tick as the base follows a command, within the robot's limits.

        Args:
            command: [4] vx, vy [m/s], wz, tilt rate [rad/s], finite.

        Returns:
            As `tick`: the robot is at rest when nothing is asked for and it has braked.
        """
        command = np.asarray(command, float)
        velocity = self.base.follow(command, self.velocity)
        return self._advance(velocity, at_rest=not (velocity.any() or command.any()
                                                    or self.base.late))

    def tick(self, velocity: np.ndarray) -> Decision | None:
        """Advance by one tick at a velocity, whatever the limits: a whole action may be one tick.

        Args:
            velocity: [4] vx, vy [m/s], wz, tilt rate [rad/s].

        Returns:
            The judgement, when this tick ended a decision: the first tick at rest after motion.
        """
        velocity = np.asarray(velocity, float)
        self.base.velocity = velocity.copy()
        return self._advance(velocity, at_rest=not velocity.any())

    def _advance(self, velocity: np.ndarray, *, at_rest: bool) -> Decision | None:
        self.tick_count += 1
        self.velocity = velocity.copy()
        if at_rest:
            self.uncertainty.rest()
            return self.end_decision() if self._in_decision else None
        if not self._in_decision:
            self._in_decision = True
            self._share = 1.0 if self._exact else self._motion_scale * self._slip()
        wanted = self.velocity * TICK
        delta = self._with_noise(wanted) if self.noise else wanted.copy()
        delta[:3] *= self._share
        motion = self.simulator.move(delta[None])
        done = motion.delta[0]
        length = math.hypot(delta[0], delta[1])
        travelled = math.hypot(done[0], done[1])
        self._touched |= bool(motion.collided[0])
        if self.episode is not None:
            self.episode.path_length += travelled
        # Odometry counts wheel turns: what was wanted, as far as nothing stood in the way.
        share = travelled / length if length > 0 else 1.0
        turned = share * wanted[0], share * wanted[1], wanted[2]
        self.uncertainty.add(self.odometry[2], turned, noise=float(
            np.abs(wanted[:3]).max() / self._nominal_size(wanted)) if self.noise else 0.0)
        self.odometry = advance(self.odometry, turned, self._odometry_errors(turned))
        self.velocity[:2] *= share
        return None

    def _slip(self) -> float:
        """The share of a new decision's motion that the wheels turn into driving."""
        index = self.episode.index if self.episode else 0
        return float(draw_grip(self.randomisation, self.seed, index, 0, self.tick_count))

    def _with_noise(self, wanted: np.ndarray) -> np.ndarray:
        number = normal(self.seed, Stream.MOTION_NOISE, 0, self.episode.index if self.episode
                        else 0, self.tick_count)
        return motion_noise(wanted[None], np.array([self._nominal_size(wanted)]),
                            np.atleast_1d(number),
                            exact_turns=self.simulator.exact_turns)[0]

    def _nominal_size(self, wanted: np.ndarray) -> float:
        """Of the whole action [m or rad] that a displacement [4] is a part of."""
        axis = int(np.argmax(np.abs(wanted)))
        # A direction without an action of its own (a joystick driving sideways) is as noisy as
        # the thesis's largest step.
        return self._nominal.get(('+' if wanted[axis] > 0 else '-') + AXES[axis], 0.5)

    def _odometry_errors(self, turned: tuple[float, float, float]) -> tuple[float, float, float]:
        if not self.odometry_drift:
            return 0.0, 0.0, 0.0
        numbers = normal(self.seed, Stream.ODOMETRY, np.arange(3), 0, self.tick_count)
        return drift_errors(turned, self.odometry_drift, numbers)

    @property
    def moves(self) -> bool:
        """It moves, or what was asked for before will move it."""
        return bool(self.velocity.any()) or self.base.late

    @property
    def in_decision(self) -> bool:
        """Non-zero commands have come since the last judgement."""
        return self._in_decision

    def end_decision(self) -> Decision:
        """Judge arrival, collision and the episode's limit."""
        return self._judge(declared=False)

    def declare(self) -> Decision:
        """The robot says that it has arrived: a decision that ends the episode, true or not."""
        return self._judge(declared=True)

    def _judge(self, *, declared: bool) -> Decision:
        collided, self._touched, self._in_decision = self._touched, False, False
        distance = self.distance()
        error = float(tasks.heading_error(self.pose[2], self.goal.pose[2]))
        success = (declared or self.stop_rule == 'arrival') and bool(
            tasks.arrived(distance, error))
        end = 0
        if self.episode is not None:
            self.episode.decisions += 1
            self.episode.collisions += collided
            if success or declared:
                end = TERMINATED
            elif self.episode.decisions >= self.max_decisions:
                end = TRUNCATED
        return Decision(collided, success, distance, error, end)

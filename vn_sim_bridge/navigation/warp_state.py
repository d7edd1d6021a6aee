"""What the kernels of `WarpNavigationEnv` read and write: houses, robots, rules.

Each struct has a function here that fills it and puts its arrays on the device.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp

from vn_nav.robot import RobotSpec
from vn_sim_bridge.houses.house import House
from vn_sim_bridge.navigation import tasks
from vn_sim_bridge.navigation.env_config import EnvConfig
from vn_sim_bridge.navigation.goal_distances import over_floor

MODES = {tasks.RIGHT: 0, tasks.WRONG: 1, tasks.BLANK: 2}


@wp.struct
class Houses:
    """Geometry: it never changes."""

    rects: wp.array2d(dtype=wp.float64)  # x0, y0, x1, y1 of the obstacles of all houses
    first_rect: wp.array(dtype=wp.int32)  # [houses+1]
    origin: wp.array2d(dtype=wp.float64)  # [houses,2] of the floor maps
    first_goal: wp.array(dtype=wp.int32)  # [houses+1]
    goal_pose: wp.array2d(dtype=wp.float64)  # [G,4]
    maps: wp.array3d(dtype=wp.float32)  # [G,rows,columns] distance to each goal
    cells: wp.array2d(dtype=wp.float64)  # start cells of all goals, nearest first
    cell_distance: wp.array(dtype=wp.float64)
    first_cell: wp.array(dtype=wp.int32)  # [G+1]


@wp.struct
class Robots:
    """What changes from step to step, by environment."""

    house: wp.array(dtype=wp.int64)
    pose: wp.array2d(dtype=wp.float64)
    episode: wp.array(dtype=wp.int64)
    step: wp.array(dtype=wp.int64)
    goal: wp.array(dtype=wp.int64)
    shown: wp.array(dtype=wp.int64)
    picture: wp.array(dtype=wp.int64)  # of the true goal; grey where that is shown
    distance: wp.array(dtype=wp.float64)
    start_distance: wp.array(dtype=wp.float64)
    heading_error: wp.array(dtype=wp.float64)
    arrived: wp.array(dtype=wp.bool)
    goal_pose: wp.array2d(dtype=wp.float32)  # as `co_visibility.relative_pose`
    path_length: wp.array(dtype=wp.float64)
    last_action: wp.array(dtype=wp.int64)
    last_reward: wp.array(dtype=wp.float32)
    reward: wp.array(dtype=wp.float32)
    terminated: wp.array(dtype=wp.bool)
    truncated: wp.array(dtype=wp.bool)
    reset: wp.array(dtype=wp.bool)
    collided: wp.array(dtype=wp.bool)
    motion_scale: wp.array(dtype=wp.float64)
    camera: wp.array2d(dtype=wp.float64)
    focal: wp.array(dtype=wp.float64)
    camera_offset: wp.array2d(dtype=wp.float64)  # height, pitch, field of view
    cube: wp.array3d(dtype=wp.float32)
    lamps: wp.array3d(dtype=wp.float32)
    noise: wp.array(dtype=wp.float32)
    blur: wp.array(dtype=wp.float32)
    sensor_key: wp.array(dtype=wp.uint64)


# Of `Robots`: what the next step computes from the rest.
NOT_STATE = ('camera', 'focal', 'sensor_key')


@wp.struct
class Rules:
    """What the configuration, the robot and the two switches say."""

    seed: wp.int64
    mode: wp.int32  # see MODES
    variants: wp.int32
    environments: wp.int32
    houses: wp.int32
    blank_goal: wp.int64
    difficulty: wp.float64  # tau of `set_difficulty`
    max_decisions: wp.int64
    motion_noise: wp.float64
    progress: wp.float64
    collision: wp.float64
    step_reward: wp.float64
    goal_bonus: wp.float64
    radius: wp.float64
    camera_height: wp.float64
    camera_pitch: wp.float64
    camera_fov: wp.float64
    size: wp.float64
    slip: wp.float64
    white_balance: wp.float64
    lamp_on: wp.float64
    # least and span of: exposure, daylight, kelvin, sun, lamp, kelvin, fov, height, pitch, noise,
    # blur, motion scale
    ranges: wp.array2d(dtype=wp.float64)


def put(values, dtype, device: str) -> wp.array:
    """A copy on the device."""
    return wp.array(np.ascontiguousarray(values, dtype), device=device)


def variables(struct: type) -> dict[str, Any]:
    """Those of a Warp struct, by name."""
    return struct.vars  # type: ignore[attr-defined]  # `wp.struct` adds it, and Warp is not typed


def upload_houses(places: Sequence[House], task: tasks.ImageGoal, device: str) -> Houses:
    """Obstacles, goals, distance maps and start cells of all houses."""
    def on_device(values, dtype):
        return put(values, dtype, device)

    fields = list(map(task.goal_field, range(len(task.views))))
    solved = [over_floor(goal.field).values for goal in fields]
    shapes = [values.shape for values in solved]
    maps = np.full((len(fields), *np.max(shapes, axis=0)), np.inf, np.float32)
    for k, values in enumerate(solved):
        maps[k, :shapes[k][0], :shapes[k][1]] = values
    out = Houses()
    out.rects = on_device(np.concatenate([house.obstacle_rects for house in places]), np.float64)
    out.first_rect = on_device(np.cumsum([0] + [len(house.obstacles) for house in places]),
                               np.int32)
    out.origin = on_device([house.floor.origin for house in places], np.float64)
    out.first_goal = on_device(np.cumsum([0] + [count for _, count in task.ranges]), np.int32)
    out.goal_pose = on_device([view.pose for view in task.views], np.float64)
    out.maps = on_device(maps, np.float32)
    out.cells = on_device(np.concatenate([goal.starts.cells for goal in fields]), np.float64)
    out.cell_distance = on_device(np.concatenate([goal.starts.distances for goal in fields]),
                                  np.float64)
    out.first_cell = on_device(np.cumsum([0] + [len(goal.starts.cells) for goal in fields]),
                               np.int32)
    return out


def make_rules(config: EnvConfig, robot: RobotSpec, houses: int, goals: int, device: str) -> Rules:
    """The rules of a configuration, for so many houses with so many goals in all."""
    varied = config.randomisation
    rules = Rules()
    rules.seed, rules.mode, rules.difficulty = config.seed, 0, 1.0
    rules.variants = config.pictures_per_goal
    rules.environments, rules.houses = config.num_envs, houses
    rules.blank_goal = goals * rules.variants
    rules.max_decisions = config.max_decisions
    rules.motion_noise = float(config.noise)
    rules.progress, rules.collision = config.progress_reward, config.collision_reward
    rules.step_reward, rules.goal_bonus = config.step_reward, config.goal_bonus
    rules.radius, rules.camera_height = robot.footprint_radius, robot.camera_height
    rules.camera_pitch, rules.camera_fov = robot.camera_pitch, robot.camera_fov
    rules.size, rules.slip = config.size, varied.slip
    rules.white_balance, rules.lamp_on = varied.white_balance, varied.lamp_on
    ranges = [varied.exposure, varied.daylight, varied.daylight_kelvin, varied.sun,
              varied.lamp, varied.lamp_kelvin, varied.fov_deg, varied.height,
              varied.pitch_deg, varied.noise, varied.blur, varied.motion_scale]
    rules.ranges = put([(low, high - low) for low, high in ranges], np.float64, device)
    return rules


def make_robots(count: int, houses: int, rooms: int, device: str) -> Robots:
    """Robots before their first episode, one house after another; `rooms` lamps each."""
    shapes = {'pose': (count, 4), 'camera': (count, 5), 'camera_offset': (count, 3),
              'cube': (count, 6, 3), 'lamps': (count, rooms, 3), 'goal_pose': (count, 4)}
    robots = Robots()
    for name, variable in variables(Robots).items():
        setattr(robots, name, wp.zeros(shapes.get(name, (count,)), dtype=variable.type.dtype,
                                       device=device))
    robots.house = put(np.arange(count) % houses, np.int64, device)
    robots.episode.fill_(-1)
    return robots

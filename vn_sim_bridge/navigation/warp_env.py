"""`NavigationEnv`'s image-goal task on a Warp device: nothing leaves the GPU (`vn_nav[gpu]`).

Motion, collisions, rewards, new episodes and pictures are kernels; actions come and observations
go as PyTorch tensors that share the device's memory. The same seeds give the same episodes as
`NavigationEnv` does: the formulas and the counter of the random numbers are the same.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
import warp as wp

from vn_nav.co_visibility import GRID, SLACK, TOLERANCE, lift
from vn_nav.errors import UserError
from vn_nav.reset_arguments import are_several, read_options, read_seed
from vn_nav.robot import RobotSpec
from vn_nav.scenes import HOUSE, one_simulator
from vn_sim_bridge.counter_random import Stream, key
from vn_sim_bridge.floor.contacts import (
    MAX_TILT,
    PRECISION,
    ROTATION_NOISE,
    STEP,
    TRANSLATION_NOISE,
)
from vn_sim_bridge.floor.floor_map import CELL
from vn_sim_bridge.houses.labels import LABELS
from vn_sim_bridge.navigation import tasks
from vn_sim_bridge.navigation.env_config import EnvConfig
from vn_sim_bridge.navigation.goal_distances import over_floor
from vn_sim_bridge.render.pack import FACING
from vn_sim_bridge.render.randomisation import draw_appearance
from vn_sim_bridge.render.scene import Scene
from vn_sim_bridge.render.warp_renderer import WarpRenderer, camera_frame
from vn_sim_bridge.simulators.house import WORLD_VERSION, open_houses

wp.set_module_options({'enable_backward': False, 'fast_math': False})

MODES = {tasks.RIGHT: 0, tasks.WRONG: 1, tasks.BLANK: 2}
# Teachers plan on the CPU: `NavigationEnv` alone knows them.
TEACHERS = ('explorer_action', 'oracle_action')
_f = wp.float64
_pi = wp.constant(wp.float64(math.pi))
_to_unit = wp.constant(wp.float64(2.0**-53))
_to_angle = wp.constant(wp.float64(2.0**-52 * math.pi))
_gamma = wp.constant(wp.uint64(0x9E3779B97F4A7C15))
_mix_1 = wp.constant(wp.uint64(0xBF58476D1CE4E5B9))
_mix_2 = wp.constant(wp.uint64(0x94D049BB133111EB))
_goal_stream = wp.constant(int(Stream.GOAL))
_cell_stream = wp.constant(int(Stream.START_CELL))
_yaw_stream = wp.constant(int(Stream.START_YAW))
_noise_stream = wp.constant(int(Stream.MOTION_NOISE))
_wrong_stream = wp.constant(int(Stream.WRONG_GOAL))
_appearance_stream = wp.constant(int(Stream.APPEARANCE))
_variant_stream = wp.constant(int(Stream.GOAL_VARIANT))
_sensor_stream = wp.constant(int(Stream.SENSOR))
_base_stream = wp.constant(int(Stream.BASE))
_slip_stream = wp.constant(int(Stream.SLIP))
_house_stream = wp.constant(int(Stream.HOUSE))
_facing = wp.constant(wp.types.vector(6, wp.float64)(*map(float, FACING)))
_translation_noise = wp.constant(wp.float64(TRANSLATION_NOISE))
_rotation_noise = wp.constant(wp.float64(ROTATION_NOISE))
_max_tilt = wp.constant(wp.float64(MAX_TILT))
_step = wp.constant(wp.float64(STEP))
_precision = wp.constant(wp.float64(PRECISION))
_cell = wp.constant(wp.float64(CELL))
_arrival_radius = wp.constant(wp.float64(tasks.ARRIVAL_RADIUS))
_arrival_heading = wp.constant(wp.float64(tasks.ARRIVAL_HEADING))
_infinity = wp.constant(wp.float64(math.inf))
_tolerance = wp.constant(wp.float64(TOLERANCE))
_slack = wp.constant(wp.float64(SLACK))


@wp.struct
class Houses:
    """Geometry that never changes."""

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


# Of `Robots`: follows from the rest with the next step.
NOT_STATE = ('camera', 'focal', 'sensor_key')


@wp.struct
class Rules:
    """Numbers of the configuration."""

    seed: wp.int64
    mode: wp.int32  # see MODES
    variants: wp.int32
    environments: wp.int32
    houses: wp.int32
    blank_goal: wp.int64
    tau: wp.float64
    max_decisions: wp.int64
    motion_noise: wp.int32
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


@wp.func
def mix(state: wp.uint64, value: wp.int64):
    """One round of `counter_random._hash`."""
    state = (state ^ wp.uint64(value)) + _gamma
    state = (state ^ (state >> wp.uint64(30))) * _mix_1
    state = (state ^ (state >> wp.uint64(27))) * _mix_2
    return state ^ (state >> wp.uint64(31))


@wp.func
def bits(seed: wp.int64, stream: int, env: wp.int64, episode: wp.int64, step: wp.int64):
    """As `counter_random.key`."""
    return mix(mix(mix(mix(mix(wp.uint64(0), seed), wp.int64(stream)), env), episode), step)


@wp.func
def uniform(seed: wp.int64, stream: int, env: wp.int64, episode: wp.int64, step: wp.int64):
    """As `counter_random.uniform`."""
    return _f(bits(seed, stream, env, episode, step) >> wp.uint64(11)) * _to_unit


@wp.func
def normal(seed: wp.int64, stream: int, env: wp.int64, episode: wp.int64, step: wp.int64):
    """As `counter_random.normal`."""
    state = bits(seed, stream, env, episode, step)
    first = mix(state, wp.int64(0)) >> wp.uint64(11)
    second = mix(state, wp.int64(1)) >> wp.uint64(11)
    radius = wp.sqrt(_f(-2.0) * wp.log(_f(first + wp.uint64(1)) * _to_unit))
    return radius * wp.cos(_f(second) * _to_angle)


@wp.func
def wrap(angle: wp.float64):
    """To [-pi, pi)."""
    return angle - _f(2.0) * _pi * wp.floor((angle + _pi) / (_f(2.0) * _pi))


@wp.func
def collides(houses: Houses, house: int, x: wp.float64, y: wp.float64, radius: wp.float64):
    """As `world._collides`."""
    for m in range(houses.first_rect[house], houses.first_rect[house + 1]):
        dx = wp.max(wp.max(houses.rects[m, 0] - x, x - houses.rects[m, 2]), _f(0.0))
        dy = wp.max(wp.max(houses.rects[m, 1] - y, y - houses.rects[m, 3]), _f(0.0))
        if dx * dx + dy * dy < radius * radius:
            return True
    return False


@wp.func
def travel(houses: Houses, house: int, x: wp.float64, y: wp.float64, ux: wp.float64,
           uy: wp.float64, length: wp.float64, radius: wp.float64):
    """As `world._travel`."""
    free = _f(0.0)
    while free < length:
        next_stop = wp.min(free + _step, length)
        if collides(houses, house, x + ux * next_stop, y + uy * next_stop, radius):
            low, high = free + _f(0.0), next_stop + _f(0.0)
            while high - low > _precision:
                middle = _f(0.5) * (low + high)
                if collides(houses, house, x + ux * middle, y + uy * middle, radius):
                    high = middle
                else:
                    low = middle
            return low
        free = next_stop
    return length


@wp.func
def distance_at(houses: Houses, house: int, goal: int, px: wp.float64, py: wp.float64):
    """As `house.interpolate`."""
    x = (px - houses.origin[house, 0]) / _cell - _f(0.5)
    y = (py - houses.origin[house, 1]) / _cell - _f(0.5)
    height, width = houses.maps.shape[1], houses.maps.shape[2]
    j, i = wp.int32(wp.floor(x)), wp.int32(wp.floor(y))
    if 0 <= i and i < height - 1 and 0 <= j and j < width - 1:
        a, b = houses.maps[goal, i, j], houses.maps[goal, i, j + 1]
        c, d = houses.maps[goal, i + 1, j], houses.maps[goal, i + 1, j + 1]
        if wp.max(wp.max(a, b), wp.max(c, d)) < wp.float32(1.0e30):
            u, v = x - _f(j), y - _f(i)
            one = _f(1.0)
            return ((_f(a) * (one - u) + _f(b) * u) * (one - v)
                    + (_f(c) * (one - u) + _f(d) * u) * v)
    best = _infinity
    ring = int(2)
    while best == _infinity and ring < 32:
        for p in range(wp.max(0, i - ring), wp.min(height, i + ring + 2)):
            for q in range(wp.max(0, j - ring), wp.min(width, j + ring + 2)):
                value = houses.maps[goal, p, q]
                if value < wp.float32(1.0e30):
                    gx, gy = _f(q) - x, _f(p) - y
                    best = wp.min(best, _f(value) + _cell * wp.sqrt(gx * gx + gy * gy))
        ring *= 2
    return best


@wp.func
def within(rules: Rules, row: int, env: wp.int64, episode: wp.int64, index: int):
    """A uniform draw from one of the ranges."""
    return rules.ranges[row, 0] + rules.ranges[row, 1] * uniform(
        rules.seed, _appearance_stream, env, episode, wp.int64(index))


@wp.func
def dress(robots: Robots, rules: Rules, n: int):
    """As `randomisation.draw_appearance`."""
    env, episode = wp.int64(n), robots.episode[n]
    one = _f(1.0)
    stops = wp.pow(_f(2.0), within(rules, 0, env, episode, 0))
    day, day_ratio = within(rules, 1, env, episode, 4), within(rules, 2, env, episode, 5) / _f(
        6500.0)
    lamp, lamp_ratio = within(rules, 4, env, episode, 8), within(rules, 5, env, episode, 9) / _f(
        6500.0)
    azimuth = _f(2.0) * _pi * uniform(rules.seed, _appearance_stream, env, episode, wp.int64(6))
    sun = within(rules, 3, env, episode, 7)
    day_mean = (wp.pow(day_ratio, _f(-0.55)) + one + wp.pow(day_ratio, _f(0.75))) / _f(3.0)
    lamp_mean = (wp.pow(lamp_ratio, _f(-0.55)) + one + wp.pow(lamp_ratio, _f(0.75))) / _f(3.0)
    for channel in range(3):
        gain = wp.max(stops * (one + rules.white_balance * normal(
            rules.seed, _appearance_stream, env, episode, wp.int64(1 + channel))), _f(0.05))
        day_colour, lamp_colour = _f(1.0), _f(1.0)
        if channel == 0:
            day_colour = wp.pow(day_ratio, _f(-0.55))
            lamp_colour = wp.pow(lamp_ratio, _f(-0.55))
        if channel == 2:
            day_colour = wp.pow(day_ratio, _f(0.75))
            lamp_colour = wp.pow(lamp_ratio, _f(0.75))
        for side in range(6):
            towards = _f(0.0)
            if side == 0:
                towards = wp.cos(azimuth)
            if side == 1:
                towards = -wp.cos(azimuth)
            if side == 2:
                towards = wp.sin(azimuth)
            if side == 3:
                towards = -wp.sin(azimuth)
            if side == 4:
                towards = _f(0.5)
            level = (_facing[side] * day * day_colour / day_mean
                     + wp.max(towards, _f(0.0)) * sun)
            robots.cube[n, side, channel] = wp.float32(level * gain)
        for room in range(robots.lamps.shape[1]):
            on = uniform(rules.seed, _appearance_stream, env, episode, wp.int64(32 + room))
            if on < rules.lamp_on:
                robots.lamps[n, room, channel] = wp.float32(
                    lamp * lamp_colour / lamp_mean * gain)
            else:
                robots.lamps[n, room, channel] = wp.float32(0.0)
    robots.camera_offset[n, 0] = within(rules, 7, env, episode, 11)
    robots.camera_offset[n, 1] = within(rules, 8, env, episode, 12) * _pi / _f(180.0)
    robots.camera_offset[n, 2] = within(rules, 6, env, episode, 10) * _pi / _f(180.0)
    robots.noise[n] = wp.float32(within(rules, 9, env, episode, 13))
    robots.blur[n] = wp.float32(within(rules, 10, env, episode, 14))
    robots.motion_scale[n] = rules.ranges[11, 0] + rules.ranges[11, 1] * uniform(
        rules.seed, _base_stream, env, episode, wp.int64(0))


@wp.func
def begin(houses: Houses, robots: Robots, rules: Rules, n: int):
    """A new episode, as `NavigationEnv._begin` with `tasks.ImageGoal`."""
    robots.episode[n] = robots.episode[n] + wp.int64(1)
    env, episode, zero = wp.int64(n), robots.episode[n], wp.int64(0)
    if rules.houses > rules.environments:  # one of the houses n, n + N, n + 2 N, ...
        own = (rules.houses - 1 - n) // rules.environments + 1
        turn = wp.int32(uniform(rules.seed, _house_stream, env, episode, zero) * _f(own))
        robots.house[n] = wp.int64(n + turn * rules.environments)
    house = wp.int32(robots.house[n])
    first = houses.first_goal[house]
    count = houses.first_goal[house + 1] - first
    local = wp.int32(uniform(rules.seed, _goal_stream, env, episode, zero) * _f(count))
    shown = local
    if rules.mode == 1:
        shift = 1 + wp.int32(uniform(rules.seed, _wrong_stream, env, episode, zero)
                             * _f(count - 1))
        shown = (local + shift) % count
    variant = wp.int32(uniform(rules.seed, _variant_stream, env, episode, zero)
                       * _f(rules.variants))
    goal = first + local
    robots.goal[n] = wp.int64(goal)
    robots.shown[n] = wp.int64((first + shown) * rules.variants + variant)
    robots.picture[n] = wp.int64(goal * rules.variants + variant)
    if rules.mode == 2:
        robots.shown[n] = rules.blank_goal
        robots.picture[n] = rules.blank_goal
    low, high = houses.first_cell[goal], houses.first_cell[goal + 1]
    limit = rules.tau * houses.cell_distance[high - 1]
    left, right = low + 0, high + 0  # the first cell beyond the limit
    while left < right:
        middle = (left + right) // 2
        if houses.cell_distance[middle] <= limit:
            left = middle + 1
        else:
            right = middle
    cells = wp.max(left - low, 1)
    cell = low + wp.int32(uniform(rules.seed, _cell_stream, env, episode, zero) * _f(cells))
    robots.pose[n, 0] = houses.cells[cell, 0]
    robots.pose[n, 1] = houses.cells[cell, 1]
    robots.pose[n, 2] = (uniform(rules.seed, _yaw_stream, env, episode, zero) * _f(2.0)
                         - _f(1.0)) * _pi
    robots.pose[n, 3] = _f(0.0)
    dress(robots, rules, n)
    robots.step[n] = zero
    robots.path_length[n] = _f(0.0)
    robots.last_action[n] = wp.int64(-1)
    robots.last_reward[n] = wp.float32(0.0)
    robots.distance[n] = distance_at(houses, house, goal, robots.pose[n, 0], robots.pose[n, 1])
    robots.start_distance[n] = robots.distance[n]


@wp.func
def compare(houses: Houses, robots: Robots, n: int):
    """Where the goal is from here: `tasks.arrived` and `co_visibility.relative_pose`."""
    goal = wp.int32(robots.goal[n])
    yaw = robots.pose[n, 2]
    turn = houses.goal_pose[goal, 2] - yaw
    robots.heading_error[n] = wp.abs(wrap(yaw - houses.goal_pose[goal, 2]))
    robots.arrived[n] = (robots.distance[n] <= _arrival_radius
                         and robots.heading_error[n] <= _arrival_heading)
    x = houses.goal_pose[goal, 0] - robots.pose[n, 0]
    y = houses.goal_pose[goal, 1] - robots.pose[n, 1]
    c, s = wp.cos(yaw), wp.sin(yaw)
    robots.goal_pose[n, 0] = wp.float32(c * x + s * y)
    robots.goal_pose[n, 1] = wp.float32(c * y - s * x)
    robots.goal_pose[n, 2] = wp.float32(wp.cos(turn))
    robots.goal_pose[n, 3] = wp.float32(wp.sin(turn))


@wp.func
def aim(robots: Robots, rules: Rules, n: int):
    """Where the camera is and looks."""
    robots.camera[n, 0] = robots.pose[n, 0]
    robots.camera[n, 1] = robots.pose[n, 1]
    robots.camera[n, 2] = rules.camera_height + robots.camera_offset[n, 0]
    robots.camera[n, 3] = robots.pose[n, 2]
    robots.camera[n, 4] = robots.pose[n, 3] + rules.camera_pitch + robots.camera_offset[n, 1]
    fov = rules.camera_fov + robots.camera_offset[n, 2]
    robots.focal[n] = rules.size / _f(2.0) / wp.tan(fov / _f(2.0))
    robots.sensor_key[n] = bits(rules.seed, _sensor_stream, wp.int64(n), robots.episode[n],
                                robots.step[n])


@wp.kernel
def restart(houses: Houses, robots: Robots, rules: Rules):
    """New episodes everywhere."""
    n = wp.tid()
    begin(houses, robots, rules, n)
    robots.reset[n] = True
    robots.collided[n] = False
    robots.terminated[n] = False
    robots.truncated[n] = False
    robots.reward[n] = wp.float32(0.0)
    compare(houses, robots, n)
    aim(robots, rules, n)


@wp.kernel
def decide(houses: Houses, robots: Robots, rules: Rules, deltas: wp.array2d(dtype=wp.float64),
           actions: wp.array(dtype=wp.int64)):
    """One decision in every environment, as `NavigationEnv.step`."""
    n = wp.tid()
    robots.collided[n] = False
    robots.reset[n] = robots.terminated[n] or robots.truncated[n]
    if robots.reset[n]:
        begin(houses, robots, rules, n)
        robots.terminated[n] = False
        robots.truncated[n] = False
        robots.reward[n] = wp.float32(0.0)
        compare(houses, robots, n)
        aim(robots, rules, n)
        return
    env, episode, step = wp.int64(n), robots.episode[n], robots.step[n]
    house, action = wp.int32(robots.house[n]), wp.int32(actions[n])
    none = _f(0.0)  # added to what is read below: a copy, not a reference into the array
    dx, dy = deltas[action, 0] + none, deltas[action, 1] + none
    dyaw, dpitch = deltas[action, 2] + none, deltas[action, 3] + none
    length = wp.sqrt(dx * dx + dy * dy)
    if rules.motion_noise == 1:
        number = normal(rules.seed, _noise_stream, env, episode, step)
        if length > _f(0.0):
            scale = _f(1.0) + _translation_noise * number / length
            dx, dy = dx * scale, dy * scale
        elif dyaw != _f(0.0):
            dyaw = dyaw + _rotation_noise * number
    share = robots.motion_scale[n] + none
    if rules.slip > _f(0.0):
        if uniform(rules.seed, _slip_stream, env, episode, step) < rules.slip:
            part = bits(rules.seed, _slip_stream, env, episode, step) % wp.uint64(1000)
            share = _f(part) / _f(1000.0) * share
    dx, dy, dyaw = dx * share, dy * share, dyaw * share
    length = wp.sqrt(dx * dx + dy * dy)
    x, y, yaw = (robots.pose[n, 0] + none, robots.pose[n, 1] + none,
                 robots.pose[n, 2] + none)
    if length > _f(0.0):
        heading = yaw + _f(0.5) * dyaw
        c, s = wp.cos(heading), wp.sin(heading)
        ux, uy = (c * dx - s * dy) / length, (s * dx + c * dy) / length
        travelled = travel(houses, house, x, y, ux, uy, length, rules.radius)
        robots.collided[n] = travelled < length
        robots.pose[n, 0] = x + ux * travelled
        robots.pose[n, 1] = y + uy * travelled
        robots.path_length[n] = robots.path_length[n] + travelled
    robots.pose[n, 2] = wrap(yaw + dyaw)
    robots.pose[n, 3] = wp.clamp(robots.pose[n, 3] + dpitch, -_max_tilt, _max_tilt)
    goal = wp.int32(robots.goal[n])
    before = robots.distance[n] + none
    after = distance_at(houses, house, goal, robots.pose[n, 0], robots.pose[n, 1])
    robots.distance[n] = after
    compare(houses, robots, n)
    success = robots.arrived[n]
    sparse = wp.float32(0.0)
    shaping = rules.progress * (before - after)
    if robots.collided[n]:
        shaping = shaping + rules.collision
    if success:
        sparse = wp.float32(1.0)
        shaping = shaping + rules.goal_bonus
    else:
        shaping = shaping + rules.step_reward
    robots.reward[n] = sparse + wp.float32(shaping)
    robots.last_action[n] = actions[n]
    robots.last_reward[n] = sparse
    robots.step[n] = step + wp.int64(1)
    robots.terminated[n] = success
    robots.truncated[n] = (not success) and robots.step[n] >= rules.max_decisions
    aim(robots, rules, n)


@wp.kernel
def share_in_view(points: wp.array3d(dtype=wp.float32), picture: wp.array(dtype=wp.int64),
                  depth: wp.array3d(dtype=wp.float32), camera: wp.array2d(dtype=wp.float64),
                  focal: wp.array(dtype=wp.float64), share: wp.array(dtype=wp.float32)):
    """As `co_visibility.co_visible`, of the points of each robot's goal picture."""
    n = wp.tid()
    goal, size = wp.int32(picture[n]), depth.shape[1]
    frame = camera_frame(camera, n)
    half = wp.float64(size) * _f(0.5)
    known, seen = int(0), int(0)
    for p in range(points.shape[1]):
        if not wp.isnan(points[goal, p, 0]):
            known += 1
            x = _f(points[goal, p, 0]) - frame[0]
            y = _f(points[goal, p, 1]) - frame[1]
            z = _f(points[goal, p, 2]) - frame[2]
            ahead = x * frame[3] + y * frame[4] + z * frame[5]
            if ahead > _f(0.0):
                scale = focal[n] / ahead
                column = wp.floor((x * frame[6] + y * frame[7]) * scale + half)
                row = wp.floor((x * frame[9] + y * frame[10] + z * frame[11]) * scale + half)
                inside = _f(size)
                if (_f(0.0) <= column and column < inside and _f(0.0) <= row and row < inside):
                    gap = wp.abs(ahead - _f(depth[n, wp.int32(row), wp.int32(column)]))
                    if gap <= _tolerance * ahead + _slack:
                        seen += 1
    share[n] = wp.float32(0.0)
    if known > 0:
        share[n] = wp.float32(_f(seen) / _f(known))


def _variables(struct: type) -> dict[str, Any]:
    """Of a struct, by name."""
    return struct.vars  # type: ignore[attr-defined]  # `wp.struct` adds it, and Warp is not typed


class WarpNavigationEnv:
    """Image-goal navigation on one device; see `NavigationEnv` for what it simulates.

    `reset` and `step` return the same dicts as `NavigationEnv` does, of tensors that live on the
    device and change in place with the next step. They work on the stream that is PyTorch's at
    construction, so that neither waits for the other. `goals` and `goal_segmentation` are tensors
    there too.

    Args:
        config: task 'image', without late pictures, and no teacher among the privileged.
        robot: the standard robot if left out.
        device: Warp device, such as 'cuda:0' or 'cpu'.
    """

    def __init__(self, config: EnvConfig | None = None, robot: RobotSpec | None = None, *,
                 device: str = 'cuda:0'):
        self.config = config = config or EnvConfig()
        if config.task != 'image' or config.one_goal_per_env:
            raise UserError('the device runs the image task with goals drawn each episode',
                            config.task, 'use NavigationEnv')
        if config.stop != 'arrival' or config.exploration_reward:
            raise UserError('on the device episodes end on arrival, and new floor pays nothing',
                            (config.stop, config.exploration_reward), 'use NavigationEnv')
        if teachers := sorted(set(config.privileged) & set(TEACHERS)):
            raise UserError('teachers plan on the CPU: the device tells no actions to imitate',
                            ', '.join(teachers), 'set imitation=0 and teacher_share=0 (--set '
                            'NAME=VALUE), or train on the CPU')
        if config.randomisation.late_picture:
            raise UserError('pictures are never late on the device',
                            config.randomisation.late_picture, 'use NavigationEnv')
        simulator, scenes = one_simulator(config.scenes)
        if simulator != HOUSE:
            raise UserError('the device draws embedded houses', simulator, 'use NavigationEnv')
        self.robot = (robot or RobotSpec()).with_actions(config.actions)
        self.num_envs, self.device = config.num_envs, device
        if wp.get_device(device).is_cuda:
            wp.set_stream(wp.stream_from_torch(wp.device_to_torch(device)), device)
        self.world_version, self.action_names = WORLD_VERSION, self.robot.action_names
        self.simulator_name, self.label_names = HOUSE, LABELS
        self.places = open_houses(scenes, config.goals_per_room, config.goal_seed)
        if self.robot.footprint_radius > min(h.footprint_radius for h in self.places):
            raise UserError('the robot fits into the floor map of the house',
                            self.robot.footprint_radius, 'use a smaller robot')
        task = tasks.ImageGoal(self.places, self.num_envs, min_distance=config.min_start_distance)
        self.goal_rooms = tuple(view.name for view in task.views)
        self.goal_poses = np.array([view.pose for view in task.views])
        drawn = [house.scene for house in self.places]
        self.renderer = WarpRenderer(drawn, config.size, self.num_envs, device=device)
        self._houses = self._upload_houses(task)
        self._rules = self._make_rules()
        self._robots = self._make_robots()
        self._deltas = self._put([[a.dx, a.dy, a.dyaw, a.dpitch] for a in self.robot.actions],
                                 np.float64)
        self._absent = (self._put(np.zeros((self.num_envs, 0)), np.int64),
                        self._put(np.zeros((self.num_envs, 0, 4)), np.float64),
                        self._put(np.zeros((self.num_envs, 0)), np.int64))
        self._overlap = wp.zeros(self.num_envs, dtype=wp.float32, device=device)
        self._draw_goals(task, drawn)
        self._state = {name: wp.to_torch(getattr(self._robots, name))
                       for name in _variables(Robots) if name not in NOT_STATE}
        self._drawn = {name: wp.to_torch(getattr(self.renderer, name))
                       for name in ('rgb', 'depth', 'labels')}
        self._in_view = wp.to_torch(self._overlap)

    def _put(self, values, dtype) -> wp.array:
        return wp.array(np.ascontiguousarray(values, dtype), device=self.device)

    def _upload_houses(self, task: tasks.ImageGoal) -> Houses:
        fields = list(map(task.goal_field, range(len(task.views))))
        solved = [over_floor(entry.field).values for entry in fields]
        shapes = [values.shape for values in solved]
        maps = np.full((len(fields), max(s[0] for s in shapes), max(s[1] for s in shapes)), np.inf,
                       np.float32)
        for k, values in enumerate(solved):
            maps[k, :shapes[k][0], :shapes[k][1]] = values
        out = Houses()
        out.rects = self._put(np.concatenate([h.obstacle_rects for h in self.places]), np.float64)
        out.first_rect = self._put(
            np.cumsum([0] + [len(h.obstacles) for h in self.places]), np.int32)
        out.origin = self._put([h.floor.origin for h in self.places], np.float64)
        out.first_goal = self._put(np.cumsum([0] + [count for _, count in task.ranges]), np.int32)
        out.goal_pose = self._put(self.goal_poses, np.float64)
        out.maps = self._put(maps, np.float32)
        out.cells = self._put(np.concatenate([e.starts.cells for e in fields]), np.float64)
        out.cell_distance = self._put(np.concatenate([e.starts.distances for e in fields]),
                                      np.float64)
        out.first_cell = self._put(np.cumsum([0] + [len(e.starts.cells) for e in fields]),
                                   np.int32)
        return out

    def _make_rules(self) -> Rules:
        config, varied, robot = self.config, self.config.randomisation, self.robot
        rules = Rules()
        rules.seed, rules.mode, rules.tau = config.seed, 0, 1.0
        rules.variants = config.pictures_per_goal
        rules.environments, rules.houses = self.num_envs, len(self.places)
        rules.blank_goal = len(self.goal_poses) * rules.variants
        rules.max_decisions = config.max_decisions
        rules.motion_noise = int(config.noise)
        rules.progress, rules.collision = config.progress_reward, config.collision_reward
        rules.step_reward, rules.goal_bonus = config.step_reward, config.goal_bonus
        rules.radius, rules.camera_height = robot.footprint_radius, robot.camera_height
        rules.camera_pitch, rules.camera_fov = robot.camera_pitch, robot.camera_fov
        rules.size, rules.slip = config.size, varied.slip
        rules.white_balance, rules.lamp_on = varied.white_balance, varied.lamp_on
        ranges = [varied.exposure, varied.daylight, varied.daylight_kelvin, varied.sun,
                  varied.lamp, varied.lamp_kelvin, varied.fov_deg, varied.height,
                  varied.pitch_deg, varied.noise, varied.blur, varied.motion_scale]
        rules.ranges = self._put([(low, high - low) for low, high in ranges], np.float64)
        return rules

    def _make_robots(self) -> Robots:
        n, rooms = self.num_envs, self.renderer.rooms
        shapes = {'pose': (n, 4), 'camera': (n, 5), 'camera_offset': (n, 3), 'cube': (n, 6, 3),
                  'lamps': (n, rooms, 3), 'goal_pose': (n, 4)}
        robots = Robots()
        for name, variable in _variables(Robots).items():
            setattr(robots, name, wp.zeros(shapes.get(name, (n,)), dtype=variable.type.dtype,
                                           device=self.device))
        robots.house = self._put(np.arange(n) % len(self.places), np.int64)
        robots.episode.fill_(-1)
        return robots

    def _draw_goals(self, task: tasks.ImageGoal, scenes: Sequence[Scene]) -> None:
        """Every goal's pictures, in the lights that `NavigationEnv` shows them in."""
        varied, size, variants = self.config.randomisation, self.config.size, self._rules.variants
        goal = np.repeat(np.arange(len(task.views)), variants)
        variant = np.tile(np.arange(variants), len(task.views))
        look = draw_appearance(varied, self.renderer.rooms, self.config.seed,
                               Stream.GOAL_APPEARANCE, goal, variant)
        poses = self.goal_poses[goal]
        cameras = np.column_stack([
            poses[:, :2], self.robot.camera_height + look.height, poses[:, 2],
            poses[:, 3] + self.robot.camera_pitch + look.pitch])
        focal = size / 2 / np.tan((self.robot.camera_fov + look.fov) / 2)
        painter = WarpRenderer(scenes, size, len(goal), device=self.device)
        none = np.zeros((len(goal), 0))
        sensor = {}
        if varied.noise[1] > 0 or varied.blur[1] > 0:
            sensor = {'noise': self._put(look.noise, np.float32),
                      'blur': self._put(look.blur, np.float32),
                      'keys': self._put(key(self.config.seed, Stream.GOAL_APPEARANCE, goal,
                                            variant, 99), np.uint64)}
        painter.render(
            self._put([task.views[k].place for k in goal], np.int64),
            self._put(cameras, np.float64), self._put(focal, np.float64),
            self._put(look.cube, np.float32), self._put(look.lamps, np.float32),
            object_scene=self._put(none, np.int64),
            object_pose=self._put(np.zeros((len(goal), 0, 4)), np.float64),
            object_room=self._put(none, np.int64), **sensor)
        grey = torch.full((1, 3, size, size), 128, dtype=torch.uint8,
                          device=wp.device_to_torch(self.device))
        self.goals = torch.cat([wp.to_torch(painter.rgb), grey])
        self.goal_segmentation = torch.cat([wp.to_torch(painter.labels),
                                            torch.zeros_like(grey[:, 0])])
        self.blank_goal = len(goal)
        if 'overlap' in self.config.privileged:
            points = lift(painter.depth.numpy(), cameras, self.robot.camera_fov + look.fov)
            nowhere = np.full((1, GRID * GRID, 3), np.nan)
            self._goal_points = self._put(np.concatenate([points, nowhere]), np.float32)

    def set_difficulty(self, tau: float) -> None:
        """As `NavigationEnv.set_difficulty`."""
        if not 0 < tau <= 1:
            raise UserError('the difficulty tau lies in (0, 1]', tau, 'choose a value in range')
        self._rules.tau = float(tau)

    def set_shown_goal(self, mode: str) -> None:
        """As `NavigationEnv.set_shown_goal`."""
        if mode not in MODES:
            raise UserError('the shown goal is right, wrong or blank', mode, 'choose one of them')
        if mode == tasks.WRONG and min(len(house.goals) for house in self.places) < 2:
            raise UserError('a wrong goal needs a place with at least two goals',
                            ', '.join(self.config.scenes), 'use larger scenes')
        self._rules.mode = MODES[mode]

    def reset(self, *, seed: int | None = None, options: dict | None = None):
        """Start a new episode everywhere; a seed also restarts the count of episodes.

        Raises:
            UserError: a list of seeds, or a `reset_mask`, which `NavigationEnv` knows.
        """
        if 'reset_mask' in read_options(options, ('reset_mask',)) or are_several(seed):
            raise UserError('on a GPU all environments begin together, by one seed',
                            seed if options is None else options, 'use NavigationEnv')
        seed = read_seed(seed)
        if seed is not None:
            self._rules.seed = seed
            self._robots.episode.fill_(-1)
        wp.launch(restart, self.num_envs, [self._houses, self._robots, self._rules],
                  device=self.device)
        return self._observe()

    def step(self, actions: torch.Tensor):
        """One decision in every environment that is not being reset.

        Args:
            actions: [N] int64 on the device; they are not checked there: keep them in range.
        """
        if actions.shape != (self.num_envs,) or actions.dtype != torch.int64:
            raise UserError(f'actions are {self.num_envs} 64-bit integers',
                            (tuple(actions.shape), actions.dtype), 'pass such a tensor')
        wp.launch(decide, self.num_envs, [self._houses, self._robots, self._rules, self._deltas,
                                          wp.from_torch(actions.contiguous())],
                  device=self.device)
        observation, info = self._observe()
        state = self._state
        return observation, state['reward'], state['terminated'], state['truncated'], info

    @property
    def place_index(self) -> torch.Tensor:
        """[N] the house of each robot."""
        return self._state['house']

    restorable = True  # see `NavigationEnv.restorable`
    distance_unit = 'm'  # see `NavigationEnv.distance_unit`

    def close(self) -> None:
        """Nothing is held beyond the arrays, which go with this object."""

    def get_state(self) -> dict[str, np.ndarray]:
        """As `NavigationEnv.get_state`; this waits for the device."""
        return {'seed': np.array(self._rules.seed),
                **{name: rows.cpu().numpy().copy() for name, rows in self._state.items()}}

    def set_state(self, state: dict[str, np.ndarray]) -> None:
        """Stand where `get_state` was taken."""
        self._rules.seed = int(state['seed'])
        for name, rows in self._state.items():
            rows.copy_(torch.from_numpy(state[name]))

    def _observe(self):
        robots, varied, state = self._robots, self.config.randomisation, self._state
        sensor = {}
        if varied.noise[1] > 0 or varied.blur[1] > 0:
            sensor = {'noise': robots.noise, 'blur': robots.blur, 'keys': robots.sensor_key}
        scene, pose, room = self._absent
        self.renderer.render(robots.house, robots.camera, robots.focal, robots.cube, robots.lamps,
                             object_scene=scene, object_pose=pose, object_room=room, **sensor)
        observation = {
            'image': self._drawn['rgb'],
            'goal_index': state['shown'],
            'last_action': state['last_action'],
            'last_reward': state['last_reward'],
        }
        info = {
            'reset': state['reset'],
            'success': state['terminated'],
            'arrived': state['arrived'],
            'collided': state['collided'],
            **{name: state[name].float()
               for name in ('distance', 'heading_error', 'start_distance', 'path_length')},
            'decisions': state['step'],
            'goal': state['goal'],
            'pose': state['pose'],
            'depth': self._drawn['depth'],
            'segmentation': self._drawn['labels'],
        }
        wanted = self.config.privileged
        if 'goal_segmentation' in wanted:
            info['goal_segmentation'] = self.goal_segmentation[state['shown']]
        if 'goal_pose' in wanted:
            info['goal_pose'] = state['goal_pose']
        if 'overlap' in wanted:
            wp.launch(share_in_view, self.num_envs, [
                self._goal_points, robots.picture, self.renderer.depth, robots.camera,
                robots.focal, self._overlap], device=self.device)
            info['overlap'] = self._in_view
        return observation, info

"""A new episode on a Warp device: house, goal, start, light and base, as `episodes` draws them."""

from __future__ import annotations

import math

import warp as wp

from vn_sim_bridge.counter_random import Stream
from vn_sim_bridge.navigation.warp_motion import distance_at
from vn_sim_bridge.navigation.warp_random import normal, uniform
from vn_sim_bridge.navigation.warp_state import Houses, Robots, Rules
from vn_sim_bridge.render.pack import FACING

wp.set_module_options({'enable_backward': False, 'fast_math': False})

_f64 = wp.float64
_pi = wp.constant(wp.float64(math.pi))
_goal_stream = wp.constant(int(Stream.GOAL))
_cell_stream = wp.constant(int(Stream.START_CELL))
_yaw_stream = wp.constant(int(Stream.START_YAW))
_wrong_stream = wp.constant(int(Stream.WRONG_GOAL))
_appearance_stream = wp.constant(int(Stream.APPEARANCE))
_variant_stream = wp.constant(int(Stream.GOAL_VARIANT))
_base_stream = wp.constant(int(Stream.BASE))
_house_stream = wp.constant(int(Stream.HOUSE))
_facing = wp.constant(wp.types.vector(6, wp.float64)(*map(float, FACING)))


@wp.func
def within(rules: Rules, row: int, env: wp.int64, episode: wp.int64, index: int):
    """A uniform number from row `row` of `Rules.ranges`; `index` tells draws apart."""
    return rules.ranges[row, 0] + rules.ranges[row, 1] * uniform(
        rules.seed, _appearance_stream, env, episode, wp.int64(index))


@wp.func
def draw_appearance(robots: Robots, rules: Rules, n: int):
    """Light, camera and base of an episode, as `randomisation.draw_appearance`."""
    env, episode = wp.int64(n), robots.episode[n]
    one = _f64(1.0)
    stops = wp.pow(_f64(2.0), within(rules, 0, env, episode, 0))
    day, day_ratio = within(rules, 1, env, episode, 4), within(rules, 2, env, episode, 5) / _f64(
        6500.0)
    lamp, lamp_ratio = within(rules, 4, env, episode, 8), within(rules, 5, env, episode, 9) / _f64(
        6500.0)
    azimuth = _f64(2.0) * _pi * uniform(rules.seed, _appearance_stream, env, episode, wp.int64(6))
    sun = within(rules, 3, env, episode, 7)
    three = _f64(3.0)
    day_mean = (wp.pow(day_ratio, _f64(-0.55)) + one + wp.pow(day_ratio, _f64(0.75))) / three
    lamp_mean = (wp.pow(lamp_ratio, _f64(-0.55)) + one + wp.pow(lamp_ratio, _f64(0.75))) / three
    for channel in range(3):
        gain = wp.max(stops * (one + rules.white_balance * normal(
            rules.seed, _appearance_stream, env, episode, wp.int64(1 + channel))), _f64(0.05))
        day_colour, lamp_colour = _f64(1.0), _f64(1.0)
        if channel == 0:
            day_colour = wp.pow(day_ratio, _f64(-0.55))
            lamp_colour = wp.pow(lamp_ratio, _f64(-0.55))
        if channel == 2:
            day_colour = wp.pow(day_ratio, _f64(0.75))
            lamp_colour = wp.pow(lamp_ratio, _f64(0.75))
        for side in range(6):
            towards = _f64(0.0)
            if side == 0:
                towards = wp.cos(azimuth)
            if side == 1:
                towards = -wp.cos(azimuth)
            if side == 2:
                towards = wp.sin(azimuth)
            if side == 3:
                towards = -wp.sin(azimuth)
            if side == 4:
                towards = _f64(0.5)
            level = (_facing[side] * day * day_colour / day_mean
                     + wp.max(towards, _f64(0.0)) * sun)
            robots.cube[n, side, channel] = wp.float32(level * gain)
        for room in range(robots.lamps.shape[1]):
            on = uniform(rules.seed, _appearance_stream, env, episode, wp.int64(32 + room))
            if on < rules.lamp_on:
                robots.lamps[n, room, channel] = wp.float32(
                    lamp * lamp_colour / lamp_mean * gain)
            else:
                robots.lamps[n, room, channel] = wp.float32(0.0)
    robots.camera_offset[n, 0] = within(rules, 7, env, episode, 11)
    robots.camera_offset[n, 1] = within(rules, 8, env, episode, 12) * _pi / _f64(180.0)
    robots.camera_offset[n, 2] = within(rules, 6, env, episode, 10) * _pi / _f64(180.0)
    robots.noise[n] = wp.float32(within(rules, 9, env, episode, 13))
    robots.blur[n] = wp.float32(within(rules, 10, env, episode, 14))
    robots.motion_scale[n] = rules.ranges[11, 0] + rules.ranges[11, 1] * uniform(
        rules.seed, _base_stream, env, episode, wp.int64(0))


@wp.func
def begin_episode(houses: Houses, robots: Robots, rules: Rules, n: int):
    """A new episode, as `NavigationEnv._begin` with `tasks.ImageGoal`."""
    robots.episode[n] = robots.episode[n] + wp.int64(1)
    env, episode, zero = wp.int64(n), robots.episode[n], wp.int64(0)
    if rules.houses > rules.environments:  # one of the houses n, n + N, n + 2 N, ...
        own = (rules.houses - 1 - n) // rules.environments + 1
        turn = wp.int32(uniform(rules.seed, _house_stream, env, episode, zero) * _f64(own))
        robots.house[n] = wp.int64(n + turn * rules.environments)
    house = wp.int32(robots.house[n])
    first = houses.first_goal[house]
    count = houses.first_goal[house + 1] - first
    local = wp.int32(uniform(rules.seed, _goal_stream, env, episode, zero) * _f64(count))
    shown = local
    if rules.mode == 1:
        shift = 1 + wp.int32(uniform(rules.seed, _wrong_stream, env, episode, zero)
                             * _f64(count - 1))
        shown = (local + shift) % count
    variant = wp.int32(uniform(rules.seed, _variant_stream, env, episode, zero)
                       * _f64(rules.variants))
    goal = first + local
    robots.goal[n] = wp.int64(goal)
    robots.shown[n] = wp.int64((first + shown) * rules.variants + variant)
    robots.picture[n] = wp.int64(goal * rules.variants + variant)
    if rules.mode == 2:
        robots.shown[n] = rules.blank_goal
        robots.picture[n] = rules.blank_goal
    low, high = houses.first_cell[goal], houses.first_cell[goal + 1]
    limit = rules.difficulty * houses.cell_distance[high - 1]
    left, right = low + 0, high + 0  # the first cell beyond the limit
    while left < right:
        middle = (left + right) // 2
        if houses.cell_distance[middle] <= limit:
            left = middle + 1
        else:
            right = middle
    cells = wp.max(left - low, 1)
    cell = low + wp.int32(uniform(rules.seed, _cell_stream, env, episode, zero) * _f64(cells))
    robots.pose[n, 0] = houses.cells[cell, 0]
    robots.pose[n, 1] = houses.cells[cell, 1]
    robots.pose[n, 2] = (uniform(rules.seed, _yaw_stream, env, episode, zero) * _f64(2.0)
                         - _f64(1.0)) * _pi
    robots.pose[n, 3] = _f64(0.0)
    draw_appearance(robots, rules, n)
    robots.step[n] = zero
    robots.path_length[n] = _f64(0.0)
    robots.last_action[n] = wp.int64(-1)
    robots.last_reward[n] = wp.float32(0.0)
    robots.distance[n] = distance_at(houses, house, goal, robots.pose[n, 0], robots.pose[n, 1])
    robots.start_distance[n] = robots.distance[n]

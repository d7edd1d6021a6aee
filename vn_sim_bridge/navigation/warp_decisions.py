"""The kernels of `WarpNavigationEnv`: a new episode, a decision, co-visibility with the goal."""

from __future__ import annotations

import warp as wp

from vn_nav.co_visibility import SLACK, TOLERANCE
from vn_nav.robot import MAX_TILT
from vn_sim_bridge.counter_random import Stream
from vn_sim_bridge.floor.contacts import ROTATION_NOISE, TRANSLATION_NOISE
from vn_sim_bridge.navigation import tasks
from vn_sim_bridge.navigation.warp_episodes import begin_episode
from vn_sim_bridge.navigation.warp_motion import distance_at, travel, wrap
from vn_sim_bridge.navigation.warp_random import bits, normal, uniform
from vn_sim_bridge.navigation.warp_state import Houses, Robots, Rules
from vn_sim_bridge.render.warp_visibility import camera_frame

wp.set_module_options({'enable_backward': False, 'fast_math': False})

_f64 = wp.float64
_noise_stream = wp.constant(int(Stream.MOTION_NOISE))
_sensor_stream = wp.constant(int(Stream.SENSOR))
_slip_stream = wp.constant(int(Stream.SLIP))
_translation_noise = wp.constant(wp.float64(TRANSLATION_NOISE))
_rotation_noise = wp.constant(wp.float64(ROTATION_NOISE))
_max_tilt = wp.constant(wp.float64(MAX_TILT))
_arrival_radius = wp.constant(wp.float64(tasks.ARRIVAL_RADIUS))
_arrival_heading = wp.constant(wp.float64(tasks.ARRIVAL_HEADING))
_tolerance = wp.constant(wp.float64(TOLERANCE))
_slack = wp.constant(wp.float64(SLACK))


@wp.func
def locate_goal(houses: Houses, robots: Robots, n: int):
    """The goal as the robot sees it, as `tasks.arrived` and `co_visibility.relative_pose`."""
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
def aim_camera(robots: Robots, rules: Rules, n: int):
    """Position and direction of the camera, its focal length and its noise's key."""
    robots.camera[n, 0] = robots.pose[n, 0]
    robots.camera[n, 1] = robots.pose[n, 1]
    robots.camera[n, 2] = rules.camera_height + robots.camera_offset[n, 0]
    robots.camera[n, 3] = robots.pose[n, 2]
    robots.camera[n, 4] = robots.pose[n, 3] + rules.camera_pitch + robots.camera_offset[n, 1]
    fov = rules.camera_fov + robots.camera_offset[n, 2]
    robots.focal[n] = rules.size / _f64(2.0) / wp.tan(fov / _f64(2.0))
    robots.sensor_key[n] = bits(rules.seed, _sensor_stream, wp.int64(n), robots.episode[n],
                                robots.step[n])


@wp.kernel
def restart(houses: Houses, robots: Robots, rules: Rules):
    """New episodes everywhere."""
    n = wp.tid()
    begin_episode(houses, robots, rules, n)
    robots.reset[n] = True
    robots.collided[n] = False
    robots.terminated[n] = False
    robots.truncated[n] = False
    robots.reward[n] = wp.float32(0.0)
    locate_goal(houses, robots, n)
    aim_camera(robots, rules, n)


@wp.kernel
def decide(houses: Houses, robots: Robots, rules: Rules, deltas: wp.array2d(dtype=wp.float64),
           actions: wp.array(dtype=wp.int64)):
    """One decision in every environment, as `NavigationEnv.step`."""
    n = wp.tid()
    robots.collided[n] = False
    robots.reset[n] = robots.terminated[n] or robots.truncated[n]
    if robots.reset[n]:
        begin_episode(houses, robots, rules, n)
        robots.terminated[n] = False
        robots.truncated[n] = False
        robots.reward[n] = wp.float32(0.0)
        locate_goal(houses, robots, n)
        aim_camera(robots, rules, n)
        return
    env, episode, step = wp.int64(n), robots.episode[n], robots.step[n]
    house, action = wp.int32(robots.house[n]), wp.int32(actions[n])
    # Added to what is read below: Warp then makes a copy, not a reference into the array.
    zero = _f64(0.0)
    dx, dy = deltas[action, 0] + zero, deltas[action, 1] + zero
    dyaw, dpitch = deltas[action, 2] + zero, deltas[action, 3] + zero
    length = wp.sqrt(dx * dx + dy * dy)
    if rules.motion_noise > _f64(0.0):
        number = rules.motion_noise * normal(rules.seed, _noise_stream, env, episode, step)
        if length > _f64(0.0):
            scale = _f64(1.0) + _translation_noise * number / length
            dx, dy = dx * scale, dy * scale
        elif dyaw != _f64(0.0):
            dyaw = dyaw + _rotation_noise * number
    share = robots.motion_scale[n] + zero
    if rules.slip > _f64(0.0):
        if uniform(rules.seed, _slip_stream, env, episode, step) < rules.slip:
            part = bits(rules.seed, _slip_stream, env, episode, step) % wp.uint64(1000)
            share = _f64(part) / _f64(1000.0) * share
    dx, dy, dyaw = dx * share, dy * share, dyaw * share
    length = wp.sqrt(dx * dx + dy * dy)
    x, y, yaw = (robots.pose[n, 0] + zero, robots.pose[n, 1] + zero,
                 robots.pose[n, 2] + zero)
    if length > _f64(0.0):
        heading = yaw + _f64(0.5) * dyaw
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
    before = robots.distance[n] + zero
    after = distance_at(houses, house, goal, robots.pose[n, 0], robots.pose[n, 1])
    robots.distance[n] = after
    locate_goal(houses, robots, n)
    success = robots.arrived[n]
    sparse = wp.float32(0.0)
    shaping = _f64(0.0)
    if wp.isfinite(before) and wp.isfinite(after):
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
    aim_camera(robots, rules, n)


@wp.kernel
def share_in_view(points: wp.array3d(dtype=wp.float32), picture: wp.array(dtype=wp.int64),
                  depth: wp.array3d(dtype=wp.float32), camera: wp.array2d(dtype=wp.float64),
                  focal: wp.array(dtype=wp.float64), share: wp.array(dtype=wp.float32)):
    """As `co_visibility.co_visible`, of the points of each robot's goal picture."""
    n = wp.tid()
    goal, size = wp.int32(picture[n]), depth.shape[1]
    frame = camera_frame(camera, n)
    half = wp.float64(size) * _f64(0.5)
    known, seen = int(0), int(0)
    for p in range(points.shape[1]):
        if not wp.isnan(points[goal, p, 0]):
            known += 1
            x = _f64(points[goal, p, 0]) - frame[0]
            y = _f64(points[goal, p, 1]) - frame[1]
            z = _f64(points[goal, p, 2]) - frame[2]
            ahead = x * frame[3] + y * frame[4] + z * frame[5]
            if ahead > _f64(0.0):
                scale = focal[n] / ahead
                column = wp.floor((x * frame[6] + y * frame[7]) * scale + half)
                row = wp.floor((x * frame[9] + y * frame[10] + z * frame[11]) * scale + half)
                inside = _f64(size)
                if (_f64(0.0) <= column and column < inside and _f64(0.0) <= row and row < inside):
                    gap = wp.abs(ahead - _f64(depth[n, wp.int32(row), wp.int32(column)]))
                    if gap <= _tolerance * ahead + _slack:
                        seen += 1
    share[n] = wp.float32(0.0)
    if known > 0:
        share[n] = wp.float32(_f64(seen) / _f64(known))

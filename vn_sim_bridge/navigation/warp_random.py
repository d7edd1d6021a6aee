"""`counter_random` as functions for Warp's kernels: the same key gives the same number."""

from __future__ import annotations

import math

import warp as wp

wp.set_module_options({'enable_backward': False, 'fast_math': False})

_f64 = wp.float64
_to_unit = wp.constant(wp.float64(2.0**-53))
_to_angle = wp.constant(wp.float64(2.0**-52 * math.pi))
_gamma = wp.constant(wp.uint64(0x9E3779B97F4A7C15))
_mix_1 = wp.constant(wp.uint64(0xBF58476D1CE4E5B9))
_mix_2 = wp.constant(wp.uint64(0x94D049BB133111EB))


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
    return _f64(bits(seed, stream, env, episode, step) >> wp.uint64(11)) * _to_unit


@wp.func
def normal(seed: wp.int64, stream: int, env: wp.int64, episode: wp.int64, step: wp.int64):
    """As `counter_random.normal`."""
    state = bits(seed, stream, env, episode, step)
    first = mix(state, wp.int64(0)) >> wp.uint64(11)
    second = mix(state, wp.int64(1)) >> wp.uint64(11)
    radius = wp.sqrt(_f64(-2.0) * wp.log(_f64(first + wp.uint64(1)) * _to_unit))
    return radius * wp.cos(_f64(second) * _to_angle)

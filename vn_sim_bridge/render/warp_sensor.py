"""Noise and motion blur of a camera, on a Warp device: `sensor` as a kernel."""

from __future__ import annotations

import warp as wp

wp.set_module_options({'enable_backward': False, 'fast_math': False})

_low_half = wp.constant(wp.uint64(0xFFFFFFFF))
_mix_0 = wp.constant(wp.uint32(0x9E3779B1))
_mix_1 = wp.constant(wp.uint32(0x85EBCA6B))
_mix_2 = wp.constant(wp.uint32(0xC2B2AE35))


@wp.kernel
def expose(source: wp.array4d(dtype=wp.uint8), noise: wp.array(dtype=wp.float32),
           blur: wp.array(dtype=wp.float32), keys: wp.array(dtype=wp.uint64),
           rgb: wp.array4d(dtype=wp.uint8)):
    """One thread: one row of one channel. As `sensor.expose`, from one buffer into another."""
    n, channel, row = wp.tid()
    width = source.shape[3]
    span = wp.min(wp.int32(wp.rint(blur[n] * wp.float32(width))), 63)
    before = span // 2
    total = wp.int32(0)
    if span > 1:
        for k in range(-before, span - before):
            total += wp.int32(source[n, channel, row, wp.clamp(k, 0, width - 1)])
    scale = wp.int32(wp.float64(noise[n]) / wp.float64(147.8) * wp.float64(65536.0))
    key = wp.uint32((keys[n] ^ (keys[n] >> wp.uint64(32))) & _low_half)
    for column in range(width):
        value = wp.int32(source[n, channel, row, column])
        if span > 1:
            value = total // span
            total += wp.int32(source[n, channel, row, wp.min(column + span - before, width - 1)])
            total -= wp.int32(source[n, channel, row, wp.max(column - before, 0)])
        if noise[n] > 0.0:
            index = wp.uint32((channel * source.shape[2] + row) * width + column)
            bits = (index * _mix_0) ^ key
            bits = (bits ^ (bits >> wp.uint32(16))) * _mix_1
            bits = (bits ^ (bits >> wp.uint32(13))) * _mix_2
            bits = bits ^ (bits >> wp.uint32(16))
            noisy = (wp.int32(bits & wp.uint32(255)) + wp.int32((bits >> wp.uint32(8))
                     & wp.uint32(255)) + wp.int32((bits >> wp.uint32(16)) & wp.uint32(255))
                     + wp.int32(bits >> wp.uint32(24)) - 510)
            value = wp.clamp(value + ((noisy * scale + 32768) >> 16), 0, 255)
        rgb[n, channel, row, column] = wp.uint8(value)

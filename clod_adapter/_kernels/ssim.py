"""Fused SSIM with its gradient: separable 11-tap Gaussian (sigma 1.5), zero padding, data range 1.

Images are copied to planes ``[3, H, stride]`` with 16 zero lanes left and right of each row, so
that blurs along a row need no edge cases. Rows beyond the image are skipped, which equals zero
padding.
"""

from typing import Any, NamedTuple

import numpy as np
from numba import float32

from clod_adapter._kernels.compiling import inlined, kernel
from clod_adapter._kernels.pointers import load, pointer, pointers, share, store
from clod_adapter._kernels.simd import fma, splat

RADIUS = 5
PAD = 16
LINES = 6
_taps = np.exp(-((np.arange(11) - RADIUS) ** 2) / (2 * 1.5**2))
TAPS = (_taps / _taps.sum()).astype(np.float32)
C1 = float32(0.01**2)
C2 = float32(0.03**2)
BYTE = float32(1 / 255)


class Planes(NamedTuple):
    """Planes of a render x, a photograph y, and what the SSIM of a pixel changes by."""

    x: Any
    y: Any
    mean: Any  # the blurred x
    square: Any  # the blurred x^2
    product: Any  # the blurred x y


def stride(width: int) -> int:
    """Floats a padded row takes."""
    return 2 * PAD + -(-width // 16) * 16


@kernel
def to_planes(worker, workers, image, target, planes):
    """Copies two ``[H, W, 3]`` images into planes; the uint8 ``target`` is scaled to [0, 1]."""
    height = image.shape[0]
    width = image.shape[1]
    for row in range(*share(worker, workers, height)):
        for column in range(width):
            for channel in range(3):
                planes.x[channel, row, PAD + column] = image[row, column, channel]
                byte = float32(target[row, column, channel])
                planes.y[channel, row, PAD + column] = byte * BYTE


@inlined
def blur_row(lines, line, length):
    """Horizontal blur of 16 columns from ``line`` of a row buffer."""
    out = splat(0)
    for tap in range(11):
        out = fma(TAPS[tap], load(lines, line + length + tap - RADIUS), out)
    return out


@kernel
def ssim_slopes(worker, workers, planes, width, room, sums):
    """Derivatives of each pixel's SSIM by the blurred x, x^2 and x y; ``sums[worker]``: sum of SSIM
    over the pixels.

    ``room[worker]`` holds LINES zeroed rows of scratch.
    """
    channels, height, step = planes.x.shape
    planes = pointers(planes)
    lines = pointer(room[worker])
    zero = splat(0)
    result = 0.0
    for task in range(*share(worker, workers, channels * height)):
        channel = task // height
        row = task % height
        for at in range(PAD, step - PAD, 16):
            m_x = m_y = m_xx = m_yy = m_xy = zero
            for near in range(max(row - RADIUS, 0), min(row + RADIUS, height - 1) + 1):
                tap = TAPS[near - row + RADIUS]
                where = (channel * height + near) * step + at
                p = load(planes.x, where)
                q = load(planes.y, where)
                tp = tap * p
                tq = tap * q
                m_x = m_x + tp
                m_y = m_y + tq
                m_xx = fma(tp, p, m_xx)
                m_yy = fma(tq, q, m_yy)
                m_xy = fma(tp, q, m_xy)
            store(lines, at, m_x)
            store(lines, step + at, m_y)
            store(lines, 2 * step + at, m_xx)
            store(lines, 3 * step + at, m_yy)
            store(lines, 4 * step + at, m_xy)
        for at in range(PAD, step - PAD, 16):
            mx = blur_row(lines, 0, at)
            my = blur_row(lines, step, at)
            sxx = blur_row(lines, 2 * step, at) - mx * mx
            syy = blur_row(lines, 3 * step, at) - my * my
            sxy = blur_row(lines, 4 * step, at) - mx * my
            a = fma(2 * mx, my, C1)
            b = fma(2, sxy, C2)
            c = fma(mx, mx, fma(my, my, C1))
            d = sxx + syy + C2
            inverse = 1 / (c * d)
            value = a * b * inverse
            where = task * step + at
            store(lines, 5 * step + at, value)
            store(planes.mean, where, 2 * (my * (b - a) - value * mx * (d - c)) * inverse)
            store(planes.square, where, 0 - value * c * inverse)
            store(planes.product, where, 2 * a * inverse)
        for column in range(width):
            result += lines[5 * step + PAD + column]
        # Lanes beyond the image must not contribute to the gradient.
        for column in range(task * step + PAD + width, (task + 1) * step - PAD):
            planes.mean[column] = planes.square[column] = planes.product[column] = 0
    sums[worker] = result


@kernel
def loss_gradient(worker, workers, planes, width, room, l1, dssim, v_image, sums):
    """Gradient of ``l1 sum |x - y| - dssim sum SSIM`` by x, as ``[H, W, 3]``; ``sums[worker]``: sum
    of |x - y|.
    """
    channels, height, step = planes.x.shape
    planes = pointers(planes)
    lines = pointer(room[worker])
    zero = splat(0)
    weight = float32(-dssim)
    result = 0.0
    for task in range(*share(worker, workers, channels * height)):
        channel = task // height
        row = task % height
        for at in range(PAD, step - PAD, 16):
            m = zero
            s = zero
            p = zero
            for near in range(max(row - RADIUS, 0), min(row + RADIUS, height - 1) + 1):
                tap = TAPS[near - row + RADIUS]
                where = (channel * height + near) * step + at
                m = fma(tap, load(planes.mean, where), m)
                s = fma(tap, load(planes.square, where), s)
                p = fma(tap, load(planes.product, where), p)
            store(lines, at, m)
            store(lines, step + at, s)
            store(lines, 2 * step + at, p)
        for at in range(PAD, step - PAD, 16):
            where = task * step + at
            inner = fma(
                2 * load(planes.x, where), blur_row(lines, step, at), blur_row(lines, 0, at)
            )
            slope = weight * fma(load(planes.y, where), blur_row(lines, 2 * step, at), inner)
            store(lines, 3 * step + at, slope)
        for column in range(width):
            pixel = task * step + PAD + column
            difference = planes.x[pixel] - planes.y[pixel]
            result += abs(difference)
            slope = lines[3 * step + PAD + column]
            v_image[row, column, channel] = slope + float32(l1) * float32(np.sign(difference))
    sums[worker] = result

"""Blocks of 4x4 pixels in a tile, and which of them an ellipse touches."""

from __future__ import annotations

import numpy as np
from numba import float32, uint64

from clod_adapter._kernels.bits import set_spans
from clod_adapter._kernels.compiling import part
from clod_adapter._kernels.conventions import DET, HALF, MX, MY, QA, QB, QC, REACH, RX, SLACK, TILE, X0, X1, Y0, Y1
from clod_adapter._kernels.elementary import vceil, vfloor, vsqrt
from clod_adapter._kernels.simd import both, eq, ge, load, select, splat, store, vmax, vmin

BLOCK = 4
ACROSS = TILE // BLOCK
BLOCKS = ACROSS * ACROSS
WORDS = BLOCKS // 64
FORWARD_STATE, BACKWARD_STATE = BLOCKS * 64, BLOCKS * 80
BLOCK_X = np.tile(np.arange(ACROSS, dtype=np.float32) * BLOCK, ACROSS)
BLOCK_Y = np.repeat(np.arange(ACROSS, dtype=np.float32) * BLOCK, ACROSS)
LANE_X = np.tile(np.arange(4, dtype=np.float32) + 0.5, 4)
LANE_Y = np.repeat(np.arange(4, dtype=np.float32) + 0.5, 4)
# One lane per row of blocks: centre of its first pixel row. Lanes beyond the tile are far below every image.
ROW_Y = np.where(np.arange(16) < ACROSS, np.arange(16) * BLOCK + 0.5, 1e9).astype(np.float32)
LAST = float32(ACROSS - 1)


@part
def start_tile(ox, oy, width, height, state, stride, live):  # type: ignore[no-untyped-def]
    """Marks blocks with pixels in the image as live, pixels outside as finished."""
    for word in range(WORDS):
        live[word] = uint64(0)
    for block in range(BLOCKS):
        x, y = ox + (block % ACROSS) * BLOCK, oy + (block // ACROSS) * BLOCK
        if x < width and y < height:
            live[block // 64] |= uint64(1) << uint64(block % 64)
        if x + BLOCK <= width and y + BLOCK <= height:
            store(state, block * stride, splat(float32(1)))
        else:
            for lane in range(16):
                inside = x + lane % 4 < width and y + lane // 4 < height
                state[block * stride + lane] = 1.0 if inside else -1.0


@part
def none_set(words, at):  # type: ignore[no-untyped-def]
    """Whether the WORDS words from ``at`` on are 0."""
    any_set = uint64(0)
    for word in range(WORDS):
        any_set |= words[at + word]
    return any_set == uint64(0)


@part
def find_blocks(records, r, ox, oy, masks, at):  # type: ignore[no-untyped-def]
    """Sets in ``masks[at : at + WORDS]`` the tile's blocks that the ellipse of the record at ``r`` touches.

    The ellipse is where alpha reaches 1/255; see ``tiles.extent``, which this computes for all rows of blocks at once.
    """
    my, rx, b = splat(records[r + MY]), splat(records[r + RX]), splat(records[r + QB])
    row = load(ROW_Y, 0) + splat(float32(oy))
    top = vmax(row, splat(records[r + Y0] + HALF)) - my
    bottom = vmin(row + splat(float32(BLOCK - 1)), splat(records[r + Y1] + HALF)) - my
    tip_y = -records[r + QB] / (records[r + QC] * float32(2)) * records[r + RX]
    zero, half, det = splat(float32(0)), splat(HALF / records[r + QA]), splat(records[r + DET])
    reach = splat(float32(4) * records[r + QA] * records[r + REACH])
    tip = splat(tip_y)
    right, left = vmin(vmax(tip, top), bottom), vmin(vmax(zero - tip, top), bottom)
    wide = vsqrt(vmax(reach - det * right * right, zero))
    x1 = select(eq(right, tip), rx, (wide - b * right) * half)
    wide = vsqrt(vmax(reach - det * left * left, zero))
    x0 = select(eq(left, zero - tip), zero - rx, (zero - wide - b * left) * half)
    mx = splat(records[r + MX] - HALF)
    low = vmax(vceil(mx + x0 - splat(SLACK)), splat(records[r + X0])) - splat(float32(ox))
    high = vmin(vfloor(mx + x1 + splat(SLACK)), splat(records[r + X1])) - splat(float32(ox))
    quarter = splat(float32(1 / BLOCK))
    # Clamped before the cast to integers: values may be 1e10.
    low = vmin(vmax(vfloor(low * quarter), zero), splat(LAST + float32(1)))
    high = vmax(vmin(vfloor(high * quarter), splat(LAST)), splat(float32(-1)))
    high = select(both(ge(bottom, top), ge(high, low)), high, splat(float32(-1)))
    set_spans(masks, at, low, high, ACROSS)

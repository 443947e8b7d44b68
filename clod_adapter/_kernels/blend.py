"""Front-to-back blending of each tile, and its gradient.

A tile is processed in blocks of 4x4 pixels, one vector lane per pixel. The state of a block is
contiguous: 16 transmittances, then 16 reds, greens and blues. A pixel whose transmittance falls to
T_MIN is finished and stores its transmittance negated; a block is finished when all its pixels are.
The Gaussian that finishes a pixel is drawn: were it left out, as gsplat and Inria do, up to a tenth
of the pixel would change at once when it or one before it fades.
"""

from typing import Any, NamedTuple

import numpy as np
from numba import float32, uint64

from clod_adapter._kernels.compiling import inlined, kernel
from clod_adapter._kernels.conventions import (
    AHEAD,
    ALPHA_MAX,
    ALPHA_MIN,
    BLUE,
    GREEN,
    LOG,
    MX,
    MY,
    PAIR,
    QA,
    QB,
    QC,
    RECORD,
    RED,
    T_MIN,
    TILE,
)
from clod_adapter._kernels.elementary import bits_of, exp2, lowest, set_spans, vabs
from clod_adapter._kernels.pointers import (
    count_up,
    load,
    pointer,
    pointers,
    prefetch,
    scratch,
    store,
    store_sums,
)
from clod_adapter._kernels.simd import (
    both,
    fma,
    ge,
    gt,
    lanes,
    select,
    splat,
    vmax,
    vmin,
)
from clod_adapter._kernels.tiles import spans

BLOCK = 4  # pixels of a side
ACROSS = 16  # blocks of a tile
BLOCKS = ACROSS * ACROSS
WORDS = BLOCKS // 64
FORWARD_STATE = BLOCKS * 64
BACKWARD_STATE = BLOCKS * 80
lane_x = lanes(np.tile(np.arange(4) + 0.5, 4))
lane_y = lanes(np.repeat(np.arange(4) + 0.5, 4))
LAST = float32(ACROSS - 1)


@inlined
def corner(block):
    """A block's first column and row of pixels in its tile."""
    return BLOCK * (block % ACROSS), BLOCK * (block // ACROSS)


@inlined
def start_tile(ox, oy, tiles, state, stride, live):
    """Marks blocks with pixels in the image as live, pixels outside as finished."""
    for word in range(WORDS):
        live[word] = uint64(0)
    for block in range(BLOCKS):
        column, row = corner(block)
        x = ox + column
        y = oy + row
        if x < tiles.width and y < tiles.height:
            live[block // 64] |= uint64(1) << uint64(block % 64)
        inside = both(gt(tiles.width - x, lane_x()), gt(tiles.height - y, lane_y()))
        store(state, block * stride, select(inside, 1, -1))


@inlined
def none_set(words, at):
    """Whether the WORDS words from ``at`` on are 0."""
    any_set = uint64(0)
    for word in range(WORDS):
        any_set |= words[at + word]
    return any_set == uint64(0)


@inlined
def find_blocks(records, r, ox, oy, masks, at):
    """Sets in ``masks[at : at + WORDS]`` the tile's blocks that the ellipse of the record at ``r``
    touches.
    """
    low, high = spans(records, r, ox, oy, float32(BLOCK))
    low = vmin(vmax(low, 0), LAST + 1)
    set_spans(masks, at, low, vmax(vmin(high, LAST), -1))


class Spread(NamedTuple):
    """A record with the same numbers in every lane."""

    minus_qa: Any
    minus_qb: Any
    minus_qc: Any
    log: Any
    base_x: Any  # offsets from its centre to the pixels of the tile's first block
    base_y: Any
    red: Any
    green: Any
    blue: Any


@inlined
def spread(records, r, ox, oy):
    """The record at ``r`` in a tile that begins at (ox, oy)."""
    return Spread(
        splat(-records[r + QA]),
        splat(-records[r + QB]),
        splat(-records[r + QC]),
        splat(records[r + LOG]),
        lane_x() + (float32(ox) - records[r + MX]),
        lane_y() + (float32(oy) - records[r + MY]),
        splat(records[r + RED]),
        splat(records[r + GREEN]),
        splat(records[r + BLUE]),
    )


class Meeting(NamedTuple):
    """Effect of a Gaussian on the pixels of a block."""

    dx: Any  # offsets of the pixels from the centre
    dy: Any
    unlimited: Any  # alpha before its limit
    alpha: Any
    after: Any  # the transmittance behind it
    blends: Any  # which pixels blend it
    ends: Any  # which pixels it finishes


@inlined
def meet(g, t, block):
    """The ``Meeting`` of a Gaussian with the pixels of a block, whose transmittances are ``t``."""
    column, row = corner(block)
    dx = g.base_x + column
    dy = g.base_y + row
    along_x = fma(g.minus_qa, dx, g.minus_qb * dy)
    unlimited = exp2(fma(dx, along_x, fma(g.minus_qc * dy, dy, g.log)))
    alpha = vmin(unlimited, ALPHA_MAX)
    blends = both(ge(alpha, ALPHA_MIN), gt(t, 0))
    after = t - t * alpha
    ends = both(blends, ge(T_MIN, after))
    return Meeting(dx, dy, unlimited, alpha, after, blends, ends)


@kernel
def blend(worker, workers, tiles, cursor, room, background, picture):
    """Forward pass: writes the picture and the masks of ``tiles``. An atomic cursor assigns tiles
    to workers.

    ``room[worker]`` holds FORWARD_STATE floats of scratch (on the stack, LLVM would take minutes to
    compile it).
    """
    count = len(tiles.order)
    tiles = pointers(tiles)
    picture = pointers(picture)
    records = tiles.records
    entries = tiles.entries
    offsets = tiles.offsets
    masks = tiles.masks
    cursor = pointer(cursor)
    background = pointer(background)
    state = pointer(room[worker])
    live = scratch(uint64, WORDS)
    while True:
        turn = count_up(cursor)
        if turn >= count:
            break
        tile = tiles.order[turn]
        ox = (tile % tiles.across) * TILE
        oy = (tile // tiles.across) * TILE
        for k in range(FORWARD_STATE):
            state[k] = 0
        start_tile(ox, oy, tiles, state, 64, live)
        for entry in range(offsets[tile], offsets[tile + 1]):
            if none_set(live, 0):
                for k in range(entry * WORDS, offsets[tile + 1] * WORDS):
                    masks[k] = uint64(0)
                break
            r = entries[entry] * RECORD
            prefetch(records, entries[min(entry + AHEAD, offsets[tile + 1] - 1)] * RECORD)
            g = spread(records, r, ox, oy)
            find_blocks(records, r, ox, oy, masks, entry * WORDS)
            for word in range(WORDS):
                bits = masks[entry * WORDS + word] & live[word]
                masks[entry * WORDS + word] = bits
                while bits != uint64(0):
                    block = lowest(bits) + 64 * word
                    bits &= bits - uint64(1)
                    at = block * 64
                    t = load(state, at)
                    met = meet(g, t, block)
                    weight = select(met.blends, t * met.alpha, 0)
                    store(state, at + 16, fma(weight, g.red, load(state, at + 16)))
                    store(state, at + 32, fma(weight, g.green, load(state, at + 32)))
                    store(state, at + 48, fma(weight, g.blue, load(state, at + 48)))
                    t = select(met.blends, met.after, t)
                    if bits_of(met.ends):
                        t = select(met.ends, 0 - t, t)
                        if not bits_of(gt(t, 0)):
                            live[word] &= ~(uint64(1) << uint64(block % 64))
                    store(state, at, t)
        write_tile(ox, oy, tiles, state, background, picture)


@inlined
def write_tile(ox, oy, tiles, state, background, picture):
    """Composites the tile over the background into the picture."""
    width = tiles.width
    height = tiles.height
    block_values = scratch(float32, 64)
    for block in range(BLOCKS):
        column, row = corner(block)
        x = ox + column
        y = oy + row
        at = block * 64
        if x >= width or y >= height:
            continue
        t = vabs(load(state, at))
        for channel in range(3):
            color = fma(t, background[channel], load(state, at + 16 + 16 * channel))
            store(block_values, 16 * channel, color)
        store(block_values, 48, 1 - t)
        for lane in range(16):
            if x + lane % 4 < width and y + lane // 4 < height:
                pixel = (y + lane // 4) * width + x + lane % 4
                picture.alpha[pixel] = block_values[48 + lane]
                for channel in range(3):
                    picture.image[3 * pixel + channel] = block_values[16 * channel + lane]


@inlined
def read_tile(ox, oy, tiles, picture, gradients, state):
    """Loads for each pixel the remainder of v . C behind the current Gaussian, and v of the three
    channels.
    """
    width = tiles.width
    height = tiles.height
    for block in range(BLOCKS):
        column, row = corner(block)
        x = ox + column
        y = oy + row
        at = block * 80
        if x >= width or y >= height:
            continue
        for lane in range(16):
            if x + lane % 4 < width and y + lane // 4 < height:
                pixel = (y + lane // 4) * width + x + lane % 4
                remainder = -gradients.alpha[pixel] * (float32(1) - picture.alpha[pixel])
                for channel in range(2, -1, -1):
                    slope = gradients.image[3 * pixel + channel]
                    color = picture.image[3 * pixel + channel]
                    state[at + 32 + 16 * channel + lane] = slope
                    remainder += slope * color
                state[at + 16 + lane] = remainder


@kernel
def blend_gradient(
    worker,
    workers,
    tiles,
    cursor,
    room,
    entry_slots,
    picture,
    gradients,
    shaped,
    colored,
    pair_sums,
):
    """Backward pass: for each pair of Gaussian and tile the nine sums over pixels for the
    projection's gradient.

    With s = alpha dL/dalpha and (dx, dy) from the centre: three of weight * v, then s, s dx, s dy,
    s dx^2, s dx dy, s dy^2. Runs front to back like the forward pass with a running remainder of
    v . C, so nothing is stored per pixel and Gaussian. Each pair has its own slot.
    """
    count = len(tiles.order)
    tiles = pointers(tiles)
    picture = pointers(picture)
    gradients = pointers(gradients)
    records = tiles.records
    entries = tiles.entries
    offsets = tiles.offsets
    masks = tiles.masks
    entry_slots = pointer(entry_slots)
    pair_sums = pointer(pair_sums)
    cursor = pointer(cursor)
    state = pointer(room[worker])
    live = scratch(uint64, WORDS)
    while True:
        turn = count_up(cursor)
        if turn >= count:
            break
        tile = tiles.order[turn]
        ox = (tile % tiles.across) * TILE
        oy = (tile // tiles.across) * TILE
        if ox + TILE > tiles.width or oy + TILE > tiles.height:
            for k in range(BACKWARD_STATE):  # pixels outside have weight 0, but 0 times NaN is NaN
                state[k] = 0
        start_tile(ox, oy, tiles, state, 80, live)
        read_tile(ox, oy, tiles, picture, gradients, state)
        for entry in range(offsets[tile], offsets[tile + 1]):
            slot = entry_slots[entry]
            if none_set(masks, entry * WORDS):
                for k in range(PAIR):
                    pair_sums[slot * PAIR + k] = 0
                continue
            r = entries[entry] * RECORD
            prefetch(records, entries[min(entry + AHEAD, offsets[tile + 1] - 1)] * RECORD)
            g = spread(records, r, ox, oy)
            s_r = s_g = s_b = s_0 = s_x = s_y = s_xx = s_xy = s_yy = splat(0)
            for word in range(WORDS):
                bits = masks[entry * WORDS + word]
                while bits != uint64(0):
                    block = lowest(bits) + 64 * word
                    bits &= bits - uint64(1)
                    at = block * 80
                    t = load(state, at)
                    met = meet(g, t, block)
                    dx = met.dx
                    dy = met.dy
                    weight = select(met.blends, t * met.alpha, 0)
                    v_r = load(state, at + 32)
                    v_g = load(state, at + 48)
                    v_b = load(state, at + 64)
                    q = fma(v_r, g.red, fma(v_g, g.green, v_b * g.blue))
                    if colored:
                        s_r = fma(weight, v_r, s_r)
                        s_g = fma(weight, v_g, s_g)
                        s_b = fma(weight, v_b, s_b)
                    behind = load(state, at + 16) - weight * q
                    store(state, at + 16, behind)
                    v_a = t * q - behind / (1 - met.alpha)
                    s = select(both(met.blends, ge(ALPHA_MAX, met.unlimited)), v_a * met.alpha, 0)
                    s_0 = s_0 + s
                    if shaped:
                        sx = s * dx
                        sy = s * dy
                        s_x = s_x + sx
                        s_y = s_y + sy
                        s_xx = fma(sx, dx, s_xx)
                        s_xy = fma(sx, dy, s_xy)
                        s_yy = fma(sy, dy, s_yy)
                    after = select(met.ends, 0 - met.after, met.after)
                    store(state, at, select(met.blends, after, t))
            store_sums(pair_sums, slot * PAIR, s_r, s_g, s_b, s_0, s_x, s_y, s_xx, s_xy, s_yy)

"""Front-to-back blending of each tile, and its gradient.

A tile is processed in blocks of 4x4 pixels, one vector lane per pixel. The state of a block is
contiguous: 16 transmittances, then 16 reds, greens and blues. A pixel whose transmittance falls to
T_MIN is finished and stores its transmittance negated; a block is finished when all its pixels are.
The Gaussian that finishes a pixel is drawn: were it left out, as gsplat and Inria do, up to a tenth
of the pixel would change at once when it or one before it fades.
"""

import numpy as np
from numba import float32, uint64

from clod_adapter._kernels.compiling import kernel, part
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
from clod_adapter._kernels.elementary import exp2, lowest, set_spans, vabs
from clod_adapter._kernels.pointers import count_up, pointer, prefetch, scratch, store_sums
from clod_adapter._kernels.simd import (
    anywhere,
    both,
    fma,
    ge,
    gt,
    load,
    select,
    splat,
    store,
    vmax,
    vmin,
)
from clod_adapter._kernels.tiles import spans

BLOCK, ACROSS = 4, 16  # pixels of a block, and blocks of a tile
BLOCKS = ACROSS * ACROSS
WORDS = BLOCKS // 64
FORWARD_STATE, BACKWARD_STATE = BLOCKS * 64, BLOCKS * 80
BLOCK_X = np.tile(np.arange(ACROSS, dtype=np.float32) * BLOCK, ACROSS)
BLOCK_Y = np.repeat(np.arange(ACROSS, dtype=np.float32) * BLOCK, ACROSS)
LANE_X = np.tile(np.arange(4, dtype=np.float32) + 0.5, 4)
LANE_Y = np.repeat(np.arange(4, dtype=np.float32) + 0.5, 4)
LAST = float32(ACROSS - 1)


@part
def start_tile(ox, oy, width, height, state, stride, live):
    """Marks blocks with pixels in the image as live, pixels outside as finished."""
    for word in range(WORDS):
        live[word] = uint64(0)
    for block in range(BLOCKS):
        x, y = ox + (block % ACROSS) * BLOCK, oy + (block // ACROSS) * BLOCK
        if x < width and y < height:
            live[block // 64] |= uint64(1) << uint64(block % 64)
        inside = both(gt(width - x, load(LANE_X, 0)), gt(height - y, load(LANE_Y, 0)))
        store(state, block * stride, select(inside, 1, -1))


@part
def none_set(words, at):
    """Whether the WORDS words from ``at`` on are 0."""
    any_set = uint64(0)
    for word in range(WORDS):
        any_set |= words[at + word]
    return any_set == uint64(0)


@part
def find_blocks(records, r, ox, oy, masks, at):
    """Sets in ``masks[at : at + WORDS]`` the tile's blocks that the ellipse of the record at ``r``
    touches.
    """
    low, high = spans(records, r, ox, oy, float32(BLOCK))
    low = vmin(vmax(low, 0), LAST + 1)
    set_spans(masks, at, low, vmax(vmin(high, LAST), -1))


@part
def spread(records, r, ox, oy):
    """Of the record at ``r``, the same in every lane: what ``meet`` takes, and the colour."""
    qa, qb, qc = splat(-records[r + QA]), splat(-records[r + QB]), splat(-records[r + QC])
    base_x = load(LANE_X, 0) + (float32(ox) - records[r + MX])
    base_y = load(LANE_Y, 0) + (float32(oy) - records[r + MY])
    shape = qa, qb, qc, splat(records[r + LOG]), base_x, base_y
    return shape, splat(records[r + RED]), splat(records[r + GREEN]), splat(records[r + BLUE])


@part
def meet(shape, t, block):
    """What a Gaussian does to the pixels of a block with transmittances ``t``.

    ``shape`` is of its exponent ``-QA, -QB, -QC, LOG``, and the offsets from its centre to the
    pixels of the tile's first block. Returns the pixels' offsets, alpha before and after its limit,
    the transmittance behind the Gaussian, which pixels blend it, and which are finished by it.
    """
    qa, qb, qc, log, base_x, base_y = shape
    dx, dy = base_x + BLOCK_X[block], base_y + BLOCK_Y[block]
    raw = exp2(fma(dx, fma(qa, dx, qb * dy), fma(qc * dy, dy, log)))
    a = vmin(raw, ALPHA_MAX)
    mask = both(ge(a, ALPHA_MIN), gt(t, 0))
    after = t - t * a
    return dx, dy, raw, a, after, mask, both(mask, ge(T_MIN, after))


@kernel
def blend(
    worker,
    workers,
    records,
    entries,
    offsets,
    across,
    width,
    height,
    tiles,
    masks,
    cursor,
    room,
    background,
    image,
    alpha,
):
    """Forward pass: writes ``image [H, W, 3]`` and ``alpha [H, W]``. An atomic cursor assigns
    ``tiles`` to workers.

    ``masks`` receives WORDS words per entry, one bit for each block of the tile that blends it.
    ``room[worker]`` holds FORWARD_STATE floats of scratch (on the stack, LLVM would take minutes to
    compile it).
    """
    count = len(tiles)
    tiles = pointer(tiles)
    records = pointer(records)
    entries = pointer(entries)
    offsets = pointer(offsets)
    background = pointer(background)
    image = pointer(image)
    alpha = pointer(alpha)
    state = pointer(room[worker])
    live = scratch(uint64, WORDS)
    masks = pointer(masks)
    cursor = pointer(cursor)
    while True:
        turn = count_up(cursor)
        if turn >= count:
            break
        tile = tiles[turn]
        ox, oy = (tile % across) * TILE, (tile // across) * TILE
        for k in range(FORWARD_STATE):
            state[k] = 0
        start_tile(ox, oy, width, height, state, 64, live)
        for entry in range(offsets[tile], offsets[tile + 1]):
            if none_set(live, 0):
                for k in range(entry * WORDS, offsets[tile + 1] * WORDS):
                    masks[k] = uint64(0)
                break
            r = entries[entry] * RECORD
            prefetch(records, entries[min(entry + AHEAD, offsets[tile + 1] - 1)] * RECORD)
            shape, red, green, blue = spread(records, r, ox, oy)
            find_blocks(records, r, ox, oy, masks, entry * WORDS)
            for word in range(WORDS):
                bits = masks[entry * WORDS + word] & live[word]
                masks[entry * WORDS + word] = bits
                while bits != uint64(0):
                    block = lowest(bits) + 64 * word
                    bits &= bits - uint64(1)
                    at = block * 64
                    t = load(state, at)
                    _, _, _, a, after, keep, done = meet(shape, t, block)
                    weight = select(keep, t * a, 0)
                    store(state, at + 16, fma(weight, red, load(state, at + 16)))
                    store(state, at + 32, fma(weight, green, load(state, at + 32)))
                    store(state, at + 48, fma(weight, blue, load(state, at + 48)))
                    t = select(keep, after, t)
                    if anywhere(done):
                        t = select(done, 0 - t, t)
                        if not anywhere(gt(t, 0)):
                            live[word] &= ~(uint64(1) << uint64(block % 64))
                    store(state, at, t)
        write_tile(ox, oy, width, height, state, background, image, alpha)


@part
def write_tile(ox, oy, width, height, state, background, image, alpha):
    """Composites the tile over the background into the image."""
    part = scratch(float32, 64)
    for block in range(BLOCKS):
        x, y, at = ox + BLOCK * (block % ACROSS), oy + BLOCK * (block // ACROSS), block * 64
        if x >= width or y >= height:
            continue
        t = vabs(load(state, at))
        for channel in range(3):
            color = fma(t, background[channel], load(state, at + 16 + 16 * channel))
            store(part, 16 * channel, color)
        store(part, 48, 1 - t)
        for lane in range(16):
            if x + lane % 4 < width and y + lane // 4 < height:
                pixel = (y + lane // 4) * width + x + lane % 4
                alpha[pixel] = part[48 + lane]
                for channel in range(3):
                    image[3 * pixel + channel] = part[16 * channel + lane]


@part
def read_tile(ox, oy, width, height, image, alpha, v_image, v_alpha, state):
    """Loads for each pixel the remainder of v . C behind the current Gaussian, and v of the three
    channels.
    """
    part = scratch(float32, 80)
    for block in range(BLOCKS):
        x, y, at = ox + BLOCK * (block % ACROSS), oy + BLOCK * (block // ACROSS), block * 80
        if x >= width or y >= height:
            continue
        whole = x + BLOCK <= width and y + BLOCK <= height
        for lane in range(16):
            if whole or (x + lane % 4 < width and y + lane // 4 < height):
                own = (y + lane // 4) * width + x + lane % 4
                left = part[lane] = -v_alpha[own] * (float32(1) - alpha[own])
                for channel in range(3):
                    slope = v_image[3 * own + channel]
                    state[at + 32 + 16 * channel + lane] = slope
                    part[16 + 16 * channel + lane] = image[3 * own + channel]
                    left += slope * image[3 * own + channel]
                state[at + 16 + lane] = left
        if whole:  # in vectors: the last bits of the result have always been these
            rest = load(part, 0)
            for channel in range(2, -1, -1):
                rest = fma(load(state, at + 32 + 16 * channel), load(part, 16 + 16 * channel), rest)
            store(state, at + 16, rest)


@kernel
def blend_gradient(
    worker,
    workers,
    records,
    entries,
    offsets,
    across,
    width,
    height,
    tiles,
    masks,
    cursor,
    room,
    entry_slots,
    image,
    alpha,
    v_image,
    v_alpha,
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
    count = len(tiles)
    tiles = pointer(tiles)
    records = pointer(records)
    entries = pointer(entries)
    entry_slots, offsets, pair_sums = pointer(entry_slots), pointer(offsets), pointer(pair_sums)
    image = pointer(image)
    alpha = pointer(alpha)
    v_image = pointer(v_image)
    v_alpha = pointer(v_alpha)
    state = pointer(room[worker])
    live = scratch(uint64, WORDS)
    masks = pointer(masks)
    cursor = pointer(cursor)
    while True:
        turn = count_up(cursor)
        if turn >= count:
            break
        tile = tiles[turn]
        ox, oy = (tile % across) * TILE, (tile // across) * TILE
        if ox + TILE > width or oy + TILE > height:
            for k in range(BACKWARD_STATE):  # pixels outside have weight 0, but 0 times NaN is NaN
                state[k] = 0
        start_tile(ox, oy, width, height, state, 80, live)
        read_tile(ox, oy, width, height, image, alpha, v_image, v_alpha, state)
        for entry in range(offsets[tile], offsets[tile + 1]):
            slot = entry_slots[entry]
            if none_set(masks, entry * WORDS):
                for k in range(PAIR):
                    pair_sums[slot * PAIR + k] = 0
                continue
            r = entries[entry] * RECORD
            prefetch(records, entries[min(entry + AHEAD, offsets[tile + 1] - 1)] * RECORD)
            shape, red, green, blue = spread(records, r, ox, oy)
            s_r = s_g = s_b = s_0 = s_x = s_y = s_xx = s_xy = s_yy = splat(0)
            for word in range(WORDS):
                bits = masks[entry * WORDS + word]
                while bits != uint64(0):
                    block = lowest(bits) + 64 * word
                    bits &= bits - uint64(1)
                    at = block * 80
                    t = load(state, at)
                    dx, dy, raw, a, after, keep, done = meet(shape, t, block)
                    weight = select(keep, t * a, 0)
                    v_r, v_g, v_b = load(state, at + 32), load(state, at + 48), load(state, at + 64)
                    q = fma(v_r, red, fma(v_g, green, v_b * blue))
                    if colored:
                        s_r, s_g, s_b = (
                            fma(weight, v_r, s_r),
                            fma(weight, v_g, s_g),
                            fma(weight, v_b, s_b),
                        )
                    rest = load(state, at + 16) - weight * q
                    store(state, at + 16, rest)
                    v_a = t * q - rest / (1 - a)
                    s = select(both(keep, ge(ALPHA_MAX, raw)), v_a * a, 0)
                    s_0 = s_0 + s
                    if shaped:
                        sx, sy = s * dx, s * dy
                        s_x, s_y = s_x + sx, s_y + sy
                        s_xx, s_xy, s_yy = fma(sx, dx, s_xx), fma(sx, dy, s_xy), fma(sy, dy, s_yy)
                    after = select(done, 0 - after, after)
                    store(state, at, select(keep, after, t))
            store_sums(pair_sums, slot * PAIR, s_r, s_g, s_b, s_0, s_x, s_y, s_xx, s_xy, s_yy)

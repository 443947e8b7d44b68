"""Depth order and tile lists: which Gaussians each tile blends, front to back."""

import numpy as np
from numba import float32

from clod_adapter._kernels import conventions as c
from clod_adapter._kernels.compiling import kernel, part
from clod_adapter._kernels.elementary import vceil, vfloor, vsqrt
from clod_adapter._kernels.pointers import pointer, prefetch, scratch
from clod_adapter._kernels.simd import both, eq, ge, load, select, splat, store, vmax, vmin

ROWS = np.arange(16, dtype=np.float32)


@part
def spans(records, r, ox, oy, side):
    """Columns of cells that the ellipse of the record at ``r`` touches in sixteen rows of cells.

    Cells have ``side`` pixels a side, the first begins at (ox, oy). Returns the first and the last
    column of each row, in lanes, 0 and -1 where it touches none. The ellipse is where alpha reaches
    1/255. In a row of cells it is widest at its own leftmost and rightmost points where those lie
    in it, else at the nearer edge.
    """
    my, rx, b = splat(records[r + c.MY]), splat(records[r + c.RX]), splat(records[r + c.QB])
    row = load(ROWS, 0) * side + (float32(oy) + c.HALF)
    top = vmax(row, records[r + c.Y0] + c.HALF) - my
    bottom = vmin(row + (side - c.ONE), records[r + c.Y1] + c.HALF) - my
    tip = splat(-records[r + c.QB] / (records[r + c.QC] * c.TWO) * records[r + c.RX])
    zero, half = splat(c.ZERO), splat(c.HALF / records[r + c.QA])
    det = splat(records[r + c.DET])  # 4 QA QC - QB^2, from the covariance, where it does not cancel
    reach = splat(float32(4) * records[r + c.QA] * records[r + c.REACH])
    right, left = vmin(vmax(tip, top), bottom), vmin(vmax(zero - tip, top), bottom)
    wide = vsqrt(vmax(reach - det * right * right, zero))
    x1 = select(eq(right, tip), rx, (wide - b * right) * half)
    wide = vsqrt(vmax(reach - det * left * left, zero))
    x0 = select(eq(left, zero - tip), zero - rx, (zero - wide - b * left) * half)
    mx = splat(records[r + c.MX] - c.HALF)
    each = splat(c.ONE / side)
    low = vfloor((vmax(vceil(mx + x0 - c.SLACK), records[r + c.X0]) - float32(ox)) * each)
    high = vfloor((vmin(vfloor(mx + x1 + c.SLACK), records[r + c.X1]) - float32(ox)) * each)
    # of cells: the columns of a needle may have crossed by rounding
    touched = both(ge(bottom, top), ge(high, low))
    return select(touched, low, zero), select(touched, high, -c.ONE)


@kernel
def depth_order(depths, counts, keys, order, keys_other, order_other):
    """The packed records, near ones first: a radix sort of positive floats by their bits, 11 at a
    time.

    Worker w packed the first ``counts[w]`` of its part of ``depths [N]``, as uint32; the others are
    scratch.
    """
    digits, n = np.zeros((3, 2048), np.int64), 0
    for worker in range(len(counts)):
        first = len(depths) * worker // len(counts)
        for k in range(first, first + counts[worker]):
            key = depths[k]
            keys[n], order[n] = key, k
            n += 1
            for place in range(3):
                digits[place, (key >> np.uint32(11 * place)) & np.uint32(2047)] += 1
    for place in range(3):
        total = 0
        for digit in range(2048):
            total, digits[place, digit] = total + digits[place, digit], total
        for i in range(n):
            digit = (keys[i] >> np.uint32(11 * place)) & np.uint32(2047)
            keys_other[digits[place, digit]] = keys[i]
            order_other[digits[place, digit]] = order[i]
            digits[place, digit] += 1
        keys, keys_other = keys_other, keys
        order, order_other = order_other, order
    return order


@part
def tiles_across(records, r, ty, y0, y1, found):
    """First and last column of tiles that the record at ``r`` touches in the tile row ``ty``; none:
    last < first.

    ``found [32]`` keeps those of sixteen rows, for calls with ascending ``ty``.
    """
    first, last = np.int32(records[r + c.X0]) // c.TILE, np.int32(records[r + c.X1]) // c.TILE
    lane = (ty - y0 // c.TILE) % 16
    if first < last or y0 // c.TILE < y1 // c.TILE:
        if lane == 0:
            low, high = spans(records, r, 0, ty * c.TILE, float32(c.TILE))
            store(found, 0, low)
            store(found, 16, high)
        first, last = np.int32(found[lane]), np.int32(found[16 + lane])
    return first, last


@kernel
def tile_offsets(histogram, offsets, totals):
    """Turns the counts into offsets; returns the number of entries."""
    total = 0
    for tile in range(histogram.shape[1]):
        offsets[tile] = total
        for worker in range(histogram.shape[0]):
            total, histogram[worker, tile] = total + histogram[worker, tile], total
    offsets[histogram.shape[1]] = total
    slot = 0
    for worker in range(len(totals)):
        slot, totals[worker] = slot + totals[worker], slot
    return total


@kernel
def list_tiles(
    worker, workers, records, order, across, histogram, totals, slots, entries, entry_slots
):
    """Counts this worker's Gaussians per tile (its row of the histogram) and pairs of Gaussian and
    tile (its total).

    With ``slots``, from the offsets that ``tile_offsets`` makes of these: writes each tile's
    Gaussians in depth order, and the slot that receives the pair's gradient. ``slots[2 p]`` to
    ``slots[2 p + 1]`` are those of the record p.
    """
    first, last = len(order) * worker // workers, len(order) * (worker + 1) // workers
    listed = len(slots) > 0
    cursor = pointer(histogram[worker])
    records = pointer(records)
    order = pointer(order)
    slots, entries, entry_slots = pointer(slots), pointer(entries), pointer(entry_slots)
    found, slot = scratch(float32, 32), totals[worker]
    for j in range(first, last):
        prefetch(records, order[min(j + c.AHEAD, last - 1)] * c.RECORD)
        p = order[j]
        r = p * c.RECORD
        y0, y1 = np.int32(records[r + c.Y0]), np.int32(records[r + c.Y1])
        if listed:
            slots[2 * p] = slot
        for ty in range(y0 // c.TILE, y1 // c.TILE + 1):
            low, high = tiles_across(records, r, ty, y0, y1, found)
            for tx in range(low, high + 1):
                at = cursor[ty * across + tx]
                cursor[ty * across + tx] = at + 1
                if listed:
                    entries[at], entry_slots[at] = p, slot
                slot += 1
        if listed:
            slots[2 * p + 1] = slot
    totals[worker] = slot

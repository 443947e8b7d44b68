"""Depth order and tile lists: which Gaussians each tile blends, front to back."""

import numpy as np
from numba import float32

from clod_adapter._kernels.compiling import inlined, kernel
from clod_adapter._kernels.conventions import (
    AHEAD,
    DET,
    MX,
    MY,
    QA,
    QB,
    QC,
    REACH,
    RECORD,
    RX,
    SLACK,
    TILE,
    X0,
    X1,
    Y0,
    Y1,
)
from clod_adapter._kernels.elementary import vceil, vfloor, vsqrt
from clod_adapter._kernels.pointers import pointer, prefetch, scratch, share, store
from clod_adapter._kernels.simd import both, eq, ge, lanes, select, splat, vmax, vmin

lane_numbers = lanes(range(16))


@inlined
def spans(records, r, ox, oy, side):
    """Columns of cells that the ellipse of the record at ``r`` touches in sixteen rows of cells.

    Cells have ``side`` pixels a side, the first begins at (ox, oy). Returns the first and the last
    column of each row, in lanes, 0 and -1 where it touches none. The ellipse is where alpha reaches
    1/255. In a row of cells it is widest at its own leftmost and rightmost points where those lie
    in it, else at the nearer edge.
    """
    mx = records[r + MX] - 0.5
    my = records[r + MY]
    rx = records[r + RX]
    qa = records[r + QA]
    qb = records[r + QB]
    qc = records[r + QC]
    row = lane_numbers() * side + (float32(oy) + 0.5)
    top = vmax(row, records[r + Y0] + 0.5) - my
    bottom = vmin(row + (side - 1), records[r + Y1] + 0.5) - my
    tip = splat(-qb / (qc * float32(2)) * rx)
    det = records[r + DET]  # 4 QA QC - QB^2, from the covariance, where it does not cancel
    reach = float32(4) * qa * records[r + REACH]
    right = vmin(vmax(tip, top), bottom)
    left = vmin(vmax(0 - tip, top), bottom)
    wide = vsqrt(vmax(reach - det * right * right, 0))
    x1 = select(eq(right, tip), rx, (wide - qb * right) * (0.5 / qa))
    wide = vsqrt(vmax(reach - det * left * left, 0))
    x0 = select(eq(left, 0 - tip), -rx, (0 - wide - qb * left) * (0.5 / qa))
    low = (vmax(vceil(mx + x0 - SLACK), records[r + X0]) - float32(ox)) * (1 / side)
    high = (vmin(vfloor(mx + x1 + SLACK), records[r + X1]) - float32(ox)) * (1 / side)
    low = vfloor(low)  # of cells
    high = vfloor(high)
    # the columns of a needle may have crossed by rounding
    touched = both(ge(bottom, top), ge(high, low))
    return select(touched, low, 0), select(touched, high, -1)


@kernel
def depth_order(depths, counts):
    """The packed records, near ones first: a radix sort of positive floats by their bits, 11 at a
    time.

    Worker w packed the first ``counts[w]`` of its part of ``depths [N]``, as uint32.
    """
    total = counts.sum()
    keys = np.empty(total, np.uint32)
    keys_other = np.empty(total, np.uint32)
    order = np.empty(total, np.int32)
    order_other = np.empty(total, np.int32)
    digits = np.zeros((3, 2048), np.int64)
    n = 0
    for worker in range(len(counts)):
        first = len(depths) * worker // len(counts)
        for k in range(first, first + counts[worker]):
            key = depths[k]
            keys[n] = key
            order[n] = k
            n += 1
            for place in range(3):
                digits[place, (key >> np.uint32(11 * place)) & np.uint32(2047)] += 1
    for place in range(3):
        start = 0
        for digit in range(2048):
            start, digits[place, digit] = start + digits[place, digit], start
        for i in range(n):
            digit = (keys[i] >> np.uint32(11 * place)) & np.uint32(2047)
            keys_other[digits[place, digit]] = keys[i]
            order_other[digits[place, digit]] = order[i]
            digits[place, digit] += 1
        keys, keys_other = keys_other, keys
        order, order_other = order_other, order
    return order


@inlined
def tiles_across(records, r, ty, y0, y1, columns):
    """First and last column of tiles that the record at ``r`` touches in the tile row ``ty``; none:
    last < first.

    ``columns [32]`` keeps those of sixteen rows, for calls with ascending ``ty``.
    """
    first = np.int32(records[r + X0]) // TILE
    last = np.int32(records[r + X1]) // TILE
    lane = (ty - y0 // TILE) % 16
    if first < last or y0 // TILE < y1 // TILE:
        if lane == 0:
            low, high = spans(records, r, 0, ty * TILE, float32(TILE))
            store(columns, 0, low)
            store(columns, 16, high)
        first = np.int32(columns[lane])
        last = np.int32(columns[16 + lane])
    return first, last


@kernel
def list_tiles(
    worker, workers, records, order, across, histogram, totals, slots, entries, entry_slots
):
    """Counts this worker's Gaussians per tile (its row of the histogram) and pairs of Gaussian and
    tile (its total).

    With ``slots``, and the first entry and slot in place of each of these counts: writes each
    tile's Gaussians in depth order, and the slot that receives the pair's gradient. ``slots[2 p]``
    to ``slots[2 p + 1]`` are those of the record p.
    """
    first, last = share(worker, workers, len(order))
    listed = len(slots) > 0
    cursor = pointer(histogram[worker])
    records = pointer(records)
    order = pointer(order)
    slots = pointer(slots)
    entries = pointer(entries)
    entry_slots = pointer(entry_slots)
    columns = scratch(float32, 32)
    slot = totals[worker]
    for j in range(first, last):
        prefetch(records, order[min(j + AHEAD, last - 1)] * RECORD)
        p = order[j]
        r = p * RECORD
        y0 = np.int32(records[r + Y0])
        y1 = np.int32(records[r + Y1])
        if listed:
            slots[2 * p] = slot
        for ty in range(y0 // TILE, y1 // TILE + 1):
            low, high = tiles_across(records, r, ty, y0, y1, columns)
            for tx in range(low, high + 1):
                at = cursor[ty * across + tx]
                cursor[ty * across + tx] = at + 1
                if listed:
                    entries[at] = p
                    entry_slots[at] = slot
                slot += 1
        if listed:
            slots[2 * p + 1] = slot
    totals[worker] = slot

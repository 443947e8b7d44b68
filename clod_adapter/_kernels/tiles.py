"""Depth order and tile lists: which Gaussians each tile blends, front to back."""

import math

import numpy as np
from numba import float32

from clod_adapter._kernels import conventions as c
from clod_adapter._kernels.compiling import kernel, part
from clod_adapter._kernels.pointers import pointer, prefetch


@part
def within(value, otherwise, low, high):
    """``value`` clamped and cast to int32, ``otherwise`` for NaN: an ellipse may extend over 1e10 pixels."""
    return np.int32(otherwise if value != value else min(max(value, low), high))


@part
def extent(records, r, first, last):
    """Columns the ellipse of the record at ``r`` covers between the pixel rows ``first`` and ``last``.

    The ellipse is where alpha reaches 1/255. Between two rows it is widest at its own leftmost and
    rightmost points where those lie between them, else on the nearer row.
    """
    my, rx, b = records[r + c.MY], records[r + c.RX], records[r + c.QB]
    top, bottom = float32(first) + c.HALF - my, float32(last) + c.HALF - my
    tip = -b / (records[r + c.QC] * float32(2)) * rx
    right, left = min(max(tip, top), bottom), min(max(-tip, top), bottom)
    half = c.HALF / records[r + c.QA]
    det = records[r + c.DET]  # 4 QA QC - QB^2, from the covariance, where it does not cancel
    reach = float32(4) * records[r + c.QA] * records[r + c.REACH]
    x1 = rx if right == tip else (-b * right + math.sqrt(max(float32(0), reach - det * right * right))) * half
    x0 = -rx if left == -tip else (-b * left - math.sqrt(max(float32(0), reach - det * left * left))) * half
    mx = records[r + c.MX]
    return (
        within(np.ceil(mx + x0 - c.HALF - c.SLACK), records[r + c.X0], records[r + c.X0], records[r + c.X1] + c.ONE),
        within(np.floor(mx + x1 - c.HALF + c.SLACK), records[r + c.X1], records[r + c.X0] - c.ONE, records[r + c.X1]),
    )


@kernel
def depth_order(depths, counts, keys, order, keys_other, order_other):
    """The packed records, near ones first: a radix sort of positive floats by their bits, 11 at a time.

    Worker w packed the first ``counts[w]`` of its part of ``depths [N]``, as uint32; the others are scratch.
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
def tiles_across(records, r, ty, y0, y1):
    """First and last column of tiles that the record at ``r`` touches in the tile row ``ty``; none: last < first."""
    x0, x1 = np.int32(records[r + c.X0]), np.int32(records[r + c.X1])
    if y0 // c.TILE == y1 // c.TILE and x0 // c.TILE == x1 // c.TILE:
        return x0 // c.TILE, x1 // c.TILE
    x0, x1 = extent(records, r, max(ty * c.TILE, y0), min(ty * c.TILE + c.TILE - 1, y1))
    return (x0 // c.TILE, x1 // c.TILE) if x1 >= x0 else (np.int32(0), np.int32(-1))


@kernel
def count_tiles(worker, workers, records, order, across, histogram, totals):
    """Counts this worker's Gaussians per tile (its row of the histogram) and pairs of Gaussian and tile (its total)."""
    histogram[worker, :] = 0
    first, last = len(order) * worker // workers, len(order) * (worker + 1) // workers
    tally, records, order = pointer(histogram[worker]), pointer(records), pointer(order)
    total = 0
    for j in range(first, last):
        prefetch(records, order[min(j + c.AHEAD, last - 1)] * c.RECORD)
        r = order[j] * c.RECORD
        y0, y1 = np.int32(records[r + c.Y0]), np.int32(records[r + c.Y1])
        for ty in range(y0 // c.TILE, y1 // c.TILE + 1):
            low, high = tiles_across(records, r, ty, y0, y1)
            for tx in range(low, high + 1):
                tally[ty * across + tx] += 1
            total += high + 1 - low
    totals[worker] = total


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
def fill_tiles(worker, workers, records, order, across, histogram, totals, slots, entries, entry_slots):
    """Writes each tile's Gaussians in depth order, with the slot that receives the pair's gradient.

    ``slots[2 p]`` to ``slots[2 p + 1]`` are the slots of the record p.
    """
    first, last = len(order) * worker // workers, len(order) * (worker + 1) // workers
    cursor, records, order, slots = pointer(histogram[worker]), pointer(records), pointer(order), pointer(slots)
    entries, entry_slots = pointer(entries), pointer(entry_slots)
    slot = totals[worker]
    for j in range(first, last):
        prefetch(records, order[min(j + c.AHEAD, last - 1)] * c.RECORD)
        p = order[j]
        r = p * c.RECORD
        y0, y1 = np.int32(records[r + c.Y0]), np.int32(records[r + c.Y1])
        slots[2 * p] = slot
        for ty in range(y0 // c.TILE, y1 // c.TILE + 1):
            low, high = tiles_across(records, r, ty, y0, y1)
            for tx in range(low, high + 1):
                at = cursor[ty * across + tx]
                cursor[ty * across + tx] = at + 1
                entries[at] = p
                entry_slots[at] = slot
                slot += 1
        slots[2 * p + 1] = slot

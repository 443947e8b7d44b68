"""One frame of the CPU's rasterizer: scratch memory, projection, depth order, tile lists, and blending both ways."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from torch import Tensor

from clod_adapter._kernels import blend, blocks, conventions, threads, tiles
from clod_adapter._kernels.memory import recycled, recycled_array
from clod_adapter._kernels.project import project
from clod_adapter.cameras import Camera
from clod_adapter.config import CLASSIC, AttenuationConfig, ScreenFilter
from clod_adapter.equation.attenuation import FAINTEST, culling_threshold, log_threshold
from clod_adapter.equation.growth import growth_distance

FEW = 4096  # rows that one thread projects or lists in about a tenth of a millisecond


@dataclass
class Frame:
    """State of the forward pass for the backward pass."""

    camera: np.ndarray
    width: int
    height: int
    across: int
    records: np.ndarray
    packed_ids: np.ndarray
    counts: np.ndarray
    slots: np.ndarray
    entries: np.ndarray
    entry_slots: np.ndarray
    masks: np.ndarray
    offsets: np.ndarray
    tiles: np.ndarray
    compensated: bool | None
    workers: int

    def blend(self, background: np.ndarray) -> tuple[Tensor, Tensor]:
        """The image and its alpha."""
        image, alpha = recycled((self.height, self.width, 3)), recycled((self.height, self.width))
        threads.run(
            blend.blend, self.workers, self.records, self.entries, self.offsets, self.across, self.width, self.height,
            background, self.tiles, np.zeros(1, np.int64), self._room(blocks.FORWARD_STATE), self.masks, image.numpy(),
            alpha.numpy(),
        )  # fmt: skip
        return image, alpha

    def blend_gradient(
        self, image: Tensor, alpha: Tensor, v_image: Tensor, v_alpha: Tensor, shaped: bool, colored: bool
    ) -> np.ndarray:
        """The sums over pixels of each pair of Gaussian and tile, those of shape and colour if asked for."""
        # Reads of the last pair are sixteen floats wide too.
        sums = recycled_array((len(self.entries) * conventions.PAIR + 16,), np.float32)
        given = [x.contiguous().numpy() for x in (image, alpha, v_image, v_alpha)]
        threads.run(
            blend.blend_gradient, self.workers, self.records, self.entries, self.entry_slots, self.offsets,
            self.across, self.width, self.height, *given, self.tiles, np.zeros(1, np.int64),
            self._room(blocks.BACKWARD_STATE), self.masks, shaped, colored, sums,
        )  # fmt: skip
        return sums

    def _room(self, size: int) -> np.ndarray:
        """Scratch floats for each worker."""
        return recycled_array((self.workers, size), np.float32)


def camera_vector(camera: Camera, screen_filter: ScreenFilter = CLASSIC) -> np.ndarray:
    """Camera and screen-space filter in the layout of the kernels (``_kernels/conventions.py``)."""
    out = np.empty(conventions.CAMERA, np.float32)
    viewmat, K = (x.detach().cpu().double().numpy() for x in (camera.viewmat, camera.K))
    fx, fy, cx, cy = (float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2]))
    out[:16] = viewmat.reshape(-1)
    out[16:22] = fx, fy, cx, cy, camera.width, camera.height
    margin_x, margin_y = 0.15 * camera.width / fx, 0.15 * camera.height / fy
    out[22:24] = -(cx / fx + margin_x), (camera.width - cx) / fx + margin_x
    out[24:26] = -(cy / fy + margin_y), (camera.height - cy) / fy + margin_y
    out[26:29] = -viewmat[:3, 3] @ viewmat[:3, :3]
    out[conventions.NEAR] = camera.near
    out[conventions.BLUR], out[conventions.COMPENSATE] = screen_filter.variance, screen_filter.compensate
    return out


def dial_vector(config: AttenuationConfig, virtual_scale: float, unit: float = 1.0) -> np.ndarray:
    """A dial value in the layout of the kernels, for distances in multiples of ``unit``."""
    out, rate = np.empty(conventions.DIAL, np.float32), virtual_scale / unit
    out[conventions.RATE], out[conventions.GROWTH_RATE] = rate, rate / growth_distance(config)
    out[conventions.HALF_EPS], out[conventions.SOFT] = config.eps / 2, config.cut == "soft"
    out[conventions.THRESHOLD] = max(culling_threshold(config.tau, virtual_scale), FAINTEST)
    out[conventions.LOG_THRESHOLD] = log_threshold(config.tau, virtual_scale)
    return out


def workers_for(rows: int) -> int:
    """One for few rows, whose work takes less time than waking another thread."""
    return threads.worker_count() if rows >= FEW else 1


def prepare(
    arrays: list[np.ndarray], degree: int, camera: Camera, screen_filter: ScreenFilter, dial: np.ndarray | None
) -> Frame:
    """Projection, depth order and tile lists of ``arrays``, which are as the kernel ``project`` takes them."""
    cam, n, workers = camera_vector(camera, screen_filter), len(arrays[0]), workers_for(len(arrays[0]))
    records, counts = recycled_array(((n + workers) * conventions.RECORD,), np.float32), np.zeros(workers, np.int64)
    depths, packed_ids = recycled_array((n,), np.float32), recycled_array((n,), np.int32)
    threads.run(project, workers, *arrays, degree, cam, dial, records, depths, packed_ids, counts)
    keys, order, *others = (recycled_array((int(counts.sum()),), kind) for kind in (np.uint32, np.int32) * 2)
    order = tiles.depth_order(depths.view(np.uint32), counts, keys, order, *others)
    across, down = -(-camera.width // conventions.TILE), -(-camera.height // conventions.TILE)
    listing = workers_for(len(order))
    histogram, totals = np.empty((listing, across * down), np.int64), np.empty(listing, np.int64)
    offsets, slots = np.empty(across * down + 1, np.int64), recycled_array((2 * n,), np.int32)
    threads.run(tiles.count_tiles, listing, records, order, across, histogram, totals)
    total = tiles.tile_offsets(histogram, offsets, totals)
    entries, entry_slots = recycled_array((total,), np.int32), recycled_array((total,), np.int32)
    threads.run(tiles.fill_tiles, listing, records, order, across, histogram, totals, slots, entries, entry_slots)
    # Longest lists first: no thread starts a long tile when the others are done.
    longest_first = np.argsort(-np.diff(offsets), kind="stable")
    return Frame(
        cam, camera.width, camera.height, across, records, packed_ids, counts, slots, entries,
        entry_slots, recycled_array((total * blocks.WORDS,), np.uint64), offsets, longest_first,
        screen_filter.compensate or None, threads.worker_count(),
    )  # fmt: skip

"""Tile-based splatting on the CPU, compiled by Numba: forward and backward pass on several
threads.
"""

import math
from collections.abc import Iterable
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from clod_adapter._kernels import blend, conventions, dial, threads, tiles
from clod_adapter._kernels.conventions import Dial, Drawing, Packed, Picture, Stored, Tiles
from clod_adapter._kernels.memory import recycled, recycled_array
from clod_adapter._kernels.project import project
from clod_adapter._kernels.project_gradient import project_gradient
from clod_adapter._support.arrays import float64_array
from clod_adapter.cameras import Camera
from clod_adapter.config import CLASSIC, AttenuationConfig, ScreenFilter
from clod_adapter.equation.attenuation import check_dial, growth_distance
from clod_adapter.gaussians import Gaussians
from clod_adapter.rasterizers.protocol import Rasterizer, behind, require_float32

NOTHING = torch.empty(0, dtype=torch.float32, device="cpu")  # no dial, or no growth
FEW = 4096  # rows that one thread projects or lists in about a tenth of a millisecond
FASTEST = 1e18  # rate of a dial, whose square float32 holds


def drawing_of(camera: Camera, screen_filter: ScreenFilter, dial: Dial, **more: Any) -> Drawing:
    """Settings for the kernels. Rays are clamped to the image and 15 % of its size around it, as
    Inria's and gsplat's rasterizers clamp them for the Jacobian of the projection.
    """
    viewmat = float64_array(camera.viewmat)
    K = float64_array(camera.K)
    fx = K[0, 0]
    fy = K[1, 1]
    cx = K[0, 2]
    cy = K[1, 2]
    margin_x = 0.15 * camera.width / fx
    margin_y = 0.15 * camera.height / fy
    numbers = {
        "fx": fx,
        "fy": fy,
        "cx": cx,
        "cy": cy,
        "width": camera.width,
        "height": camera.height,
        "low_x": -(cx / fx + margin_x),
        "high_x": (camera.width - cx) / fx + margin_x,
        "low_y": -(cy / fy + margin_y),
        "high_y": (camera.height - cy) / fy + margin_y,
        "near": camera.near,
        "blur": screen_filter.variance,
    }
    return Drawing(
        viewmat=viewmat.astype(np.float32).reshape(-1),
        eye=(-viewmat[:3, 3] @ viewmat[:3, :3]).astype(np.float32),
        compensate=screen_filter.compensate,
        dial=dial,
        **{name: np.float32(number) for name, number in numbers.items()},
        **more,
    )


def dial_of(config: AttenuationConfig | None, virtual_scale: float) -> Dial:
    """A dial value for the kernels: squares of s / D, of s / (D r), and of 1 / H, with the
    unit of distances D, the start of growth r and the end of near Gaussians H, both in D.
    """
    if config is None:
        return Dial()
    rate = virtual_scale / config.scene_distance
    near = config.scene_distance / config.near_distance if config.near_distance > 0 else 0.0
    rates = rate, rate / growth_distance(config), near
    return Dial(*(np.float32(min(each, FASTEST) ** 2) for each in rates))


def workers_for(rows: int) -> int:
    """One for few rows, whose work takes less time than waking another thread."""
    return threads.worker_count() if rows >= FEW else 1


class ForwardState:
    """State of the forward pass for the backward pass: projection, depth order and tile lists."""

    def __init__(
        self,
        stored: Stored,
        camera: Camera,
        screen_filter: ScreenFilter,
        dial: Dial,
    ) -> None:
        n = len(stored.means)
        workers = workers_for(n)
        self.compensated = screen_filter.compensate or None
        self.drawing = drawing_of(
            camera,
            screen_filter,
            dial,
            degree=math.isqrt(stored.shN.shape[1] + 1) - 1,
            fades=len(stored.sigma) > 0,
            grows=len(stored.growth) > 0,
        )
        self.packed = Packed(
            recycled_array(((n + workers) * conventions.RECORD,), np.float32),
            recycled_array((n,), np.float32),
            recycled_array((n,), np.int32),
            np.zeros(workers, np.int64),
        )
        threads.run(project, workers, stored, self.drawing, self.packed)
        order = tiles.depth_order(self.packed.depths.view(np.uint32), self.packed.counts)
        across = -(-camera.width // conventions.TILE)
        down = -(-camera.height // conventions.TILE)
        listing = workers_for(len(order))
        histogram = np.zeros((listing, across * down), np.int64)
        totals = np.zeros(listing, np.int64)
        listed = self.packed.records, order, across, histogram, totals
        # only counts the entries, as there is no room for them yet
        threads.run(tiles.list_tiles, listing, *listed, *[np.empty(0, np.int32)] * 3)
        # from counts to first entries, tile by tile and in a tile worker by worker
        ends = histogram.T.cumsum().reshape(-1, listing)
        histogram[:] = ends.T - histogram
        totals[:] = totals.cumsum() - totals
        offsets = np.append(0, ends[:, -1])
        total = int(offsets[-1])
        self.slots = recycled_array((2 * n,), np.int32)
        entries = recycled_array((total,), np.int32)
        self.entry_slots = recycled_array((total,), np.int32)
        threads.run(tiles.list_tiles, listing, *listed, self.slots, entries, self.entry_slots)
        self.tiles = Tiles(
            self.packed.records,
            entries,
            offsets,
            recycled_array((total * blend.WORDS,), np.uint64),
            # Longest lists first: no thread starts a long tile when the others are done.
            np.argsort(-np.diff(offsets), kind="stable"),
            across,
            camera.width,
            camera.height,
        )

    def blend(self, background: np.ndarray) -> tuple[Tensor, Tensor]:
        """The image and its alpha."""
        size = self.tiles.height, self.tiles.width
        image = recycled((*size, 3))
        alpha = recycled(size)
        picture = Picture(image.numpy(), alpha.numpy())
        self._run(blend.blend, blend.FORWARD_STATE, background, picture)
        return image, alpha

    def blend_gradient(
        self,
        picture: Picture,
        gradients: Picture,
        shaped: bool,
        colored: bool,
    ) -> np.ndarray:
        """The sums over pixels of each pair of Gaussian and tile, those of shape and colour if
        asked for.
        """
        # Reads of the last pair are sixteen floats wide too.
        sums = recycled_array((len(self.entry_slots) * conventions.PAIR + 16,), np.float32)
        arguments = self.entry_slots, picture, gradients, shaped, colored, sums
        self._run(blend.blend_gradient, blend.BACKWARD_STATE, *arguments)
        return sums

    def _run(self, kernel: Any, state: int, *arguments: Any) -> None:
        """Runs a kernel over all tiles, with ``state`` floats of scratch for each worker."""
        workers = threads.worker_count()
        room = recycled_array((workers, state), np.float32)
        threads.run(kernel, workers, self.tiles, np.zeros(1, np.int64), room, *arguments)


def _arrays(tensors: Iterable[Tensor]) -> list[np.ndarray]:
    """Contiguous float32 arrays."""
    return [tensor.detach().contiguous().numpy() for tensor in tensors]


class _Picture(torch.autograd.Function):
    """Gaussians as they are stored, at one dial value, or activated ones, as ``dial`` says.

    ``inputs`` are the tensors of ``Stored``. Without a dial, sigma is empty, without growth its
    exponents.
    """

    @staticmethod
    def forward(  # type: ignore[no-untyped-def]
        ctx: Any, camera, screen_filter, dial, trained, background, *inputs
    ):
        frame = ForwardState(Stored(*_arrays(inputs)), camera, screen_filter, dial)
        image, alpha = frame.blend(background.detach().contiguous().numpy())
        ctx.frame = frame
        ctx.trained = trained
        ctx.save_for_backward(image, alpha, *inputs)
        return image, alpha

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *slopes: Tensor):  # type: ignore[no-untyped-def, override]
        image, alpha, *inputs = ctx.saved_tensors
        frame: ForwardState = ctx.frame
        need = Stored(*ctx.needs_input_grad[5:])  # after the five arguments before ``inputs``
        # Unused sums are skipped. Above SH degree 0, a mean changes the colour too.
        shaped = need.means or need.quats or need.scales or need.growth
        colored = need.sh0 or need.shN or (shaped and frame.drawing.degree > 0)
        pair_sums = frame.blend_gradient(
            Picture(*_arrays((image, alpha))), Picture(*_arrays(slopes)), shaped, colored
        )
        written = need._replace(means=shaped, quats=shaped, scales=shaped)
        written = written._replace(opacities=True, sigma=True, growth=True)
        gradients = [
            recycled(x.shape if is_written else (0, *x.shape[1:]))
            for x, is_written in zip(inputs, written, strict=True)
        ]
        threads.run(
            project_gradient,
            len(frame.packed.counts),
            Stored(*_arrays(inputs)),
            frame.drawing,
            frame.packed,
            frame.slots,
            pair_sums,
            frame.compensated,
            ctx.trained,
            Stored(*_arrays(gradients)),
        )
        background = None
        if ctx.needs_input_grad[4]:
            background = ((1 - alpha)[..., None] * slopes[0]).sum((0, 1))
        requested = [g if needed else None for g, needed in zip(gradients, need, strict=True)]
        return None, None, None, None, background, *requested


class _Compiled(Rasterizer):
    """The dial is the first part of the projection, and the last of its gradient: what it culls is
    not touched again, and nothing is copied.
    """

    def draw(
        self,
        gaussians: Gaussians,
        camera: Camera,
        virtual_scale: float = 1.0,
        *,
        background: Tensor | np.ndarray | None = None,
        seen_from: Camera | None = None,
        trained: int | None = None,
    ) -> tuple[Tensor, Tensor]:
        background = behind(gaussians, background)
        if seen_from is not None or _composed(gaussians):
            return super().draw(
                gaussians, camera, virtual_scale, background=background, seen_from=seen_from
            )
        check_dial(virtual_scale)
        g = gaussians
        sigma_d = NOTHING if g.sigma_d is None else g.sigma_d.float()
        growth_d = NOTHING if g.growth_d is None else g.growth_d.float()
        require_float32(
            "CPU",
            **(g.tensors() | {"sigma_d": sigma_d, "growth_d": growth_d, "background": background}),
        )
        return _Picture.apply(  # type: ignore[no-any-return, no-untyped-call]
            camera,
            g.screen_filter,
            dial_of(g.attenuation, virtual_scale),
            len(g) if trained is None else trained,
            background,
            *Stored(
                g.means,
                g.quats,
                g.log_scales,
                g.opacity_logits,
                sigma_d,
                growth_d,
                g.sh0,
                g.shN,
            ),
        )

    @torch.no_grad()
    def kept(self, gaussians: Gaussians, camera: Camera, virtual_scale: float) -> Tensor:
        if (
            gaussians.sigma_d is None
            or gaussians.means.dtype != torch.float32
            or _composed(gaussians)
        ):
            return super().kept(gaussians, camera, virtual_scale)
        marks = np.empty(len(gaussians), np.uint8)
        threads.run(
            dial.mark_kept,
            workers_for(len(marks)),
            *_arrays((gaussians.means, gaussians.sigma_d.float())),
            drawing_of(camera, CLASSIC, dial_of(gaussians.attenuation, virtual_scale)),
            marks,
        )
        return torch.from_numpy(marks).view(torch.bool)


def _composed(gaussians: Gaussians) -> bool:
    """Whether the dial is composed with ``rasterize``, as the paper's form is: it has no
    kernels.
    """
    return gaussians.attenuation is not None and gaussians.attenuation.form == "paper"


def rasterize(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    sh0: Tensor,
    shN: Tensor,
    camera: Camera,
    background: Tensor,
    screen_filter: ScreenFilter = CLASSIC,
) -> tuple[Tensor, Tensor]:
    """See ``clod_adapter.rasterizers.Splat``; of float32 tensors alone."""
    inputs = Stored(means, quats, scales, opacities, NOTHING, NOTHING, sh0, shN)
    require_float32("CPU", **inputs._asdict(), background=background)
    return _Picture.apply(  # type: ignore[no-any-return, no-untyped-call]
        camera,
        screen_filter,
        Dial(activated=True),
        len(means),
        background,
        *inputs,
    )


RASTERIZER = _Compiled(rasterize)

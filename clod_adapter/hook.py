"""The dial as a function for any renderer: it takes the opacities and returns those to rasterize.

hook = clod_adapter.load("model.ply").hook(virtual_scale=3)
opacities, keep, growth = hook(means, opacities, viewmat, K, width, height)
scales = scales * growth[:, None]

``Hook.hold`` moves the dial so that frames take a given time.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor

from clod_adapter._support.arrays import float_tensor, tensor_of
from clod_adapter.cameras import NEAR, Camera
from clod_adapter.config import AttenuationConfig, require
from clod_adapter.equation.attenuation import Attenuated, attenuate, check_dial, warn_of_no_dial
from clod_adapter.errors import ClodError
from clod_adapter.frame_rate import DEAD_BAND, FRAMES, NEWEST, TimedFrame, excess, next_dial

Array = TypeVar("Array", Tensor, np.ndarray[Any, Any])


@dataclass(frozen=True)
class Hook:
    """One dial value for one set of Gaussians; ``dataclasses.replace(hook, virtual_scale=2)``
    changes it.

    Attributes:
        sigma_d: ``[N]``, in the order of the Gaussians that the hook is called with.
        attenuation: settings of ``sigma_d``.
        virtual_scale: the dial s >= 0.
        growth_d: ``[N]`` exponents of the growth of the scales, in the same order; None for no
            growth.

    Raises:
        ClodError: the dial is negative or not finite.
    """

    sigma_d: Tensor
    attenuation: AttenuationConfig
    virtual_scale: float = 1.0
    growth_d: Tensor | None = None

    def __post_init__(self) -> None:
        for name in ("sigma_d", "growth_d"):
            if (column := getattr(self, name)) is not None:
                object.__setattr__(self, name, float_tensor(column))
        check_dial(self.virtual_scale)

    def __call__(
        self,
        means: Array,
        opacities: Array,
        viewmat: Any,
        K: Any = None,
        width: int = 1,
        height: int = 1,
        near: float = NEAR,
    ) -> tuple[Array, Array, Array]:
        """The opacities to draw with, the kept rows, and the factors of the scales.

        Opacities are 0 for culled Gaussians; ``[N]`` bool are the kept ones. The factors ``[N]``
        (``attenuation.growth_factors``) are ones without a ``growth_d``. numpy in, numpy out; torch
        in, torch out, on the means' device, differentiable in ``opacities``, ``sigma_d`` and
        ``growth_d``.

        Args:
            means: ``[N, 3]`` world units.
            opacities: ``[N]`` or ``[N, 1]`` activated, in [0, 1]; the result has its shape and
                dtype.
            viewmat: ``[4, 4]`` array or tensor, world to camera, a rotation and a translation,
                OpenCV axes.
            K: ``[3, 3]`` likewise, intrinsics in pixels; with ``width``, ``height`` and ``near``
                the frustum, which the paper's form needs.

        Raises:
            ClodError: shapes do not fit the hook or each other, means or opacities are integers, or
                K is missing in the paper's form.
        """
        if K is None and self.attenuation.form == "paper":
            raise ClodError("the paper's form needs K, width and height in the hook's call")
        camera = Camera(
            _matrix(viewmat), _matrix(np.eye(3) if K is None else K), width, height, near=near
        )
        opacity_tensor = tensor_of(opacities)
        drawn, keep, growth = self.attenuate(tensor_of(means), opacity_tensor, camera)
        result: Any = drawn.reshape(opacity_tensor.shape).to(opacity_tensor.dtype), keep, growth
        if isinstance(means, Tensor):
            return result  # type: ignore[no-any-return]
        return tuple(tensor.detach().numpy() for tensor in result)  # type: ignore[return-value]

    def attenuate(self, means: Tensor, opacities: Tensor, camera: Camera) -> Attenuated:
        """The same for a ``Camera``, with everything that ``attenuation.attenuate`` returns."""
        n = len(self.sigma_d)
        if means.shape != (n, 3) or opacities.shape not in ((n,), (n, 1)):
            raise ClodError(
                f"the dial is for {n} Gaussians, but means is {tuple(means.shape)} and opacities "
                f"{tuple(opacities.shape)}; pass the rows of the file that it was loaded from"
            )
        require(means.is_floating_point(), "means", means.dtype, "floating point: .float()")
        sigma_d = self.sigma_d.to(means.device)
        growth_d = None if self.growth_d is None else self.growth_d.to(means.device)
        return attenuate(
            opacities.reshape(n),
            sigma_d,
            (means, camera),
            self.virtual_scale,
            self.attenuation,
            activated=True,
            growth_d=growth_d,
        )

    def hold(self, milliseconds: float) -> Hold:
        """A dial that starts at this value and follows the measured time of a frame (``Hold``)."""
        return Hold(self, milliseconds)


def dropped_in(
    sigma_d: Tensor | None,
    virtual_scale: float,
    attenuation: AttenuationConfig | None,
    growth_d: Tensor | None,
) -> AttenuationConfig | None:
    """The settings of a drop-in's call; None without a ``sigma_d``, and a warning if
    ``virtual_scale`` is above 1.
    """
    if growth_d is not None and (sigma_d is None or attenuation is None):
        raise ClodError(
            "growth_d needs sigma_d and attenuation, which says where growth begins; pass"
            " Gaussians.attenuation of the file, or AttenuationConfig() for 1 world unit"
        )
    if sigma_d is None:
        warn_of_no_dial(virtual_scale, "pass sigma_d, growth_d and attenuation of the file", 4)
        return None
    return attenuation or AttenuationConfig()


@dataclass
class Hold:
    """A hook whose dial value holds the time of a frame, in any renderer, by the law of
    ``frame_rate``.

        hold = hook.hold(milliseconds=16.7)
        for viewmat in path:
            with hold.frame() as hook:
                drawn, keep, growth = hook(means, opacities, viewmat, K, width, height)
                ...  # rasterize

    The drop-ins for gsplat and Inria's rasterizer take ``virtual_scale=hook.virtual_scale`` inside
    the block.

    The budget is for the work of a frame, not for the interval between frames, which vertical
    synchronisation rounds up to whole refreshes. Half of the frames take longer than the median
    that is held: leave room for the noise, for example 13 ms for 60 frames per second.

    Attributes:
        hook: the hook of the next frame. The dial stays in [1, max_sv] and changes by at most 10 %
            per frame.
        milliseconds: the budget, above 0.

    Raises:
        ClodError: the budget is not above 0 and finite.
    """

    hook: Hook
    milliseconds: float
    _frames: list[TimedFrame] = field(default_factory=list, init=False, repr=False)

    def __post_init__(self) -> None:
        require(
            0 < self.milliseconds < np.inf, "milliseconds", self.milliseconds, "above 0 and finite"
        )
        max_sv = self.hook.attenuation.max_sv
        self.hook = replace(self.hook, virtual_scale=min(self.hook.virtual_scale, max_sv))

    @contextmanager
    def frame(self) -> Iterator[Hook]:
        """The hook of this frame; the duration of the block, CUDA's work included, is passed to
        ``took``.
        """
        _synchronize()
        start = time.perf_counter()
        yield self.hook
        _synchronize()
        self.took(1000 * (time.perf_counter() - start))

    def took(self, milliseconds: float) -> None:
        """Takes the time of the frame that ``hook`` drew, from a GPU's timer for example, and moves
        the dial.
        """
        require(
            0 <= milliseconds < np.inf,
            "the time of a frame",
            milliseconds,
            "at least 0 ms and finite",
        )
        self._frames = [*self._frames, (self.hook.virtual_scale, milliseconds)][-FRAMES:]
        dial = next_dial(self._frames, self.milliseconds, self.hook.attenuation.max_sv)
        self.hook = replace(self.hook, virtual_scale=dial)

    @property
    def out_of_reach(self) -> bool:
        """True while frames at ``max_sv``, at least 3 so far, take longer than the budget; the dial
        stays there.
        """
        at_max = [dial == self.hook.attenuation.max_sv for dial, _ in self._frames[-NEWEST:]]
        return at_max == [True] * NEWEST and excess(self._frames, self.milliseconds) > DEAD_BAND


def _synchronize() -> None:
    """Waits for CUDA's work, which is asynchronous, where the process uses CUDA."""
    if torch.cuda.is_initialized():
        torch.cuda.synchronize()


def _matrix(values: Any) -> Tensor:
    """The matrix in float32 at least: integers and float16 are too coarse for a camera."""
    matrix = tensor_of(values)
    return matrix.to(torch.promote_types(matrix.dtype, torch.float32))

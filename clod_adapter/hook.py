"""The dial as a function for any renderer: it takes the opacities and returns those to rasterize.

hook = clod_adapter.load("model.ply").hook(virtual_scale=3)
opacities, keep, growth = hook(means, opacities, viewmat, K, width, height, growth=True)
scales = scales * growth[:, None]
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, TypeVar, overload

import numpy as np
import torch
from torch import Tensor

from clod_adapter.cameras import NEAR, Camera
from clod_adapter.config import AttenuationConfig
from clod_adapter.equation.attenuation import Attenuated, attenuate, check_dial
from clod_adapter.errors import ClodError

Array = TypeVar("Array", Tensor, np.ndarray[Any, Any])


@dataclass(frozen=True)
class Hook:
    """One dial value for one set of Gaussians; ``dataclasses.replace(hook, virtual_scale=2)`` changes it.

    Attributes:
        sigma_d: ``[N]``, in the order of the Gaussians that the hook is called with.
        attenuation: settings of ``sigma_d``.
        virtual_scale: the dial s >= 1.
        growth_d: ``[N]`` exponents of the growth of the scales, in the same order; None for no growth.

    Raises:
        ClodError: the dial is below 1 or not finite.
    """

    sigma_d: Tensor
    attenuation: AttenuationConfig
    virtual_scale: float = 1.0
    growth_d: Tensor | None = None

    def __post_init__(self) -> None:
        check_dial(self.virtual_scale)

    @overload
    def __call__(
        self, means: Array, opacities: Array, viewmat: Any, K: Any = None, width: int = 1, height: int = 1,
        near: float = NEAR, *, growth: Literal[False] = False,
    ) -> tuple[Array, Array]: ...  # fmt: skip
    @overload
    def __call__(
        self, means: Array, opacities: Array, viewmat: Any, K: Any = None, width: int = 1, height: int = 1,
        near: float = NEAR, *, growth: Literal[True],
    ) -> tuple[Array, Array, Array]: ...  # fmt: skip
    def __call__(
        self, means: Array, opacities: Array, viewmat: Any, K: Any = None, width: int = 1, height: int = 1,
        near: float = NEAR, *, growth: bool = False,
    ) -> tuple[Array, ...]:  # fmt: skip
        """The opacities to draw with, 0 for culled Gaussians, and ``[N]`` bool, kept ones (CLoD-GS Eq. 2, its mask).

        With ``growth`` a third array follows, ``[N]`` factors of the scales (``growth.growth_factors``), in float32 or,
        if an input is float64, in float64; ones where the hook has no ``growth_d``.

        numpy in, numpy out; torch in, torch out, on the means' device, differentiable in ``opacities``, ``sigma_d`` and
        ``growth_d``. Distances are constants: no gradient reaches ``means`` and ``viewmat``. The camera's arguments may
        be numpy arrays or tensors, as viewers keep cameras in numpy and Gaussians on a GPU.

        Args:
            means: ``[N, 3]`` world units.
            opacities: ``[N]`` or ``[N, 1]`` activated, in [0, 1]; the result has its shape and dtype.
            viewmat: ``[4, 4]`` world to camera, a rotation and a translation, OpenCV axes.
            K: ``[3, 3]`` intrinsics in pixels. With ``width``, ``height`` and ``near`` it defines the frustum of the
                normalisers ``max`` and ``quantile``; ``scene`` needs none of them.

        Raises:
            ClodError: the shapes do not fit the hook or each other, or a normaliser that needs K has none.
        """
        if K is None and self.attenuation.normalizer != "scene":
            raise ClodError(f"normalizer {self.attenuation.normalizer} needs K, width and height in the hook's call")
        camera = Camera(_matrix(viewmat), _matrix(np.eye(3) if K is None else K), width, height, near=near)
        shown = _tensor(opacities)
        result = self.attenuate(_tensor(means), shown, camera)
        found = [result.drawn.reshape(shown.shape).to(shown.dtype), result.keep]
        if growth:
            found.append(torch.ones_like(result.opacities) if result.growth is None else result.growth)
        return tuple(found if isinstance(means, Tensor) else (each.detach().numpy() for each in found))

    def attenuate(self, means: Tensor, opacities: Tensor, camera: Camera) -> Attenuated:
        """The same for a ``Camera``, with everything that ``attenuation.attenuate`` returns."""
        n = len(self.sigma_d)
        if means.shape != (n, 3) or opacities.shape not in ((n,), (n, 1)):
            raise ClodError(
                f"the dial is for {n} Gaussians, but means is {tuple(means.shape)} and opacities "
                f"{tuple(opacities.shape)}; pass the rows of the file that it was loaded from"
            )
        sigma_d = self.sigma_d.to(means.device)
        growth_d = None if self.growth_d is None else self.growth_d.to(means.device)
        return attenuate(
            opacities.reshape(n), sigma_d, (means, camera), self.virtual_scale, self.attenuation, activated=True,
            growth_d=growth_d,
        )  # fmt: skip


def _tensor(values: Any) -> Tensor:
    """A tensor unchanged; an array as a copy, as torch accepts neither foreign byte order nor negative strides."""
    if isinstance(values, Tensor):
        return values
    array = np.asarray(values)
    return torch.from_numpy(array.astype(array.dtype.newbyteorder("="), order="C"))


def _matrix(values: Any) -> Tensor:
    """In float32 at least: integers and float16 are too coarse for a camera."""
    matrix = _tensor(values)
    return matrix.to(torch.promote_types(matrix.dtype, torch.float32))

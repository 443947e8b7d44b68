"""The dial as a function that any renderer can call, between its opacities and its rasterizer.

hook = clod_adapter.load("model.ply").hook(virtual_scale=3)
opacities, keep = hook(means, opacities, viewmat, K, width, height)
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor

from clod_adapter.attenuation import Attenuated, attenuate_activated, check_dial, normalized_distances
from clod_adapter.cameras import NEAR, Camera
from clod_adapter.config import AttenuationConfig
from clod_adapter.errors import ClodError

Array = TypeVar("Array", Tensor, np.ndarray[Any, Any])


@dataclass(frozen=True)
class Hook:
    """One dial value for one set of Gaussians; ``dataclasses.replace(hook, virtual_scale=2)`` turns it.

    Attributes:
        sigma_d: ``[N]``, row i of the Gaussian in row i of what the hook is called with.
        attenuation: how ``sigma_d`` is to be read.
        virtual_scale: the dial s >= 1.

    Raises:
        ClodError: the dial is below 1 or not finite.
    """

    sigma_d: Tensor
    attenuation: AttenuationConfig
    virtual_scale: float = 1.0

    def __post_init__(self) -> None:
        check_dial(self.virtual_scale)

    def __call__(
        self, means: Array, opacities: Array, viewmat: Any, K: Any = None, width: int = 1, height: int = 1,
        near: float = NEAR,
    ) -> tuple[Array, Array]:  # fmt: skip
        """The opacities to draw with, 0 for who is left out, and ``[N]`` bool who is kept (CLoD-GS Eq. 2, its mask).

        numpy in, numpy out; torch in, torch out, on the means' device, differentiable in ``opacities`` and in
        ``sigma_d``. Distances are constants: no gradient reaches ``means`` and ``viewmat``. The camera's arguments may
        be of either kind, as viewers have them in numpy beside Gaussians on a GPU.

        Args:
            means: ``[N, 3]`` world units.
            opacities: ``[N]`` or ``[N, 1]`` activated, in [0, 1]; the result has its shape and dtype.
            viewmat: ``[4, 4]`` world to camera, a rotation and a translation, OpenCV axes.
            K: ``[3, 3]`` intrinsics in pixels. With ``width``, ``height`` and ``near`` it says which Gaussians the
                normalisers ``max`` and ``quantile`` look at; ``scene`` does without.

        Raises:
            ClodError: the shapes do not fit the hook or each other, or a normaliser that needs K has none.
        """
        if K is None and self.attenuation.normalizer != "scene":
            raise ClodError(f"normalizer {self.attenuation.normalizer} needs K, width and height in the hook's call")
        camera = Camera(_matrix(viewmat), _matrix(np.eye(3) if K is None else K), width, height, near=near)
        shown = _tensor(opacities)
        result = self.attenuate(_tensor(means), shown, camera)
        drawn = result.drawn.reshape(shown.shape).to(shown.dtype)
        if isinstance(means, Tensor):
            return drawn, result.keep
        return drawn.detach().numpy(), result.keep.numpy()

    def attenuate(self, means: Tensor, opacities: Tensor, camera: Camera) -> Attenuated:
        """The same of a ``Camera``, with all that ``attenuation.attenuate`` returns."""
        n = len(self.sigma_d)
        if means.shape != (n, 3) or opacities.shape not in ((n,), (n, 1)):
            raise ClodError(
                f"the dial is for {n} Gaussians, but means is {tuple(means.shape)} and opacities "
                f"{tuple(opacities.shape)}; give it the rows that it came with"
            )
        distances = normalized_distances(means, camera, self.attenuation)
        sigma_d = self.sigma_d.to(means.device)
        return attenuate_activated(opacities.reshape(n), sigma_d, distances, self.virtual_scale, self.attenuation)


def _tensor(values: Any) -> Tensor:
    """A tensor as it is; else a copy, as torch takes neither another byte order nor steps backwards."""
    if isinstance(values, Tensor):
        return values
    array = np.asarray(values)
    return torch.from_numpy(array.astype(array.dtype.newbyteorder("="), order="C"))


def _matrix(values: Any) -> Tensor:
    """In float32 at least: neither whole numbers nor float16 are enough for a camera."""
    matrix = _tensor(values)
    return matrix.to(torch.promote_types(matrix.dtype, torch.float32))

"""A small test scene: whether a backend renders the image that the reference rasterizer renders."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from .checks import CheckFailed

if TYPE_CHECKING:
    from torch import Tensor

    from clod_adapter.cameras import Camera
    from clod_adapter.rasterizers import Rasterizer

TOLERANCE = 2e-4  # RMS of colours in [0, 1]: rounding, and a pixel or two on the other side of a threshold
INRIA_TOLERANCE = 5e-3  # Inria's code stops three standard deviations out


@dataclass(frozen=True)
class ReferenceScene:
    """Sixty Gaussians in front of a camera, and the reference rasterizer's image of them.

    Attributes:
        arguments: means, quats, scales, opacities, sh0 and shN, as a ``Rasterizer`` takes them.
        camera: 64x48, the principal point in the middle.
        image: ``[48, 64, 3]``, on black.
    """

    arguments: dict[str, Any]
    camera: Camera
    image: Tensor

    @classmethod
    def make(cls) -> ReferenceScene:
        import torch

        from clod_adapter.cameras import Camera
        from clod_adapter.rasterizers import reference

        random = torch.Generator().manual_seed(7)

        def normal(*shape: int) -> Tensor:
            return torch.randn(*shape, generator=random)

        arguments: dict[str, Any] = {
            "means": normal(60, 3).clamp(-1.5, 1.5), "quats": normal(60, 4), "scales": (0.5 * normal(60, 3) - 2).exp(),
            "opacities": (1.5 * normal(60)).sigmoid().clamp(max=0.95), "sh0": normal(60, 1, 3),
            "shN": 0.1 * normal(60, 3, 3),
        }  # fmt: skip
        viewmat = torch.eye(4)
        viewmat[2, 3] = 4.0
        camera = Camera(viewmat, torch.tensor([[60.0, 0, 32], [0, 60, 24], [0, 0, 1]]), 64, 48)
        image, _ = reference.rasterize(**arguments, camera=camera, background=torch.zeros(3))
        return cls(arguments, camera, image)

    def on(self, device: Any) -> dict[str, Any]:
        """The arguments on a device."""
        return {name: tensor.to(device) for name, tensor in self.arguments.items()}

    def check(self, rasterize: Rasterizer, device: Any) -> str:
        """Renders the scene on a device and compares the image; see ``compare``."""
        import torch

        image, _ = rasterize(**self.on(device), camera=self.camera, background=torch.zeros(3, device=device))
        return self.compare(image)

    def compare(self, image: Tensor, tolerance: float = TOLERANCE) -> str:
        """A line with the root mean square (RMS) difference of an image from the reference.

        Raises:
            CheckFailed: the shape differs, or the difference exceeds ``tolerance``.
        """
        shape = tuple(image.shape)
        error = float((image.detach().cpu() - self.image).square().mean().sqrt()) if shape == (48, 64, 3) else None
        if error is not None and error <= tolerance:  # not so for NaN
            return f"renders the reference image (RMS {error:.0e})"
        what = f"RMS {error:.2g}" if error is not None else f"shape {list(shape)}"
        raise CheckFailed(
            f"renders another image than the reference ({what})",
            "pip install --force-reinstall numba; if that does not help, report it with clod-adapt doctor --json",
        )

"""What ``clod-adapt doctor`` finds, and the small picture by which it tells whether something draws."""

from __future__ import annotations

import io
import warnings
from collections.abc import Callable
from contextlib import redirect_stdout
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from torch import Tensor

    from clod_adapter.cameras import Camera
    from clod_adapter.rasterizers import Rasterizer

Look = Callable[[], str]
"""Does a thing, and says what it found; raises Off, or whatever else, where that does not work."""
CLOSE = 2e-4  # RMS from the reference, of colours in [0, 1]: rounding, and a pixel or two on the other side of a cut
NEARLY = 5e-3  # as Inria's code draws, which stops three standard deviations out


class Off(Exception):
    """A thing does not work here.

    Args:
        found: what there is instead, in a few words.
        fix: the line to type, or what to do.
    """

    def __init__(self, found: str, fix: str) -> None:
        super().__init__(found)
        self.found, self.fix = found, fix


@dataclass(frozen=True)
class Finding:
    """One line.

    Attributes:
        name: of what was looked at.
        ok: whether it works, as it was made to.
        found: what is there, or why it does not work.
        fix: the line that mends it; empty where it works, or where nobody knows one.
    """

    name: str
    ok: bool
    found: str
    fix: str = ""

    @classmethod
    def of(cls, name: str, look: Look) -> Finding:
        """What ``look`` finds. Whatever it raises is a finding, as what is looked at is somebody else's."""
        try:
            with warnings.catch_warnings(), redirect_stdout(io.StringIO()):  # gsplat prints, torch warns
                warnings.simplefilter("ignore")
                return cls(name, True, look())
        except Off as off:
            return cls(name, False, off.found, off.fix)
        except Exception as error:
            if isinstance(error.__cause__, KeyboardInterrupt):  # within the dispatching of a compiled function
                raise
            return cls(name, False, f"it failed with {type(error).__name__}: {first_line(error)}")

    def line(self, width: int) -> str:
        """``name  ok/off  what was found  -> the fixing line``; the name takes ``width`` letters."""
        fix = f"  -> {self.fix}" if self.fix else ""
        return f"{self.name:<{width}}{'ok' if self.ok else 'off':<5}{self.found}{fix}"

    def as_dict(self) -> dict[str, Any]:
        return asdict(self)


def first_line(error: BaseException) -> str:
    """What an error says, without the pages that some have after it."""
    return next((line.strip() for line in str(error).splitlines() if line.strip()), "it says nothing")


@dataclass(frozen=True)
class Miniature:
    """Sixty Gaussians in front of a camera, and what the reference makes of them.

    Attributes:
        arguments: means, quats, scales, opacities, sh0 and shN, as a ``Rasterizer`` takes them.
        camera: 64x48, the principal point in the middle.
        image: ``[48, 64, 3]``, black behind.
    """

    arguments: dict[str, Any]
    camera: Camera
    image: Tensor

    @classmethod
    def make(cls) -> Miniature:
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

    def drawn_by(self, rasterize: Rasterizer, device: Any) -> str:
        """ViewSampler it on a device and says how near the reference that is; raises Off where it is not near."""
        import torch

        image, _ = rasterize(**self.on(device), camera=self.camera, background=torch.zeros(3, device=device))
        return self.compare(image)

    def compare(self, image: Tensor, within: float = CLOSE) -> str:
        """How near a picture is to the reference's.

        Raises:
            Off: it is of another shape, or further off than ``within``, as a root mean square.
        """
        shape = tuple(image.shape)
        error = float((image.detach().cpu() - self.image).square().mean().sqrt()) if shape == (48, 64, 3) else None
        if error is not None and error <= within:  # not so for NaN
            return f"its picture is the reference's (RMS {error:.0e})"
        what = f"RMS {error:.2g}" if error is not None else f"shape {list(shape)}"
        raise Off(
            f"it draws another picture than the reference ({what})",
            "pip install --upgrade clod-adapter; if that does not help, report it with clod-adapt doctor --json",
        )

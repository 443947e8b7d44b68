"""The rasterizers that share one contract. A new backend is a line in BACKENDS."""

import importlib.util
import sys
from contextlib import contextmanager
from dataclasses import dataclass

import torch
from torch import Tensor

from clod_adapter.rasterizers import cpu


@dataclass(frozen=True)
class Backend:
    """A rasterizer with CPU tensors in and out, whatever its device and type."""

    module: str  # below clod_adapter.rasterizers
    device: str = "cpu"
    dtype: torch.dtype = torch.float32  # of its inputs
    # the same input gives the same bits; otherwise sums are rounded in no fixed order
    repeats: bool = True
    # factor on the tolerances; above 1 for float32 kernels with fast intrinsics
    looser: float = 1.0
    drops_last: bool = False  # leaves out the Gaussian that ends a pixel, as gsplat does

    def __call__(self, *args, **kwargs):
        def place(x):
            return x.to(self.device, self.dtype) if isinstance(x, Tensor) else x

        rasterize = importlib.import_module(f"clod_adapter.rasterizers.{self.module}").rasterize
        image, alpha = rasterize(
            *map(place, args), **{name: place(value) for name, value in kwargs.items()}
        )
        return image.cpu().float(), alpha.cpu().float()

    @property
    def stands_in(self):
        """Whether torch replaces the kernels; its speed and threads are not the backend's."""
        return self.module == "cuda" and self.device == "cpu"

    @property
    def rounding(self):
        """Tolerances between runs with one input, for ``assert_same`` and ``assert_close``."""
        return {"rtol": 0.0, "atol": 0.0} if self.repeats else {"rtol": 1e-3, "atol": 1e-3}


# gsplat's kernels are CUDA's alone. In torch, in float64, what is around them answers for every
# digit.
BACKENDS = {
    "cpu": Backend("cpu"),
    "cuda, gsplat in torch": Backend("cuda", dtype=torch.float64, drops_last=True),
    "cuda": Backend("cuda", "cuda", repeats=False, looser=50.0, drops_last=True),
}


@contextmanager
def torch_threads(count):
    """Sets the number of torch's threads, which kernels then use for few rows too, and restores it
    at the end.
    """
    before = torch.get_num_threads()
    few = cpu.FEW
    torch.set_num_threads(count)
    cpu.FEW = 0
    try:
        yield
    finally:
        torch.set_num_threads(before)
        cpu.FEW = few


def fresh_copy(monkeypatch, name, package, installed):
    """A second copy of ``clod_adapter.integrations.NAME``, imported with ``package`` replaced or
    absent.
    """
    monkeypatch.setitem(sys.modules, package, installed)
    spec = importlib.util.find_spec(f"clod_adapter.integrations.{name}")
    copy = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(copy)
    return copy


def gsplat_arguments(g, camera):
    """What ``gsplat.rasterization`` is given of Gaussians and a camera."""
    return {
        "means": g.means,
        "quats": g.quats,
        "scales": g.scales,
        "opacities": g.opacities,
        "colors": torch.cat([g.sh0, g.shN], 1),
        "sh_degree": g.sh_degree,
        "viewmats": camera.viewmat[None],
        "Ks": camera.K[None],
        "width": camera.width,
        "height": camera.height,
    }

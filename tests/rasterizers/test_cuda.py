"""Why gsplat cannot be used, in one line; the interfaces of its versions."""

import builtins
import re
import sys
from types import ModuleType
from typing import Any

import pytest
import torch
from torch import Tensor

import gsplat_in_torch as kernels
import gsplat_versions
from clod_adapter.config import FILTERS
from clod_adapter.rasterizers import cuda
from scenes import camera, scene


@pytest.mark.parametrize(
    ("version", "kernels", "error", "reason"),
    [
        ("1.5.3", None, None, "install nvcc"),
        ("1.3.0", 1, None, "gsplat 1.3.0 is too old.*pip install gsplat==1.5.3"),
        ("1.5.3+pt24cu124", 1, OSError("libcudart.so.12: cannot open"), "libcudart.so.12.*pip install gsplat==1.5.3"),
        ("", 1, ImportError("No module named 'gsplat'"), "gsplat.*pip install gsplat==1.5.3"),
    ],
)
def test_unusable_says_what_gsplat_lacks(
    monkeypatch: pytest.MonkeyPatch, version: str, kernels: Any, error: Exception | None, reason: str
) -> None:
    top, package, backend = (ModuleType(name) for name in ("gsplat", "gsplat.cuda", "gsplat.cuda._backend"))
    top.__version__, package._backend, backend._C = version, backend, kernels
    for module in (top, package, backend):
        monkeypatch.setitem(sys.modules, module.__name__, module)
    real = builtins.__import__

    def importing(name: str, *args: Any, **kwargs: Any) -> Any:
        if error and name == "gsplat":
            raise error
        return real(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", importing)
    cuda.unusable.cache_clear()
    try:
        found = cuda.unusable()
    finally:
        cuda.unusable.cache_clear()
    assert found is not None and re.search(reason, found) and "\n" not in found


def kernel(name: str, version: str, given: dict[str, Any]) -> Any:
    """A kernel in torch by a version's interface: its arguments, and the order of its results."""
    from gsplat.cuda import _torch_impl

    if name == "spherical_harmonics":
        degree, coefficients = given["degrees_to_use"], given["coeffs"]
        if "dirs" in given:
            return _torch_impl._spherical_harmonics(degree, given["dirs"], coefficients)
        means, viewmats = given["means"], given["viewmats"]
        assert means.shape == (len(coefficients), 3) and viewmats.shape == (1, 4, 4)
        eye = -viewmats[0, :3, :3].mT @ viewmats[0, :3, 3]
        return _torch_impl._spherical_harmonics(degree, means - eye, coefficients)[None]
    if name == "fully_fused_projection":
        found = kernels.fully_fused_projection(**given)
        if version in ("1.4.0", "1.5.0", "1.5.2"):
            return found if version == "1.4.0" else found[1:]
        bounds = [torch.tensor([0, len(found[0])], dtype=torch.int32)] if version == "1.6.0" else []
        return *found[:3], *bounds, *found[3:]
    if name == "isect_tiles":
        return kernels.isect_tiles(**{key: given[key] for key in given if key not in ("sort", "conics", "opacities")})
    if name == "isect_offset_encode":
        return _torch_impl._isect_offset_encode(*given.values())
    assert name == "rasterize_to_pixels" and given.pop("masks") is None
    return kernels.rasterize_to_pixels(*list(given.values())[:9], **dict(list(given.items())[9:]))


@pytest.mark.parametrize("version", gsplat_versions.signatures())
def test_every_version_draws_the_same(monkeypatch: pytest.MonkeyPatch, version: str) -> None:
    """Image and gradients; without opacities in the projection, as in 1.4.0, splats end a tenth nearer."""
    pytest.importorskip("gsplat", minversion="1.5.3", reason="pip install gsplat==1.5.3")
    pytest.importorskip("gsplat.cuda._torch_impl")

    def drawn() -> list[Tensor]:
        some = {name: x.double().requires_grad_() for name, x in scene(120, 2, 3).items()}
        background = torch.tensor([0.1, 0.2, 0.3], dtype=torch.float64)
        image, alpha = cuda.rasterize(
            **some, camera=camera(40, 30), background=background, screen_filter=FILTERS["mip"]
        )
        image.square().mean().backward()
        return [image.detach(), alpha.detach(), *(x.grad for x in some.values() if x.grad is not None)]

    def of(installed: str) -> list[Tensor]:
        monkeypatch.setitem(sys.modules, "gsplat", gsplat_versions.module(installed, kernel))
        return drawn()

    for mine, theirs in zip(of(version), of("1.5.3"), strict=True):
        atol = 0.02 * float(theirs.abs().max()) if version == "1.4.0" else 1e-6
        torch.testing.assert_close(mine, theirs, rtol=0, atol=atol)

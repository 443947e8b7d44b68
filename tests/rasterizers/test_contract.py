"""The contract of every backend: autograd, repeatability, robustness; and gsplat: the interfaces of
its versions, and in one line why it cannot be used.
"""

import builtins
import math
import re
import sys
from concurrent.futures import ThreadPoolExecutor
from types import ModuleType

import pytest
import torch
from refusals import refused

import gsplat_in_torch as kernels
import gsplat_versions
from backends import torch_threads
from clod_adapter.config import FILTERS
from clod_adapter.rasterizers import cpu, cuda, for_device
from oracle import BACKGROUND, Result, assert_same, differentiate, weights
from scenes import camera, scene

FIELDS = ("means", "quats", "scales", "opacities", "sh0", "shN")


def test_for_device(monkeypatch):
    assert for_device(torch.device("cpu")) is cpu.RASTERIZER
    with refused("no rasterizer for device meta"):
        for_device(torch.device("meta"))
    monkeypatch.setattr(cuda, "unusable", lambda: None)
    assert for_device(torch.device("cuda:1")).splat is cuda.rasterize
    monkeypatch.setattr(cuda, "unusable", lambda: "gsplat is not there: pip install gsplat==1.5.3")
    with refused(r"no rasterizer for the GPU: .*pip install gsplat==1.5.3; or use the CPU"):
        for_device(torch.device("cuda"))


def test_same_input_same_bits(rasterize):
    view, some = camera(130, 97), scene(300 if rasterize.stands_in else 2000, 2, 1)
    given, results = {name: value.clone() for name, value in some.items()}, {}
    for count in (1, 1, 2, 2, 3):
        with torch_threads(count):
            found = differentiate(rasterize, some, view, weights(view))
        assert_same(found, results.setdefault(count, found), **rasterize.rounding)
        assert_same(
            found,
            results[1],
            **({"rtol": 1e-5, "atol": 1e-5} if rasterize.repeats else rasterize.rounding),
        )
    assert all(torch.equal(some[name], given[name]) for name in some)


def test_several_forward_passes_keep_their_own_state(rasterize):
    """Backward passes in any order and repeated, with images and gradients large enough for
    recycled memory.
    """
    k, sizes = 1 if rasterize.stands_in else 3, [(300, (61, 45)), (500, (33, 70)), (150, (97, 31))]
    cases = [
        (scene(k**3 * n, 1, n, size=0.08 / k), camera(k * width, k * height))
        for n, (width, height) in sizes
    ]
    alone = [differentiate(rasterize, some, view, weights(view)) for some, view in cases]
    alive = []
    for some, view in cases:
        leaves = {
            name: value.clone().requires_grad_()
            for name, value in (some | {"background": BACKGROUND}).items()
        }
        alive.append((leaves, *rasterize(**leaves, camera=view)))
        differentiate(rasterize, *cases[0], weights(cases[0][1]))  # dropped
    rasterize(**cases[1][0], camera=cases[1][1], background=BACKGROUND)
    for k in (2, 1, 0, 0, 2):
        leaves, image, alpha = alive[k]
        slopes = torch.autograd.grad(
            [image, alpha], leaves.values(), weights(cases[k][1]), retain_graph=True
        )
        assert_same(
            Result(image, alpha, dict(zip(leaves, slopes, strict=True))),
            alone[k],
            **rasterize.rounding,
        )


def test_non_contiguous_tensors(rasterize):
    """Strided inputs and incoming gradients; those of ``image.sum()`` are expanded, and alpha's are
    absent.
    """
    view, some = camera(), scene(200, 2, 0)

    def strided(x):
        return torch.stack([x, torch.full_like(x, math.nan)], -1)[..., 0]

    leaves = {
        name: strided(value).requires_grad_()
        for name, value in (some | {"background": BACKGROUND}).items()
    }
    assert not any(leaf.is_contiguous() for leaf in leaves.values())
    image, alpha = rasterize(**leaves, camera=view)
    ones = torch.ones(view.height, view.width, 3), torch.zeros(view.height, view.width)
    for v, outputs in ((weights(view), (image, alpha)), (ones, (image.sum(),))):
        given = list(map(strided, v)) if len(outputs) == 2 else None
        slopes = torch.autograd.grad(outputs, list(leaves.values()), given, retain_graph=True)
        want = differentiate(rasterize, some, view, v)
        assert_same(
            Result(image, alpha, dict(zip(leaves, slopes, strict=True))), want, **rasterize.rounding
        )


def test_calls_from_two_threads(rasterize):
    """As when a viewer draws during training."""
    cases = [(scene(400, 1, seed), camera(*size)) for seed, size in enumerate([(61, 45), (97, 31)])]
    want = [differentiate(rasterize, some, view, weights(view)) for some, view in cases]

    def work(k):
        some, view = cases[k]
        for _ in range(3 if rasterize.stands_in else 15):
            assert_same(
                differentiate(rasterize, some, view, weights(view)), want[k], **rasterize.rounding
            )

    with ThreadPoolExecutor(2) as pool:
        list(pool.map(work, range(2)))


@pytest.mark.parametrize(
    "case", ["none", "behind", "beside", "below 1/255", "opacity 0", "at the camera's centre"]
)
def test_an_empty_view_is_the_background(rasterize, case):
    view, some = camera(), scene(0 if case == "none" else 50, 2, 0)
    if case in ("behind", "beside"):
        move = [0.0, 0.0, -20.0] if case == "behind" else [300.0, 0.0, 0.0]
        some["means"] = some["means"] + torch.tensor(move) @ view.viewmat[:3, :3]
    elif case == "at the camera's centre":
        some["means"] = view.position.repeat(50, 1)
    else:
        some["opacities"][:] = 0.0 if case == "opacity 0" else 0.0039
    found = differentiate(rasterize, some, view, weights(view))
    assert torch.equal(found.image, BACKGROUND.expand(45, 61, 3)) and (found.alpha == 0).all()
    torch.testing.assert_close(found.gradients["background"], weights(view)[0].sum((0, 1)))
    for name in FIELDS:
        assert (
            found.gradients[name].shape == some[name].shape and (found.gradients[name] == 0).all()
        ), name


@pytest.mark.parametrize(
    "case",
    ["below 1/255", "zero quaternion", "short quaternion", "compensated to below 1/255", *FIELDS],
)
def test_invisible_rows_and_those_that_are_not_finite_are_skipped(rasterize, case):
    gone, below = torch.arange(300) % 11 < 5, math.nextafter(1 / 255, 0) - 1e-9
    values = (
        ((slice(None), math.nan), (0, math.inf), (0, -math.inf), (-1, math.nan))
        if case in FIELDS
        else [(0, 0.0)]
    )
    for columns, value in values:
        view, some = camera(), scene(300, 2, 3, size=0.1)
        if case in FIELDS:
            some[case].view(300, -1)[gone.nonzero()[:, 0], columns] = value
        elif case == "below 1/255":
            some["opacities"] = torch.where(
                gone, torch.linspace(0, below, 300), some["opacities"].clamp(min=0.004)
            )
        elif case.endswith("quaternion"):
            some["quats"][gone] *= 0 if case.startswith("zero") else 1e-16
        else:
            # a thousandth of a pixel: the compensation is 1e-5 and less
            some["scales"][gone] *= 1e-3
        chosen = FILTERS["on" if case.startswith("compensated") else "off"]
        kept = {name: value[~gone] for name, value in some.items()}
        found, want = (
            differentiate(rasterize, each, view, weights(view), chosen) for each in (some, kept)
        )
        for name in FIELDS:
            assert (found.gradients[name][gone] == 0).all(), name
            found.gradients[name] = found.gradients[name][~gone]
        assert_same(found, want, **rasterize.rounding)


@pytest.mark.parametrize("screen_filter", ["off", "on"])
@pytest.mark.parametrize("name", ["means", "scales", "quats", "opacities"])
def test_extreme_rows_give_finite_results(rasterize, screen_filter, name):
    view = camera()
    for value, columns in (
        (1e10, 0),
        (1e20, -1),
        (-3e38, slice(None)),
        (3e38, 0),
        (math.inf, 0),
        (math.nan, 0),
    ):
        some = scene(150, 2, 5, size=0.08 if screen_filter == "off" else 0.03)
        some[name].view(150, -1)[::15, columns] = value
        found = differentiate(
            rasterize, some, view, weights(view), screen_filter=FILTERS[screen_filter]
        )
        for what, x in {"image": found.image, "alpha": found.alpha, **found.gradients}.items():
            assert x.isfinite().all(), f"{what}, {value}"
        assert (
            (found.gradients["opacities"] != 0).any()
            and (found.alpha >= 0).all()
            and (found.alpha <= 1).all()
        )


@pytest.mark.parametrize(
    ("version", "kernels", "error", "reason"),
    [
        ("1.5.3", None, None, "install nvcc"),
        ("1.3.0", 1, None, "gsplat 1.3.0 is too old.*pip install gsplat==1.5.3"),
        (
            "1.5.3+pt24cu124",
            1,
            OSError("libcudart.so.12: cannot open"),
            "libcudart.so.12.*pip install gsplat==1.5.3",
        ),
        ("", 1, ImportError("No module named 'gsplat'"), "gsplat.*pip install gsplat==1.5.3"),
    ],
)
def test_unusable_says_what_gsplat_lacks(monkeypatch, version, kernels, error, reason):
    top, package, backend = (
        ModuleType(name) for name in ("gsplat", "gsplat.cuda", "gsplat.cuda._backend")
    )
    top.__version__, package._backend, backend._C = version, backend, kernels
    for module in (top, package, backend):
        monkeypatch.setitem(sys.modules, module.__name__, module)
    real = builtins.__import__

    def importing(name, *args, **kwargs):
        if error and name == "gsplat":
            raise error
        return real(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", importing)
    cuda.unusable.cache_clear()
    try:
        found = cuda.unusable()
    finally:
        cuda.unusable.cache_clear()
    assert re.search(reason, found) and "\n" not in found


def kernel(name, version, given):
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
        return kernels.isect_tiles(
            **{key: given[key] for key in given if key not in ("sort", "conics", "opacities")}
        )
    if name == "isect_offset_encode":
        return _torch_impl._isect_offset_encode(*given.values())
    assert name == "rasterize_to_pixels" and given.pop("masks") is None
    return kernels.rasterize_to_pixels(*list(given.values())[:9], **dict(list(given.items())[9:]))


@pytest.mark.parametrize("version", gsplat_versions.signatures())
def test_every_version_draws_the_same(monkeypatch, version):
    """Image and gradients; without opacities in the projection, as in 1.4.0, splats end a tenth
    nearer.
    """
    pytest.importorskip("gsplat", minversion="1.5.3", reason="pip install gsplat==1.5.3")
    pytest.importorskip("gsplat.cuda._torch_impl")

    def drawn():
        some = {name: x.double().requires_grad_() for name, x in scene(120, 2, 3).items()}
        behind = torch.tensor([0.1, 0.2, 0.3], dtype=torch.float64)
        image, alpha = cuda.rasterize(
            **some, camera=camera(40, 30), background=behind, screen_filter=FILTERS["mip"]
        )
        image.square().mean().backward()
        return [
            image.detach(),
            alpha.detach(),
            *(x.grad for x in some.values() if x.grad is not None),
        ]

    def of(installed):
        monkeypatch.setitem(sys.modules, "gsplat", gsplat_versions.module(installed, kernel))
        return drawn()

    for mine, theirs in zip(of(version), of("1.5.3"), strict=True):
        atol = 0.02 * float(theirs.abs().max()) if version == "1.4.0" else 1e-6
        torch.testing.assert_close(mine, theirs, rtol=0, atol=atol)

"""The contract of every backend: autograd, repeatability, robustness."""

import math
from concurrent.futures import ThreadPoolExecutor

import pytest
import torch
from torch import Tensor

from backends import Backend, torch_threads
from clod_adapter.config import FILTERS
from clod_adapter.errors import ClodError
from clod_adapter.rasterizers import cpu, cuda, for_device
from oracle import BACKGROUND, Result, assert_same, differentiate, weights
from scenes import camera, scene

FIELDS = ("means", "quats", "scales", "opacities", "sh0", "shN")


def test_for_device(monkeypatch: pytest.MonkeyPatch) -> None:
    assert for_device(torch.device("cpu")) is cpu.RASTERIZER
    with pytest.raises(ClodError, match="no rasterizer for device meta"):
        for_device(torch.device("meta"))
    monkeypatch.setattr(cuda, "unusable", lambda: None)
    assert for_device(torch.device("cuda:1")).splat is cuda.rasterize
    monkeypatch.setattr(cuda, "unusable", lambda: "gsplat is not there: pip install gsplat==1.5.3")
    with pytest.raises(ClodError, match=r"no rasterizer for the GPU: .*pip install gsplat==1.5.3; or use the CPU"):
        for_device(torch.device("cuda"))


def test_same_input_same_bits(rasterize: Backend) -> None:
    view, some = camera(130, 97), scene(300 if rasterize.stands_in else 2000, 2, 1)
    given, results = {name: value.clone() for name, value in some.items()}, {}
    for count in (1, 1, 2, 2, 3):
        with torch_threads(count):
            found = differentiate(rasterize, some, view, weights(view))
        assert_same(found, results.setdefault(count, found), **rasterize.rounding)
        assert_same(found, results[1], **({"rtol": 1e-5, "atol": 1e-5} if rasterize.repeats else rasterize.rounding))
    assert all(torch.equal(some[name], given[name]) for name in some)


def test_several_forward_passes_keep_their_own_state(rasterize: Backend) -> None:
    """Backward passes in any order and repeated, with images and gradients large enough for recycled memory."""
    k, sizes = 1 if rasterize.stands_in else 3, [(300, (61, 45)), (500, (33, 70)), (150, (97, 31))]
    cases = [(scene(k**3 * n, 1, n, size=0.08 / k), camera(k * width, k * height)) for n, (width, height) in sizes]
    alone = [differentiate(rasterize, some, view, weights(view)) for some, view in cases]
    alive = []
    for some, view in cases:
        leaves = {name: value.clone().requires_grad_() for name, value in (some | {"background": BACKGROUND}).items()}
        alive.append((leaves, *rasterize(**leaves, camera=view)))
        differentiate(rasterize, *cases[0], weights(cases[0][1]))  # dropped
    rasterize(**cases[1][0], camera=cases[1][1], background=BACKGROUND)
    for k in (2, 1, 0, 0, 2):
        leaves, image, alpha = alive[k]
        slopes = torch.autograd.grad([image, alpha], leaves.values(), weights(cases[k][1]), retain_graph=True)
        assert_same(Result(image, alpha, dict(zip(leaves, slopes, strict=True))), alone[k], **rasterize.rounding)


def test_non_contiguous_tensors(rasterize: Backend) -> None:
    """Strided inputs and incoming gradients; those of ``image.sum()`` are expanded, and alpha's are absent."""
    view, some = camera(), scene(200, 2, 0)

    def strided(x: Tensor) -> Tensor:
        return torch.stack([x, torch.full_like(x, math.nan)], -1)[..., 0]

    leaves = {name: strided(value).requires_grad_() for name, value in (some | {"background": BACKGROUND}).items()}
    assert not any(leaf.is_contiguous() for leaf in leaves.values())
    image, alpha = rasterize(**leaves, camera=view)
    ones = torch.ones(view.height, view.width, 3), torch.zeros(view.height, view.width)
    for v, outputs in ((weights(view), (image, alpha)), (ones, (image.sum(),))):
        given = list(map(strided, v)) if len(outputs) == 2 else None
        slopes = torch.autograd.grad(outputs, list(leaves.values()), given, retain_graph=True)
        want = differentiate(rasterize, some, view, v)
        assert_same(Result(image, alpha, dict(zip(leaves, slopes, strict=True))), want, **rasterize.rounding)


def test_calls_from_two_threads(rasterize: Backend) -> None:
    """As when a viewer draws during training."""
    cases = [(scene(400, 1, seed), camera(*size)) for seed, size in enumerate([(61, 45), (97, 31)])]
    want = [differentiate(rasterize, some, view, weights(view)) for some, view in cases]

    def work(k: int) -> None:
        some, view = cases[k]
        for _ in range(3 if rasterize.stands_in else 15):
            assert_same(differentiate(rasterize, some, view, weights(view)), want[k], **rasterize.rounding)

    with ThreadPoolExecutor(2) as pool:
        list(pool.map(work, range(2)))


@pytest.mark.parametrize("case", ["none", "behind", "beside", "below 1/255", "opacity 0", "at the camera's centre"])
def test_an_empty_view_is_the_background(rasterize: Backend, case: str) -> None:
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
        assert found.gradients[name].shape == some[name].shape and (found.gradients[name] == 0).all(), name


@pytest.mark.parametrize(
    "case", ["below 1/255", "zero quaternion", "short quaternion", "compensated to below 1/255", *FIELDS]
)
def test_invisible_rows_and_those_that_are_not_finite_are_skipped(rasterize: Backend, case: str) -> None:
    gone, below = torch.arange(300) % 11 < 5, math.nextafter(1 / 255, 0) - 1e-9
    values = ((slice(None), math.nan), (0, math.inf), (0, -math.inf), (-1, math.nan)) if case in FIELDS else [(0, 0.0)]
    for columns, value in values:
        view, some = camera(), scene(300, 2, 3, size=0.1)
        if case in FIELDS:
            some[case].view(300, -1)[gone.nonzero()[:, 0], columns] = value
        elif case == "below 1/255":
            some["opacities"] = torch.where(gone, torch.linspace(0, below, 300), some["opacities"].clamp(min=0.004))
        elif case.endswith("quaternion"):
            some["quats"][gone] *= 0 if case.startswith("zero") else 1e-16
        else:
            some["scales"][gone] *= 1e-3  # a thousandth of a pixel: the compensation is 1e-5 and less
        screen_filter = FILTERS["on" if case.startswith("compensated") else "off"]
        found, want = (
            differentiate(rasterize, each, view, weights(view), screen_filter=screen_filter)
            for each in (some, {name: value[~gone] for name, value in some.items()})
        )
        for name in FIELDS:
            assert (found.gradients[name][gone] == 0).all(), name
            found.gradients[name] = found.gradients[name][~gone]
        assert_same(found, want, **rasterize.rounding)


@pytest.mark.parametrize("screen_filter", ["off", "on"])
@pytest.mark.parametrize("name", ["means", "scales", "quats", "opacities"])
def test_extreme_rows_give_finite_results(rasterize: Backend, screen_filter: str, name: str) -> None:
    view = camera()
    for value, columns in ((1e10, 0), (1e20, -1), (-3e38, slice(None)), (3e38, 0), (math.inf, 0), (math.nan, 0)):
        some = scene(150, 2, 5, size=0.08 if screen_filter == "off" else 0.03)
        some[name].view(150, -1)[::15, columns] = value
        found = differentiate(rasterize, some, view, weights(view), screen_filter=FILTERS[screen_filter])
        for what, x in {"image": found.image, "alpha": found.alpha, **found.gradients}.items():
            assert x.isfinite().all(), f"{what}, {value}"
        assert (found.gradients["opacities"] != 0).any() and (found.alpha >= 0).all() and (found.alpha <= 1).all()

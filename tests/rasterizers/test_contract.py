"""What every backend promises beside the numbers: autograd's manners, repeatability, robustness."""

from __future__ import annotations

import math
import time
from concurrent.futures import ThreadPoolExecutor

import pytest
import torch
from torch import Tensor

from backends import Backend
from clod_adapter.config import FILTERS
from clod_adapter.errors import ClodError
from clod_adapter.rasterizers import cpu, cuda, for_device
from oracle import BACKGROUND, Parameters, assert_same, differentiate, weights
from scenes import camera, scene

FIELDS = ("means", "quats", "scales", "opacities", "sh0", "shN")


def total(rasterize: Backend, leaves: Parameters, view, v: tuple[Tensor, Tensor]) -> Tensor:
    image, alpha = rasterize(**leaves, camera=view, background=BACKGROUND)
    return (image * v[0]).sum() + (alpha * v[1]).sum()


def leaves_of(some: Parameters) -> Parameters:
    return {name: value.clone().requires_grad_() for name, value in some.items()}


def test_for_device() -> None:
    assert for_device(torch.device("cpu")) is cpu.rasterize
    with pytest.raises(ClodError, match="no rasterizer for device meta"):
        for_device(torch.device("meta"))


def test_for_the_gpu_it_is_gsplat_s_or_what_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cuda, "unusable", lambda: None)
    assert for_device(torch.device("cuda:1")) is cuda.rasterize
    monkeypatch.setattr(cuda, "unusable", lambda: "gsplat is not there: pip install gsplat==1.5.3")
    with pytest.raises(ClodError, match=r"no rasterizer for the GPU: .*pip install gsplat==1.5.3; or use the CPU"):
        for_device(torch.device("cuda"))


def test_same_input_same_bits(rasterize: Backend, torch_threads: int) -> None:
    view, some = camera(130, 97), scene(300 if rasterize.stands_in else 2000, 2, torch_threads)
    first = differentiate(rasterize, some, view, weights(view))
    for _ in range(1 if rasterize.stands_in else 3):
        assert_same(differentiate(rasterize, some, view, weights(view)), first, **rasterize.rounding)


def test_thread_count_changes_rounding_at_most(rasterize: Backend) -> None:
    view, some = camera(130, 97), scene(301 if rasterize.stands_in else 2001, 2, 0)
    before = torch.get_num_threads()
    results = []
    for count in (1, 2, 3):
        torch.set_num_threads(count)
        try:
            results.append(differentiate(rasterize, some, view, weights(view)))
        finally:
            torch.set_num_threads(before)
    within = {"rtol": 1e-5, "atol": 1e-5} if rasterize.repeats else rasterize.rounding
    assert_same(results[1], results[0], **within)
    assert_same(results[2], results[0], **within)


@pytest.mark.parametrize("order", [(0, 1, 2), (2, 1, 0), (1, 2, 0)], ids=lambda o: "".join(map(str, o)))
def test_several_forward_passes_alive_at_once(rasterize: Backend, order: tuple[int, ...]) -> None:
    """Then their backward passes, in any order: what a forward pass left behind is its own."""
    cases = [
        (scene(n, 1, seed), camera(*size))
        for seed, (n, size) in enumerate([(300, (61, 45)), (500, (33, 70)), (150, (97, 31))])
    ]
    alone = [differentiate(rasterize, some, view, weights(view)) for some, view in cases]
    alive = []
    for some, view in cases:
        leaves, background = leaves_of(some), BACKGROUND.clone().requires_grad_()
        alive.append((leaves, background, *rasterize(**leaves, camera=view, background=background)))
    rasterize(**cases[1][0], camera=cases[1][1], background=BACKGROUND)
    for k in order:
        leaves, background, image, alpha = alive[k]
        v = weights(cases[k][1])
        loss = (image * v[0]).sum() + (alpha * v[1]).sum()
        slopes = torch.autograd.grad(loss, [*leaves.values(), background])
        gradients = dict(zip([*leaves, "background"], slopes, strict=True))
        found = alone[k]._replace(image=image.detach(), alpha=alpha.detach(), gradients=gradients)
        assert_same(found, alone[k], **rasterize.rounding)


def test_backward_twice(rasterize: Backend) -> None:
    view, some = camera(), scene(300, 1, 0)
    leaves, v = leaves_of(some), weights(view)
    loss = total(rasterize, leaves, view, v)
    first = torch.autograd.grad(loss, leaves.values(), retain_graph=True)
    other = camera(97, 31)
    differentiate(rasterize, scene(400, 1, 1), other, weights(other))
    second = torch.autograd.grad(loss, leaves.values())
    for name, a, b in zip(leaves, first, second, strict=True):
        torch.testing.assert_close(a, b, **rasterize.rounding, msg=name)


def test_gradients_accumulate_over_cameras(rasterize: Backend) -> None:
    some = scene(300, 1, 0)
    views = [camera(61, 45), camera(33, 70, off_centre=(0.3, 0.6))]
    alone = [differentiate(rasterize, some, view, weights(view)).gradients for view in views]
    leaves = leaves_of(some)
    within = {"rtol": 1e-6, "atol": 1e-6} if rasterize.repeats else rasterize.rounding
    sum(total(rasterize, leaves, view, weights(view)) for view in views).backward()
    for name, leaf in leaves.items():
        torch.testing.assert_close(leaf.grad, alone[0][name] + alone[1][name], **within, msg=name)


@pytest.mark.parametrize("weight", [2.0, -0.5, 0.0])
def test_backward_is_linear(rasterize: Backend, weight: float) -> None:
    view, some = camera(), scene(200, 1, 0)
    v = weights(view)
    once = differentiate(rasterize, some, view, v).gradients
    scaled = differentiate(rasterize, some, view, (weight * v[0], weight * v[1])).gradients
    for name in once:
        # Powers of two: exact.
        torch.testing.assert_close(scaled[name], weight * once[name], **rasterize.rounding, msg=name)


def test_non_contiguous_tensors(rasterize: Backend) -> None:
    """Inputs and incoming gradients with strides."""
    view, some = camera(), scene(200, 2, 0)
    want = differentiate(rasterize, some, view, weights(view))

    def strided(x: Tensor) -> Tensor:
        return torch.stack([x, torch.full_like(x, math.nan)], -1)[..., 0]

    leaves = {name: strided(value).requires_grad_() for name, value in some.items()}
    assert not any(leaf.is_contiguous() for leaf in leaves.values())
    background = strided(BACKGROUND).requires_grad_()
    image, alpha = rasterize(**leaves, camera=view, background=background)
    v = [strided(weight) for weight in weights(view)]
    found = torch.autograd.grad([image, alpha], [*leaves.values(), background], v)
    assert_same(
        want._replace(image=image, alpha=alpha, gradients=dict(zip([*leaves, "background"], found, strict=True))),
        want,
        **rasterize.rounding,
    )


def test_broadcast_gradients(rasterize: Backend) -> None:
    """``image.sum()`` sends back a gradient without memory of its own; alpha may get none at all."""
    view, leaves = camera(), leaves_of(scene(100, 1, 0))
    image, alpha = rasterize(**leaves, camera=view, background=BACKGROUND)
    ones = torch.ones(view.height, view.width, 3), torch.zeros(view.height, view.width)
    want = differentiate(rasterize, leaves, view, ones).gradients
    for name, found in zip(leaves, torch.autograd.grad(image.sum(), leaves.values()), strict=True):
        torch.testing.assert_close(found, want[name], **rasterize.rounding, msg=name)


@pytest.mark.parametrize("name", [*FIELDS, "background"])
def test_gradient_of_one_input_alone(rasterize: Backend, name: str) -> None:
    view = camera()
    inputs = scene(200, 1, 0) | {"background": BACKGROUND.clone()}
    want = differentiate(rasterize, {k: inputs[k] for k in FIELDS}, view, weights(view)).gradients
    inputs[name].requires_grad_()
    image, alpha = rasterize(**inputs, camera=view)
    v = weights(view)
    ((image * v[0]).sum() + (alpha * v[1]).sum()).backward()
    torch.testing.assert_close(inputs[name].grad, want[name], **rasterize.rounding)
    assert all(value.grad is None for key, value in inputs.items() if key != name)


def test_without_gradients(rasterize: Backend) -> None:
    view, leaves = camera(), leaves_of(scene(200, 1, 0))
    want, _ = rasterize(**leaves, camera=view, background=BACKGROUND)
    assert want.requires_grad
    for mode in (torch.no_grad, torch.inference_mode):
        with mode():
            image, alpha = rasterize(**leaves, camera=view, background=BACKGROUND)
        assert torch.equal(image, want) and not image.requires_grad and not alpha.requires_grad
    plain = {name: leaf.detach() for name, leaf in leaves.items()}
    assert not rasterize(**plain, camera=view, background=BACKGROUND)[0].requires_grad


def test_inputs_are_left_alone(rasterize: Backend) -> None:
    view, some = camera(), scene(200, 1, 0)
    before = {name: value.clone() for name, value in some.items()}
    differentiate(rasterize, some, view, weights(view))
    assert all(torch.equal(some[name], before[name]) for name in some)


def test_calls_from_two_threads(rasterize: Backend) -> None:
    """A viewer draws while a training runs."""
    cases = [(scene(400, 1, seed), camera(*size)) for seed, size in enumerate([(61, 45), (97, 31)])]
    want = [differentiate(rasterize, some, view, weights(view)) for some, view in cases]

    def work(k: int) -> None:
        some, view = cases[k]
        for _ in range(3 if rasterize.stands_in else 15):
            assert_same(differentiate(rasterize, some, view, weights(view)), want[k], **rasterize.rounding)

    with ThreadPoolExecutor(2) as pool:
        list(pool.map(work, range(2)))


@pytest.mark.parametrize("degree", [0, 3])
def test_no_gaussians(rasterize: Backend, degree: int) -> None:
    view = camera(37, 21)
    found = differentiate(rasterize, scene(0, degree, 0), view, weights(view))
    assert torch.equal(found.image, BACKGROUND.expand(21, 37, 3)) and (found.alpha == 0).all()
    assert found.gradients["shN"].shape == (0, (degree + 1) ** 2 - 1, 3)
    torch.testing.assert_close(found.gradients["background"], weights(view)[0].sum((0, 1)))


@pytest.mark.parametrize("case", ["behind", "beside", "below 1/255", "opacity 0", "at the camera's centre"])
def test_nothing_in_view(rasterize: Backend, case: str) -> None:
    view, some = camera(), scene(50, 2, 0)
    if case in ("behind", "beside"):
        move = [0.0, 0.0, -20.0] if case == "behind" else [300.0, 0.0, 0.0]
        some["means"] = some["means"] + torch.tensor(move) @ view.viewmat[:3, :3]
    elif case == "at the camera's centre":
        some["means"] = view.position.repeat(50, 1)
    else:
        some["opacities"][:] = 0.0 if case == "opacity 0" else 0.0039
    found = differentiate(rasterize, some, view, weights(view))
    assert torch.equal(found.image, BACKGROUND.expand(45, 61, 3)) and (found.alpha == 0).all()
    for name in FIELDS:
        assert (found.gradients[name] == 0).all(), name


def assert_rows_count_for_nothing(rasterize: Backend, some: Parameters, gone: Tensor) -> None:
    """The picture and the gradients are those of the scene without the rows ``gone``, as if it were drawn again."""
    view = camera()
    found = differentiate(rasterize, some, view, weights(view))
    want = differentiate(rasterize, {name: value[~gone] for name, value in some.items()}, view, weights(view))
    for name in FIELDS:
        assert (found.gradients[name][gone] == 0).all(), name
        found.gradients[name] = found.gradients[name][~gone]
    assert_same(found, want, **rasterize.rounding)


def test_rows_below_the_cut_are_skipped(rasterize: Backend, torch_threads: int) -> None:
    some = scene(400, 1, 3, size=0.2)
    gone = torch.rand(400, generator=torch.Generator().manual_seed(0)) < 0.5
    below = math.nextafter(1 / 255, 0) - 1e-9
    some["opacities"] = torch.where(gone, torch.linspace(0, below, 400), some["opacities"].clamp(min=0.004))
    assert_rows_count_for_nothing(rasterize, some, gone)


def test_zero_quaternions_are_skipped(rasterize: Backend) -> None:
    some = scene(150, 1, 4)
    gone = torch.arange(150) % 7 == 0
    some["quats"][gone] = 0
    assert_rows_count_for_nothing(rasterize, some, gone)


@pytest.mark.parametrize(
    ("name", "value"),
    [(name, value) for k, name in enumerate(FIELDS) for value in (math.nan, (-1) ** k * math.inf)],
)
def test_rows_that_are_not_finite_are_skipped(rasterize: Backend, name: str, value: float) -> None:
    """Whole rows and single elements. A file in the wild has some; they must not spoil the picture."""
    for column in {
        "opacities": (0,),
        "quats": range(4),
        "means": range(3),
        "scales": range(3),
        "sh0": range(3),
        "shN": (0, 23),
    }[name]:
        for whole in (False, True):
            some = scene(150, 2, 5)
            gone = torch.arange(150) % 11 == 3
            rows = some[name].view(150, -1)
            rows[gone.nonzero()[:, 0, None], torch.arange(rows.shape[1]) if whole else column] = value
            assert_rows_count_for_nothing(rasterize, some, gone)


@pytest.mark.parametrize(
    ("name", "value"),
    [("means", 1e10), ("means", 1e30), ("means", -3e38), ("scales", 1e10), ("scales", 1e20), ("scales", 3e38)],
)
def test_huge_rows_are_survived(rasterize: Backend, name: str, value: float) -> None:
    """Beyond what float32 can project: whatever is drawn of such rows, it is finite, and so are the gradients."""
    view = camera()
    for axis in range(4):
        some = scene(150, 2, 5)
        some[name][::15, slice(None) if axis == 3 else axis] = value
        found = differentiate(rasterize, some, view, weights(view))
        for what, x in {"image": found.image, "alpha": found.alpha, **found.gradients}.items():
            assert x.isfinite().all(), f"{what}, axis {axis}"
        assert (found.alpha >= 0).all() and (found.alpha <= 1).all()


@pytest.mark.parametrize(
    ("name", "value"),
    [
        *((name, math.nan) for name in ("means", "quats", "scales", "opacities")),
        ("means", math.inf), ("quats", 3e38), ("scales", 1e20), ("opacities", math.inf),
    ],
)  # fmt: skip
def test_wild_rows_are_survived_with_compensation(rasterize: Backend, name: str, value: float) -> None:
    """Whatever is drawn of them, it is finite, and so are the gradients; NaN in one row is in no other's."""
    view, some = camera(), scene(150, 1, 5, size=0.03)
    some[name][::15] = value
    found = differentiate(rasterize, some, view, weights(view), screen_filter=FILTERS["on"])
    for what, x in {"image": found.image, "alpha": found.alpha, **found.gradients}.items():
        assert x.isfinite().all(), what
    assert (found.gradients["opacities"] != 0).any() and (found.alpha >= 0).all() and (found.alpha <= 1).all()


def test_rows_that_compensation_takes_below_the_cut_are_skipped(rasterize: Backend) -> None:
    view, some = camera(), scene(300, 1, 3, size=0.1)
    gone = torch.rand(300, generator=torch.Generator().manual_seed(0)) < 0.5
    some["scales"][gone] *= 1e-3  # a thousandth of a pixel: c is 1e-5 and less
    kept = {name: value[~gone] for name, value in some.items()}
    found, want = (
        differentiate(rasterize, each, view, weights(view), screen_filter=FILTERS["on"]) for each in (some, kept)
    )
    for name in FIELDS:
        assert (found.gradients[name][gone] == 0).all(), name
        found.gradients[name] = found.gradients[name][~gone]
    assert_same(found, want, **rasterize.rounding)


def test_thousands_in_one_tile_are_quick(rasterize: Backend) -> None:
    if rasterize.stands_in:
        pytest.skip("the kernels' pace is not in torch's")
    view, some = camera(30, 28), scene(20_000, 1, 2, size=0.02)
    some["means"] *= 0.3
    some["opacities"] *= 0.05
    differentiate(rasterize, scene(10, 1, 0), view, weights(view))  # compiled
    began = time.perf_counter()
    found = differentiate(rasterize, some, view, weights(view))
    assert time.perf_counter() - began < 5  # measured: 0.03 s
    assert found.image.isfinite().all() and found.gradients["means"].abs().sum() > 0

"""The wrappers against the installed gsplat, with its kernels on CUDA or with torch in their place."""

from __future__ import annotations

import gc
import inspect
import re
import weakref
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import Tensor

import gsplat_in_torch
import gsplat_versions
from clod_adapter.cameras import Camera
from clod_adapter.config import FILTERS, AttenuationConfig
from clod_adapter.equation.attenuation import attenuate
from clod_adapter.equation.distances import normalized_distances
from clod_adapter.errors import ClodError
from clod_adapter.gaussians import Gaussians
from clod_adapter.render import render
from scenes import camera, ring, scene

N, WIDTH, HEIGHT = 40, 40, 28
SOFT = AttenuationConfig(tau=0.02, cut="soft", scene_distance=4.0, max_sv=5.0)
WHOLE = AttenuationConfig(tau=0.02, max_sv=5.0)  # does not change an opacity above tau without decay


class Tools(SimpleNamespace):
    """gsplat's function, ours, and their device."""

    theirs: Callable[..., Any]
    ours: Callable[..., Any]
    device: str


@pytest.fixture(params=["cpu", "cuda"])
def tools(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Tools:
    gsplat = pytest.importorskip("gsplat", reason="pip install gsplat==1.5.3")
    if request.param == "cuda" and not torch.cuda.is_available():
        pytest.skip("no CUDA device")
    if request.param == "cpu":
        gsplat_in_torch.install(monkeypatch)
    from clod_adapter.integrations import gsplat as wrapper

    return Tools(theirs=gsplat.rasterization, ours=wrapper.rasterization, device=request.param)


def require_batches() -> None:
    import gsplat

    if "with_ut" not in inspect.signature(gsplat.rasterization).parameters:
        pytest.skip(f"gsplat {gsplat.__version__} has no batches of scenes")


def names(function: Callable[..., Any]) -> list[str]:
    """The parameters of a function with their defaults, in order."""
    found, keyword = [], False
    for p in inspect.signature(function).parameters.values():
        found += ["*"] if p.kind is p.KEYWORD_ONLY and not keyword else []
        keyword = p.kind is p.KEYWORD_ONLY
        default = repr(p.default).replace(": 4", ":4")
        found.append(p.name if p.default is p.empty else f"{p.name}={default}")
    return found


def test_the_stored_signatures_are_the_installed_ones(tools: Tools) -> None:
    """What the stand-ins of the versions are made of."""
    import gsplat

    stored = gsplat_versions.signatures()[{"1.5.1": "1.5.0"}.get(gsplat.__version__, gsplat.__version__)]
    for name in gsplat_versions.FUNCTIONS:
        written = re.sub(r"=([A-Z]\w+)\.(\w+)", r"=<\1.\2:4>", stored[name]).replace("**kwargs", "kwargs")
        assert ", ".join(names(getattr(gsplat, name))) == written


def arguments(n: int, cameras: int, batch: tuple[int, ...] = (), **dtype: Any) -> tuple[dict[str, Any], dict[str, Any]]:
    """Arguments of the Gaussians, with colours of SH degree 1, and of the cameras, with batch dimensions."""
    copies = [scene(n, 1, seed, size=0.2) for seed in range(max(1, *batch, 1))]

    def stacked(name: str) -> Tensor:
        rows = [torch.cat([s["sh0"], s["shN"]], 1) if name == "colors" else s[name] for s in copies]
        return (torch.stack(rows) if batch else rows[0]).to(**dtype)

    given = {name: stacked(name) for name in ("means", "quats", "scales", "opacities", "colors")}
    views = ring(cameras * len(copies), WIDTH, HEIGHT) if cameras > 1 or batch else [camera(WIDTH, HEIGHT)]
    matrices = {"viewmats": [view.viewmat for view in views], "Ks": [view.K for view in views]}
    shaped = {name: torch.stack(of).reshape(*batch, cameras, *of[0].shape).to(**dtype) for name, of in matrices.items()}
    return given, {**shaped, "width": WIDTH, "height": HEIGHT}


def dialled(
    given: dict[str, Any], views: dict[str, Any], sigma_d: Tensor, dial: float, config: AttenuationConfig,
    growth_d: Tensor | None = None,
) -> list[dict[str, Tensor]]:  # fmt: skip
    """Attenuated opacities ``[N]`` and grown scales or covariances for each camera of unbatched arguments."""
    found = []
    for viewmat, K in zip(views["viewmats"], views["Ks"], strict=True):
        d = normalized_distances(given["means"], Camera(viewmat, K, WIDTH, HEIGHT), config)
        shown = attenuate(given["opacities"].logit(), sigma_d, d, dial, config, growth_d=growth_d)
        found.append({"opacities": shown.drawn})
        if "covars" in given:
            found[-1]["covars"] = given["covars"] * shown.growth[:, None, None] ** 2
        else:
            found[-1]["scales"] = given["scales"] * shown.growth[:, None]
    return found


def reach(n: int, *batch: int, **kind: Any) -> Tensor:
    return 0.2 + torch.rand(*batch, n, generator=torch.Generator().manual_seed(7)).to(**kind)


def same(ours: Any, theirs: Any) -> None:
    """Asserts that both are close tensors, or equal plain values."""
    if isinstance(theirs, Tensor):
        assert ours.dtype == theirs.dtype
        torch.testing.assert_close(ours, theirs, rtol=1e-5, atol=1e-6)
    else:
        assert ours == theirs


@pytest.mark.parametrize(
    ("cameras", "batch", "packed"), [(1, (), False), (3, (), True), (3, (2,), True), (3, (2,), False)]
)
def test_without_attenuation_results_are_gsplats(
    tools: Tools, cameras: int, batch: tuple[int, ...], packed: bool
) -> None:
    """Images and every value of meta, where all cameras are drawn in one call."""
    if batch:
        require_batches()
    given, views = arguments(N, cameras, batch, device=tools.device)
    given["opacities"] = given["opacities"].clamp(min=0.03)
    if packed and tools.device == "cuda" and batch:
        pytest.skip("gsplat 1.5.3's packed projection takes the first scene's opacities for all")
    options = {"sh_degree": 1, "packed": packed, "render_mode": "RGB+ED", "rasterize_mode": "antialiased"}
    theirs = tools.theirs(**given, **views, **options)
    ours = tools.ours(**given, **views, **options, sigma_d=torch.full_like(given["opacities"], 1e9), attenuation=WHOLE)
    assert list(ours[2]) == list(theirs[2])
    for mine, want in ((ours[0], theirs[0]), (ours[1], theirs[1]), *((ours[2][k], theirs[2][k]) for k in theirs[2])):
        same(mine, want)


@pytest.mark.parametrize("name", ["on", "mip"])
def test_images_match_render_with_each_screen_filter(tools: Tools, name: str) -> None:
    """Image, alpha and the gradient of sigma_d; gsplat's own arguments choose the filter."""
    given, views = arguments(N, 1)
    given["scales"] = 0.2 * given["scales"]
    sigma = [reach(N).requires_grad_(), reach(N).to(tools.device).requires_grad_()]
    options = {"rasterize_mode": "antialiased" if FILTERS[name].compensate else "classic", "sh_degree": 1}
    options |= {"eps2d": FILTERS[name].variance, "virtual_scale": 2.0, "attenuation": SOFT}
    moved = {k: v.to(tools.device) if isinstance(v, Tensor) else v for k, v in (given | views).items()}
    image, alpha, _ = tools.ours(**moved, **options, sigma_d=sigma[1])
    model = Gaussians(
        given["means"], given["quats"], given["scales"].log(), given["opacities"].logit(), given["colors"][:, :1],
        given["colors"][:, 1:], sigma[0], SOFT, screen_filter=FILTERS[name],
    )  # fmt: skip
    own = render(model, camera(WIDTH, HEIGHT), 2.0)
    torch.testing.assert_close(image[0].cpu(), own.image, rtol=1e-3, atol=1e-3)
    torch.testing.assert_close(alpha[0, :, :, 0].cpu(), own.alpha, rtol=1e-3, atol=2e-3)
    pairs = zip((own.image, image), sigma, strict=True)
    want, found = (torch.autograd.grad(picture.sum(), s, retain_graph=True)[0].cpu() for picture, s in pairs)
    assert float((found - want).norm()) < 0.01 * float(want.norm())
    usual = render(model.replace(screen_filter=FILTERS["off"]), camera(WIDTH, HEIGHT), 2.0).image
    assert float((own.image - usual).detach().abs().max()) > 0.02


@pytest.mark.parametrize(
    ("cameras", "packed", "cut", "growing"),
    [(1, True, "hard", ""), (3, True, "soft", "scales"), (3, False, "hard", "covars")],
)
def test_attenuated_results_match_gsplat_per_camera(
    tools: Tools, cameras: int, packed: bool, cut: str, growing: str
) -> None:
    """Images, alphas and all gradients, including those of the projected centres."""
    config = AttenuationConfig(tau=0.02, cut=cut, normalizer="quantile", max_sv=5.0)
    given, views = arguments(N, cameras, device=tools.device)
    if growing == "covars":
        axes = torch.randn(N, 3, 3, generator=torch.Generator().manual_seed(5)).to(tools.device)
        given["covars"] = 0.02 * axes @ axes.mT + 0.01 * torch.eye(3, device=tools.device)
        del given["quats"], given["scales"]
    leaves = {name: value.clone().requires_grad_() for name, value in given.items()}
    leaves |= {"viewmats": views["viewmats"].clone().requires_grad_(), "sigma_d": reach(N, device=tools.device)}
    leaves["sigma_d"].requires_grad_()
    if growing:
        leaves["growth_d"] = (2 * reach(N, device=tools.device) - 1).requires_grad_()
    options = {"sh_degree": 1, "packed": packed, "absgrad": True}

    views = views | {"viewmats": leaves["viewmats"]}
    inputs = {name: leaves[name] for name in given}
    absent = dict.fromkeys({"quats", "scales"} - set(given))
    dial = {"sigma_d": leaves["sigma_d"], "growth_d": leaves.get("growth_d")}
    ours = tools.ours(**inputs, **absent, **views, **options, **dial, virtual_scale=2.0, attenuation=config)
    turned = dialled(inputs, views, dial["sigma_d"], 2.0, config, dial["growth_d"])
    assert any(0 < int((drawn["opacities"] == 0).sum()) < N for drawn in turned)
    theirs = []
    for c, drawn in enumerate(turned):
        single = {"viewmats": views["viewmats"][c : c + 1], "Ks": views["Ks"][c : c + 1]}
        theirs.append(tools.theirs(**inputs | absent | drawn, **views | single, **options))
    torch.testing.assert_close(ours[0], torch.cat([part[0] for part in theirs]), rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(ours[1], torch.cat([part[1] for part in theirs]), rtol=1e-4, atol=1e-5)

    points = [ours[2]["means2d"], *(part[2]["means2d"] for part in theirs)]
    for point in points:
        point.retain_grad()
    weights = torch.rand(ours[0].shape, generator=torch.Generator().manual_seed(1)).to(tools.device)
    first = torch.autograd.grad((ours[0] * weights).sum() + ours[1].sum(), list(leaves.values()), retain_graph=True)
    loss = sum((part[0] * w).sum() + part[1].sum() for part, w in zip(theirs, weights, strict=True))
    second = torch.autograd.grad(loss, list(leaves.values()), retain_graph=True)
    for name, mine, want in zip(leaves, first, second, strict=True):
        torch.testing.assert_close(mine, want, rtol=1e-3, atol=1e-4, msg=lambda text, name=name: f"{name}: {text}")
    assert float(first[-1].abs().max()) > 0

    import gsplat

    if "opacities" not in inspect.signature(gsplat.fully_fused_projection).parameters:
        return  # called with culled rows, that gsplat projects them

    # A second pass, in which the centres have a loss of their own: it adds to their grad.
    ((ours[0] * weights).sum() + ours[1].sum() + points[0].square().sum()).backward()
    (loss + sum(point.square().sum() for point in points[1:])).backward()
    for kind in ("grad", "absgrad"):
        want = torch.cat([getattr(point, kind) for point in points[1:]])
        assert getattr(points[0], kind).shape == points[0].shape
        torch.testing.assert_close(getattr(points[0], kind), want, rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("packed", [True, False], ids=["packed", "unpacked"])
def test_densification_statistics_match_gsplats(tools: Tools, packed: bool) -> None:
    """The statistics have the caller's rows, and are gsplat's where nothing is attenuated."""
    from gsplat import DefaultStrategy

    given, views = arguments(N, 3, device=tools.device)
    given["opacities"] = given["opacities"].clamp(min=0.03)
    states = []
    for function, extra in (
        (tools.theirs, {}),
        (tools.ours, {"sigma_d": torch.full_like(given["opacities"], 1e9), "attenuation": WHOLE}),
    ):
        params = {name: torch.nn.Parameter(value) for name, value in given.items()}
        image, _, meta = function(**params, **views, sh_degree=1, packed=packed, **extra)
        strategy = DefaultStrategy(refine_scale2d_stop_iter=9, verbose=False)
        state = strategy.initialize_state()
        strategy.step_pre_backward(params, {}, state, 0, meta)
        image.square().sum().backward()
        strategy._update_state(params, state, meta, packed=packed)
        states.append(state)
    for name in ("grad2d", "count", "radii"):
        torch.testing.assert_close(states[1][name], states[0][name], rtol=1e-4, atol=1e-4)
    assert float(states[0]["grad2d"].max()) > 0


def test_memory_is_released(tools: Tools) -> None:
    """Gradient hooks create no reference cycle, with or without a backward pass."""
    given, views = arguments(N, 2, device=tools.device)
    given["means"].requires_grad_()
    gc.collect()
    gc.disable()
    try:
        for backward in (False, True):
            colors, alphas, meta = tools.ours(
                **given, **views, sh_degree=1, sigma_d=reach(N, device=tools.device), attenuation=SOFT
            )
            points = weakref.ref(meta["means2d"])
            if backward:
                colors.sum().backward()
            del colors, alphas, meta
            assert points() is None
    finally:
        gc.enable()


def test_bad_arguments_are_refused(tools: Tools) -> None:
    given, views = arguments(N, 2, device=tools.device)
    with pytest.raises(ClodError, match="distributed=True shares one opacity"):
        tools.ours(**given, **views, distributed=True, sigma_d=given["opacities"])
    with pytest.raises(ClodError, match=r"sigma_d is \(39,\) and opacities \(40,\)"):
        tools.ours(**given, **views, sigma_d=given["opacities"][1:])
    with pytest.raises(ClodError, match=r"growth_d is \(39,\) and opacities \(40,\)"):
        tools.ours(**given, **views, sigma_d=given["opacities"], growth_d=given["opacities"][1:], attenuation=SOFT)
    with pytest.raises(ClodError, match="virtual_scale is -0.5"):
        tools.ours(**given, **views, sigma_d=given["opacities"], virtual_scale=-0.5)
    with pytest.raises(TypeError, match="missing a required argument: 'viewmats'"):
        tools.ours(*given.values(), sigma_d=given["opacities"])

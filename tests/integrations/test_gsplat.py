"""The wrappers against the installed gsplat, with its kernels on CUDA or with torch in their
place.
"""

import inspect
from enum import Enum
from types import SimpleNamespace

import pytest
import torch
from torch import Tensor

import gsplat_in_torch
import gsplat_versions
from clod_adapter.cameras import Camera
from clod_adapter.config import AttenuationConfig
from clod_adapter.equation.attenuation import attenuate
from scenes import camera, ring, scene, seeded

N, WIDTH, HEIGHT = 40, 40, 28
WHOLE = AttenuationConfig()  # changes no opacity where the reach is infinite


@pytest.fixture(params=["cpu", "cuda"])
def tools(request, monkeypatch):
    gsplat = pytest.importorskip("gsplat", reason="pip install gsplat==1.5.3")
    if request.param == "cuda" and not torch.cuda.is_available():
        pytest.skip("no CUDA device")
    if request.param == "cpu":
        gsplat_in_torch.install(monkeypatch)
    from clod_adapter.integrations import gsplat as wrapper

    return SimpleNamespace(
        theirs=gsplat.rasterization, ours=wrapper.rasterization, device=request.param
    )


def takes(function, argument):
    import gsplat

    return argument in inspect.signature(getattr(gsplat, function)).parameters


def test_the_stored_signatures_are_the_installed_ones():
    """What the stand-ins of the versions are made of."""
    gsplat = pytest.importorskip("gsplat", reason="pip install gsplat==1.5.3")
    stored = gsplat_versions.module({"1.5.1": "1.5.0"}.get(gsplat.__version__, gsplat.__version__))
    for name in gsplat_versions.FUNCTIONS:
        theirs, ours = (
            inspect.signature(getattr(each, name)).parameters for each in (gsplat, stored)
        )
        assert [(p.name, p.kind) for p in ours.values()] == [
            (p.name, p.kind) for p in theirs.values()
        ]
        for mine, want in zip(ours.values(), theirs.values(), strict=True):
            assert mine.default == (
                str(want.default) if isinstance(want.default, Enum) else want.default
            )


def arguments(cameras, device="cpu"):
    """Arguments of the Gaussians, with colours of SH degree 1, and of the cameras."""
    given = scene(N, 1, 0, size=0.2)
    given["colors"] = torch.cat([given.pop("sh0"), given.pop("shN")], 1)
    views = ring(cameras, WIDTH, HEIGHT) if cameras > 1 else [camera(WIDTH, HEIGHT)]
    given |= {
        "viewmats": torch.stack([view.viewmat for view in views]),
        "Ks": torch.stack([view.K for view in views]),
    }
    given = {name: value.to(device) for name, value in given.items()}
    matrices = {name: given.pop(name) for name in ("viewmats", "Ks")}
    return given, {**matrices, "width": WIDTH, "height": HEIGHT}


@pytest.mark.parametrize(("cameras", "packed"), [(1, False), (1, True), (3, True), (3, False)])
def test_without_attenuation_results_are_gsplats(tools, cameras, packed):
    """Images; of one camera every value of meta, and statistics of densification."""
    import gsplat

    given, views = arguments(cameras, tools.device)
    views |= {
        "sh_degree": 1,
        "packed": packed,
        "render_mode": "RGB+ED",
        "rasterize_mode": "antialiased",
    }
    dial = {"sigma_d": torch.full_like(given["opacities"], 1e9), "attenuation": WHOLE}
    images, metas, states = [], [], []
    for function, more in ((tools.theirs, {}), (tools.ours, dial)):
        params = {name: torch.nn.Parameter(value) for name, value in given.items()}
        image, alpha, meta = function(**params, **views, **more)
        images.append((image, alpha))
        metas.append(meta)
        if cameras > 1:
            continue
        strategy = gsplat.DefaultStrategy(refine_scale2d_stop_iter=9, verbose=False)
        states.append(strategy.initialize_state())
        strategy.step_pre_backward(params, {}, states[-1], 0, meta)
        image.square().sum().backward()
        strategy._update_state(params, states[-1], meta, packed=packed)
    for want, image in zip(*images, strict=True):
        torch.testing.assert_close(image, want, rtol=1e-5, atol=1e-6)
    if cameras > 1:
        return
    assert list(metas[0]) == list(metas[1]) and float(states[0]["grad2d"].max()) > 0
    for name, want in metas[0].items():
        if isinstance(want, Tensor):
            torch.testing.assert_close(metas[1][name], want, rtol=1e-5, atol=1e-6)
        else:
            assert metas[1][name] == want
    for name, want in states[0].items():
        torch.testing.assert_close(states[1][name], want, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize(
    ("cameras", "packed", "form", "growing"),
    [(1, True, "ours", ""), (3, True, "paper", "scales"), (3, False, "ours", "covars")],
)
def test_attenuated_results_match_gsplat_per_camera(tools, cameras, packed, form, growing):
    config = AttenuationConfig(form=form, scene_distance=6.0)
    given, views = arguments(cameras, tools.device)
    if growing == "covars":
        axes = torch.randn(N, 3, 3, generator=seeded(5)).to(tools.device)
        given["covars"] = 0.02 * axes @ axes.mT + 0.01 * torch.eye(3, device=tools.device)
        given["quats"] = given["scales"] = None
    sigma_d = 0.2 + 2 * torch.rand(N, generator=seeded(7)).to(tools.device)
    dial = {"sigma_d": sigma_d} | ({"growth_d": sigma_d - 1} if growing else {})
    leaves = {**given, "viewmats": views.pop("viewmats"), **dial}
    leaves = {
        name: value.clone().requires_grad_() for name, value in leaves.items() if value is not None
    }
    dial, given = {name: leaves[name] for name in dial}, {name: leaves.get(name) for name in given}
    views |= {"sh_degree": 1, "packed": packed, "absgrad": True}
    ours = tools.ours(
        **given, **views, **dial, viewmats=leaves["viewmats"], virtual_scale=2.0, attenuation=config
    )
    theirs = []
    for viewmat, K in zip(leaves["viewmats"], views.pop("Ks"), strict=True):
        where, growth_d = (given["means"], Camera(viewmat, K, WIDTH, HEIGHT)), dial.get("growth_d")
        shown = attenuate(
            given["opacities"].logit(), dial["sigma_d"], where, 2.0, config, growth_d=growth_d
        )
        assert 0 < int(shown.keep.sum()) < N
        name, factor = (
            ("covars", shown.growth[:, None, None] ** 2)
            if growing == "covars"
            else ("scales", shown.growth[:, None])
        )
        faded = given | {"opacities": shown.drawn, name: given[name] * factor}
        theirs.append(tools.theirs(**faded, **views, viewmats=viewmat[None], Ks=K[None]))
    for k in range(2):
        torch.testing.assert_close(
            ours[k], torch.cat([part[k] for part in theirs]), rtol=1e-4, atol=1e-5
        )

    metas = ours[2] if len(theirs) > 1 else [ours[2]]
    for meta, part in zip(metas, theirs, strict=True):
        meta["means2d"].retain_grad()
        part[2]["means2d"].retain_grad()
    loss = ours[0].square().sum() + ours[1].sum()
    of_theirs = sum(part[0].square().sum() + part[1].sum() for part in theirs)
    first, second = (
        torch.autograd.grad(x, list(leaves.values()), retain_graph=True) for x in (loss, of_theirs)
    )
    for name, mine, want in zip(leaves, first, second, strict=True):
        torch.testing.assert_close(
            mine, want, rtol=1e-3, atol=1e-4, msg=lambda text, name=name: f"{name}: {text}"
        )
    assert float(first[-1].abs().max()) > 0
    if not takes("fully_fused_projection", "opacities"):
        return  # called with culled rows, that gsplat projects them

    loss.backward()
    of_theirs.backward()
    for meta, part in zip(metas, theirs, strict=True):
        for kind in ("grad", "absgrad"):
            mine, want = (getattr(each["means2d"], kind) for each in (meta, part[2]))
            torch.testing.assert_close(mine, want, rtol=1e-3, atol=1e-4)

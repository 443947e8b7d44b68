"""The wrapper against the fork with the kept rows alone: stand-ins for five forks."""

from __future__ import annotations

import inspect
from types import ModuleType
from typing import Any

import pytest
import torch
from torch import Tensor

import inria_forks
from backends import fresh_copy
from clod_adapter.config import FILTERS, AttenuationConfig
from clod_adapter.equation.attenuation import attenuate
from clod_adapter.equation.distances import normalized_distances
from clod_adapter.errors import ClodError
from clod_adapter.gaussians import Gaussians
from clod_adapter.render import render
from scenes import camera, ring, scene

N = 150
VIEW = camera(48, 36, off_centre=(0.5, 0.5))
DIAL = 2.0


def wrapper(monkeypatch: pytest.MonkeyPatch, installed: ModuleType | None) -> ModuleType:
    return fresh_copy(monkeypatch, "inria", "diff_gaussian_rasterization", installed)


def arguments(*further: str) -> dict[str, Any]:
    """A fork's arguments by name, which require gradients; half of the Gaussians are behind the camera."""
    s = scene(N, 1, 0, size=0.2)
    values = {
        "means3D": s["means"] * 3, "means2D": torch.zeros(N, 3), "opacities": s["opacities"][:, None],
        "shs": torch.cat([s["sh0"], s["shN"]], 1), "scales": s["scales"],
        "rotations": torch.nn.functional.normalize(s["quats"]),
    }  # fmt: skip
    made = {name: value.requires_grad_() for name, value in values.items()}
    return made | {name: torch.ones(N, 2) for name in further}


def config(**changes: Any) -> AttenuationConfig:
    return AttenuationConfig(
        **{"tau": 0.02, "cut": "soft", "scene_distance": 5.0, "quantile": 0.5, "max_sv": 5.0} | changes
    )


def faded(given: dict[str, Any], sigma_d: Tensor, settings: AttenuationConfig, growth_d: Tensor | None = None) -> Any:
    d = normalized_distances(given["means3D"], VIEW, settings)
    return attenuate(given["opacities"][:, 0].logit(), sigma_d, d, DIAL, settings, growth_d=growth_d)


def reach() -> Tensor:
    return (0.2 + torch.rand(N, generator=torch.Generator().manual_seed(7))).requires_grad_()


@pytest.mark.parametrize("grows", [False, True], ids=["fades", "fades and grows"])
@pytest.mark.parametrize("name", inria_forks.FORKS)
def test_kept_rows_are_drawn_as_by_the_fork(name: str, grows: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    further, results = inria_forks.FORKS[name].further, inria_forks.FORKS[name].results.split()
    fork, settings = inria_forks.module(name), config(normalizer="quantile" if name == "w-pose" else "scene")
    raster_settings = inria_forks.settings_of(fork.GaussianRasterizationSettings, VIEW)
    given, sigma_d = arguments(*further), reach()
    growth_d = (2 * reach().detach() - 1).requires_grad_() if grows else None
    result = faded(given, sigma_d, settings, growth_d)
    keep = result.keep
    assert 0 < int(keep.sum()) < N
    rows = {key: value[keep] for key, value in given.items()} | {"opacities": result.drawn[keep, None]}
    if grows:
        rows["scales"] = rows["scales"] * result.growth[keep, None]
    want = fork.GaussianRasterizer(raster_settings)(**rows)

    ours = wrapper(monkeypatch, fork).GaussianRasterizer(raster_settings)
    dial = {"sigma_d": sigma_d, "growth_d": growth_d, "virtual_scale": DIAL, "attenuation": settings}
    got = ours(**given, **dial)
    assert torch.equal(ours(*map(given.get, inria_forks.FORKS[name].call.split()), **dial)[0], got[0])
    for result, mine, theirs in zip(results, got, want, strict=True):
        if result in ("radii", "touched"):  # of all rows, 0 for culled ones
            assert torch.equal(mine[keep], theirs) and len(mine) == N and not mine[~keep].any()
        elif result != "features":
            torch.testing.assert_close(mine, theirs, rtol=1e-5, atol=1e-5)

    leaves = [value for value in (*given.values(), sigma_d, growth_d) if value is not None and value.requires_grad]
    weights = torch.rand(got[0].shape, generator=torch.Generator().manual_seed(1))
    slopes = [torch.autograd.grad((picture[0] * weights).sum(), leaves) for picture in (got, want)]
    for leaf, mine, theirs in zip(leaves, *slopes, strict=True):
        assert mine.shape == leaf.shape and not mine[~keep].any()
        torch.testing.assert_close(mine, theirs, rtol=1e-3, atol=1e-4)
    assert float(slopes[0][-1].abs().max()) > 0


@pytest.mark.parametrize(
    ("fork", "settings", "name"),
    [("inria 2024", {"antialiasing": True}, "on"), ("mip-splatting", {"kernel_size": 0.1}, "mip")],
)
def test_images_match_render_with_a_screen_filter(
    fork: str, settings: dict[str, Any], name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The fork's own settings choose the filter; the dial is applied before the compensation, as in ``render``."""
    module, given, sigma_d = inria_forks.module(fork), arguments(), reach()
    given["scales"] = 0.2 * given["scales"]
    black = inria_forks.settings_of(module.GaussianRasterizationSettings, VIEW, bg=torch.zeros(3), **settings)
    ours = wrapper(monkeypatch, module).GaussianRasterizer(black)
    color = ours(**given, sigma_d=sigma_d, virtual_scale=DIAL, attenuation=config())[0].permute(1, 2, 0)
    own = Gaussians(
        given["means3D"], given["rotations"], given["scales"].log(), given["opacities"][:, 0].logit(),
        given["shs"][:, :1], given["shs"][:, 1:], sigma_d, config(), screen_filter=FILTERS[name],
    )  # fmt: skip
    torch.testing.assert_close(color, render(own, VIEW, DIAL).image, rtol=1e-3, atol=1e-3)
    usual = render(own.replace(screen_filter=FILTERS["off"]), VIEW, DIAL).image
    assert float((color - usual).detach().abs().max()) > 0.01


@pytest.mark.parametrize("name", inria_forks.FORKS)
def test_without_sigma_d_results_are_those_of_the_fork(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    fork, given = inria_forks.module(name), arguments(*inria_forks.FORKS[name].further)
    ours = wrapper(monkeypatch, fork)
    assert ours.GaussianRasterizationSettings is fork.GaussianRasterizationSettings
    raster_settings = inria_forks.settings_of(fork.GaussianRasterizationSettings, VIEW)
    rasterizer = ours.GaussianRasterizer(raster_settings=raster_settings)
    assert isinstance(rasterizer, fork.GaussianRasterizer)
    assert torch.equal(
        rasterizer.markVisible(given["means3D"]), given["means3D"] @ VIEW.viewmat[2, :3] + VIEW.viewmat[2, 3] > 0.2
    )
    for mine, want in zip(rasterizer(**given), fork.GaussianRasterizer(raster_settings)(**given), strict=True):
        assert torch.equal(mine, want)


def test_culled_rows_are_invisible_to_a_fork_that_culls_at_zero(monkeypatch: pytest.MonkeyPatch) -> None:
    """From many positions, since rounding moves a point at the camera's centre in front of it or behind it."""
    monkeypatch.setattr(inria_forks, "NEAREST", 0.0)
    fork, given, sigma_d = inria_forks.module("inria 2024"), arguments(), torch.full((N,), 1e-3)
    for view in ring(31, 48, 36):
        settings = inria_forks.settings_of(fork.GaussianRasterizationSettings, view)
        rasterizer = wrapper(monkeypatch, fork).GaussianRasterizer(settings)
        assert not rasterizer(**given, sigma_d=sigma_d, virtual_scale=DIAL, attenuation=config())[1].any()


def test_covariances_grow_by_the_square(monkeypatch: pytest.MonkeyPatch) -> None:
    """``cov3D_precomp`` instead of scales and rotations, by name and by position."""
    fork, given, passed = inria_forks.module("inria 2023"), arguments(), []
    names = inria_forks.CALL.split()
    given["cov3D_precomp"] = torch.rand(N, 6, generator=torch.Generator().manual_seed(3))
    del given["scales"], given["rotations"]

    def forward(self: Any, *args: Any, **kwargs: Any) -> None:
        passed.append(dict(zip(names, args, strict=False)) | kwargs)

    forward.__signature__ = inspect.signature(fork.GaussianRasterizer.forward)  # type: ignore[attr-defined]
    monkeypatch.setattr(fork.GaussianRasterizer, "forward", forward)
    settings = inria_forks.settings_of(fork.GaussianRasterizationSettings, VIEW)
    ours, growth_d = wrapper(monkeypatch, fork).GaussianRasterizer(settings), 2 * reach() - 1
    more = {"sigma_d": reach(), "growth_d": growth_d, "virtual_scale": DIAL, "attenuation": config()}
    ours(**given, **more)
    ours(*map(given.get, names), **more)
    growth = faded(given, reach(), config(), growth_d).growth
    assert growth.min() < 0.9 and growth.max() > 1.1
    for each in passed:
        torch.testing.assert_close(each["cov3D_precomp"], given["cov3D_precomp"] * growth[:, None].square())
        assert each.get("scales") is None and each.get("rotations") is None


def test_bad_arguments_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    fork = inria_forks.module("inria 2024")
    ours = wrapper(monkeypatch, fork).GaussianRasterizer
    kind, given = fork.GaussianRasterizationSettings, arguments()
    with pytest.raises(ClodError, match="prefiltered is True.*set it to False"):
        ours(inria_forks.settings_of(kind, VIEW, prefiltered=True))(**given, sigma_d=reach())
    with pytest.raises(ClodError, match=r"the dial is for 149 Gaussians, but means is \(150, 3\)"):
        ours(inria_forks.settings_of(kind, VIEW))(**given, sigma_d=reach()[1:])
    with pytest.raises(ClodError, match=r"sigma_d \(150,\), growth_d \(149,\)"):
        ours(inria_forks.settings_of(kind, VIEW))(**given, sigma_d=reach(), growth_d=reach()[1:], attenuation=config())
    with pytest.raises(ClodError, match="virtual_scale is -1"):
        ours(inria_forks.settings_of(kind, VIEW))(**given, sigma_d=reach(), virtual_scale=-1)
    with pytest.raises(ImportError, match="pip install .*graphdeco-inria/diff-gaussian-rasterization"):
        wrapper(monkeypatch, None)

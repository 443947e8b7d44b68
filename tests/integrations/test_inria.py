"""The wrapper against the fork with the kept rows alone: stand-ins for five forks."""

from types import ModuleType
from typing import Any

import pytest
import torch
from torch import Tensor

import inria_forks
from backends import fresh_copy
from clod_adapter.config import AttenuationConfig
from clod_adapter.equation.attenuation import attenuate
from clod_adapter.errors import ClodError
from inria_forks import FORKS, settings_of
from scenes import camera, ring, scene

N, DIAL = 150, 2.0
VIEW = camera(48, 36, off_centre=(0.5, 0.5))


def wrapper(monkeypatch: pytest.MonkeyPatch, installed: ModuleType | None) -> Any:
    return fresh_copy(monkeypatch, "inria", "diff_gaussian_rasterization", installed)


def arguments(name: str = "inria 2024") -> dict[str, Any]:
    """A fork's arguments by name, which require gradients; half of the Gaussians are behind the camera."""
    s = scene(N, 1, 0, size=0.2)
    values = {
        "means3D": s["means"] * 3, "means2D": torch.zeros(N, 3), "opacities": s["opacities"][:, None],
        "shs": torch.cat([s["sh0"], s["shN"]], 1), "scales": s["scales"],
        "rotations": torch.nn.functional.normalize(s["quats"]),
    }  # fmt: skip
    further = set(FORKS[name][1].split()) - set(inria_forks.CALL.split())
    return {key: value.requires_grad_() for key, value in values.items()} | {key: torch.ones(N, 2) for key in further}


def dial(growing: bool = True, normalizer: str = "scene") -> dict[str, Any]:
    sigma_d, growth_d = torch.rand(2, N, generator=torch.Generator().manual_seed(7))
    settings = AttenuationConfig(scene_distance=5.0, normalizer=normalizer)
    growth = {"growth_d": (2 * growth_d - 0.6).requires_grad_()} if growing else {}
    return {"sigma_d": (0.2 + sigma_d).requires_grad_(), "virtual_scale": DIAL, "attenuation": settings} | growth


def faded(given: dict[str, Any], dial: dict[str, Any]) -> Any:
    where, logits = (given["means3D"], VIEW), given["opacities"][:, 0].logit()
    return attenuate(logits, dial["sigma_d"], where, DIAL, dial["attenuation"], growth_d=dial.get("growth_d"))


@pytest.mark.parametrize("name", FORKS)
def test_kept_rows_are_drawn_as_by_the_fork(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also called by position. Without sigma_d, results are the fork's."""
    fork, given, more = inria_forks.module(name), arguments(name), dial(name != "w-pose", "max")
    settings = settings_of(fork.GaussianRasterizationSettings, VIEW, bg=torch.tensor([0.2, 0.5, 0.1]))
    theirs, module = fork.GaussianRasterizer(settings), wrapper(monkeypatch, fork)
    ours = module.GaussianRasterizer(raster_settings=settings)
    assert module.GaussianRasterizationSettings is fork.GaussianRasterizationSettings
    for mine, want in zip(ours(**given), theirs(**given), strict=True):
        assert torch.equal(mine, want)
    drawn = faded(given, more)
    keep = drawn.keep
    assert 0 < int(keep.sum()) < N
    rows = {key: value[keep] for key, value in given.items()} | {"opacities": drawn.drawn[keep, None]}
    want = theirs(**rows | {"scales": rows["scales"] * drawn.growth[keep, None]})
    got = ours(**given, **more)
    assert torch.equal(ours(*map(given.get, FORKS[name][1].split()), **more)[0], got[0])
    for result, mine, of_fork in zip(FORKS[name][2].split(), got, want, strict=True):
        if result in ("radii", "touched"):  # of all rows, 0 for culled ones
            assert torch.equal(mine[keep], of_fork) and len(mine) == N and not mine[~keep].any()
        elif result != "features":
            torch.testing.assert_close(mine, of_fork, rtol=1e-5, atol=1e-5)
    leaves = [each for each in (given | more).values() if isinstance(each, Tensor) and each.requires_grad]
    weights = torch.rand(got[0].shape, generator=torch.Generator().manual_seed(1))
    slopes = [torch.autograd.grad((picture[0] * weights).sum(), leaves) for picture in (got, want)]
    for leaf, mine, of_fork in zip(leaves, *slopes, strict=True):
        assert mine.shape == leaf.shape and not mine[~keep].any()
        torch.testing.assert_close(mine, of_fork, rtol=1e-3, atol=1e-4)
    assert float(slopes[0][-1].abs().max()) > 0


def test_culled_rows_are_invisible_to_a_fork_that_culls_at_zero(monkeypatch: pytest.MonkeyPatch) -> None:
    """From many positions, since rounding moves a point at the camera's centre in front of it or behind it."""
    monkeypatch.setattr(inria_forks, "NEAREST", 0.0)
    fork, more = inria_forks.module("inria 2024"), dial() | {"sigma_d": torch.full((N,), 1e-3)}
    ours = wrapper(monkeypatch, fork).GaussianRasterizer
    for view in ring(31, 48, 36):
        rasterizer = ours(settings_of(fork.GaussianRasterizationSettings, view))
        assert not rasterizer(**arguments(), **more)[1].any()


def test_covariances_grow_by_the_square(monkeypatch: pytest.MonkeyPatch) -> None:
    """``cov3D_precomp`` instead of scales and rotations, by name and by position."""
    fork, given, more = inria_forks.module("inria 2024"), arguments(), dial()
    growth = faded(given, more).growth
    assert growth.min() < 0.9 and growth.max() > 1.1
    given["cov3D_precomp"] = torch.rand(N, 6, generator=torch.Generator().manual_seed(3))
    del given["scales"], given["rotations"]
    ours = wrapper(monkeypatch, fork).GaussianRasterizer(settings_of(fork.GaussianRasterizationSettings, VIEW))
    for words, names in (([], given), (map(given.get, inria_forks.CALL.split()), {})):
        ours(*words, **names, **more)
        torch.testing.assert_close(ours.given["cov3D_precomp"], given["cov3D_precomp"] * growth[:, None].square())


def test_bad_arguments_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    fork, short = inria_forks.module("inria 2024"), torch.ones(149)
    for prefiltered, more, message in (
        (True, dial(False), "prefiltered is True.*set it to False"),
        (None, dial(False) | {"sigma_d": short}, r"the dial is for 149 Gaussians, but means is \(150, 3\)"),
        (None, dial() | {"growth_d": short}, r"sigma_d \(150,\), growth_d \(149,\)"),
    ):
        settings = settings_of(fork.GaussianRasterizationSettings, VIEW, prefiltered=prefiltered)
        with pytest.raises(ClodError, match=message):
            wrapper(monkeypatch, fork).GaussianRasterizer(settings)(**arguments(), **more)
    with pytest.raises(ImportError, match="pip install .*graphdeco-inria/diff-gaussian-rasterization"):
        wrapper(monkeypatch, None)

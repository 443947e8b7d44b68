"""The dial in the projection's kernel, compared with the equation, which is its specification."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from backends import torch_threads
from clod_adapter._kernels import project
from clod_adapter._kernels.conventions import LOG, QA, QC, RECORD, RED
from clod_adapter.cameras import Camera
from clod_adapter.config import ScreenFilter
from clod_adapter.equation.attenuation import SIGMA_MAX, dial, log_threshold
from clod_adapter.errors import ClodError
from clod_adapter.gaussians import Gaussians
from clod_adapter.rasterizers import Rasterizer, cpu
from clod_adapter.rasterizers.frame import give, prepare
from clod_adapter.render import render
from scenes import camera, dialled, gaussians

VIEW = camera(45, 37)


def records_of(frame: Any, n: int) -> Tensor:
    """``[N, 16]`` the record of each Gaussian, NaN for those without one."""
    out = torch.full((n, RECORD), math.nan)
    packed = frame.records.reshape(-1, RECORD)
    for worker, count in enumerate(frame.counts.tolist()):
        first = n * worker // len(frame.counts)
        rows = frame.packed_ids[first : first + count].astype(np.int64)
        out[torch.from_numpy(rows)] = torch.from_numpy(packed[first : first + count].copy())
    give(frame.buffers)
    return out


def wanted(model: Gaussians, view: Camera, s: float) -> tuple[Tensor, Tensor]:
    """The records by the equation in float64, and the rows where rounding may decide."""
    exact = model.replace(**{name: x.double() for name, x in model.tensors().items()})
    found = dial(exact, view, s)
    scales = exact.scales * found.growth[:, None]
    tensors = (model.means, model.quats, scales.float(), found.drawn.float(), model.sh0, model.shN)
    close = (found.drawn - 1 / 255).abs() < 1e-6
    if model.attenuation is not None:
        logs = found.log_opacities
        close |= (logs - log_threshold(model.attenuation.tau, s)).abs() < 1e-5 * (1 + logs.abs())
    frame = prepare(project.project, cpu._arrays(tensors), model.sh_degree, view, model.screen_filter)
    return records_of(frame, len(model)), close


def assert_follows_the_equation(model: Gaussians, s: float, view: Camera = VIEW) -> Tensor:
    want, close = wanted(model, view, s)
    got = records_of(cpu._prepare_dialled(model, view, s), len(model))
    differs = (got.isnan() != want.isnan()).any(1) & ~close
    assert int(differs.sum()) <= 1  # an ellipse may end at a pixel's centre
    both = ~(got.isnan() | want.isnan()).any(1) & ~close
    for columns, tolerance in ((slice(QA, QC + 1), 1e-4), (slice(LOG, LOG + 1), 1e-5), (slice(RED, RED + 3), 1e-6)):
        torch.testing.assert_close(got[both, columns], want[both, columns], rtol=tolerance, atol=1e-5)
    return both


@pytest.mark.parametrize("n", [0, 1, 15, 16, 17, 33, 200])
@pytest.mark.parametrize("workers", [1, 3])
def test_counts_around_sixteen(n: int, workers: int) -> None:
    with torch_threads(workers):
        model = dialled(n, 1, n)
        drawn = assert_follows_the_equation(model.replace(growth_d=torch.linspace(-1, 3, n)), 2.0)
    assert n < 33 or drawn.any()


@given(
    s=st.sampled_from([1.0, 1.7, 6.0, 40.0]), cut=st.sampled_from(["soft", "hard"]), eps=st.sampled_from([0.0, 1e-8]),
    tau=st.sampled_from([1e-6, 1 / 255, 0.02]), grows=st.booleans(), seed=st.integers(0, 99),
    normalizer=st.sampled_from(["scene", "max", "quantile"]), reference=st.sampled_from([0.0, 2.0]),
)  # fmt: skip
def test_any_settings(grows: bool, s: float, seed: int, reference: float, **settings: Any) -> None:
    model = dialled(90, 0, seed, reference_distance=reference, max_sv=45.0, **settings)
    if grows:
        model = model.replace(growth_d=torch.linspace(-1, 3, 90).roll(seed))
    assert_follows_the_equation(model, s)


@pytest.mark.parametrize("cut", ["soft", "hard"])
@pytest.mark.parametrize("s", [1.0, 5.0])
def test_extreme_values(cut: str, s: float) -> None:
    """Sigma, opacities and growth at their limits, and a Gaussian in the camera's centre."""
    sigmas = [0.0, -1.0, 1e-30, 1e-4, 1.0, SIGMA_MAX, 1e30, math.inf]
    logits, growths = [-math.inf, -200.0, -4.0, 0.0, 3.0, 90.0, math.inf], [-1e30, -5.0, 0.0, 1.0, 1e30]
    rows = torch.cartesian_prod(*(torch.tensor(x) for x in (sigmas, logits, growths)))
    for eps in (0.0, 1e-8):
        model = dialled(len(rows), 0, 3, cut=cut, eps=eps).replace(sigma_d=rows[:, 0], opacity_logits=rows[:, 1])
        model.means[::7] = VIEW.position
        finite = rows[:, 0].isfinite() & (rows[:, 2].abs() < 1e3)  # those for which the equation is defined
        assert_follows_the_equation(model.replace(growth_d=rows[:, 2]).select(finite), s)
        image = cpu.RASTERIZER.draw(model.replace(growth_d=rows[:, 2]), VIEW, s)[0]
        assert image.isfinite().all()


def test_a_file_without_a_dial() -> None:
    assert_follows_the_equation(gaussians(100, 2, 0), 3.0)
    model = gaussians(100, 0, 0).replace(screen_filter=ScreenFilter(compensate=True))
    assert_follows_the_equation(model, 1.0)


def test_images_and_kept_rows() -> None:
    model = dialled(400, 2, 5).replace(growth_d=torch.full((400,), 0.5))
    behind = torch.tensor([0.2, 0.4, 0.6])
    at_once = render(model, VIEW, 2.0, background=behind)
    apart = render(model, VIEW, 2.0, background=behind, rasterizer=Rasterizer(cpu.rasterize))
    torch.testing.assert_close(at_once.image, apart.image, rtol=0, atol=5e-3)  # an alpha of 1/255 more or less
    assert (at_once.image - apart.image).abs().mean() < 1e-5
    torch.testing.assert_close(at_once.alpha, apart.alpha, rtol=0, atol=5e-3)
    assert torch.equal(at_once.kept, apart.kept) and 0 < int(at_once.kept.sum()) < 400


def test_other_types_take_the_other_way() -> None:
    model = dialled(50, 0, 1)
    assert model.sigma_d is not None
    half = model.replace(sigma_d=model.sigma_d.half())
    apart = render(half, VIEW, 2.0, rasterizer=Rasterizer(cpu.rasterize))
    assert torch.equal(render(half, VIEW, 2.0).image, apart.image)
    with pytest.raises(ClodError, match="float32 only, and scales is"):
        render(model.replace(sigma_d=model.sigma_d.double()), VIEW, 2.0)


def test_a_growth_that_is_not_finite_is_not_drawn() -> None:
    model = dialled(50, 0, 1).replace(growth_d=torch.full((50,), math.nan))
    assert cpu.RASTERIZER.draw(model, VIEW, 2.0)[1].sum() == 0

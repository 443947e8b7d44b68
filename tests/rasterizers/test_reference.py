"""The float64 reference against closed forms, plain loops and numerical derivatives."""

import math

import mpmath
import numpy as np
import pytest
import torch
from torch import Tensor

from clod_adapter.cameras import Camera
from clod_adapter.config import ScreenFilter
from clod_adapter.rasterizers import reference
from scenes import camera, in_front


def pixels_of(view: Camera, points: Tensor) -> Tensor:
    focal = view.K.double().diagonal()[:2]
    return focal * points[:, :2] / points[:, 2:] + view.K[:2, 2].double()


def test_one_gaussian_matches_its_closed_form() -> None:
    """On the optical axis: variance (f s / z)^2 + 0.3 along x and y, peak at the projected centre, grey 0.5."""
    view = camera(41, 31)
    focal = view.K.double().diagonal()[:2]
    some = {
        "means": in_front(view, torch.tensor([[0.0, 0.0, 2.5]])), "quats": torch.tensor([[1.0, 0, 0, 0]]),
        "scales": torch.full((1, 3), 0.2), "opacities": torch.tensor([0.8]), "sh0": torch.zeros(1, 1, 3),
        "shN": torch.zeros(1, 0, 3),
    }  # fmt: skip
    some = {name: value.double() for name, value in some.items()}
    behind = torch.tensor([0.3, 0.6, 0.9]).double()
    image, alpha = reference.rasterize(**some, camera=view, background=behind)
    variance = (focal * 0.2 / 2.5) ** 2 + 0.3
    x, y = torch.arange(41).double() + 0.5 - view.K[0, 2], torch.arange(31).double() + 0.5 - view.K[1, 2]
    want = 0.8 * torch.exp(-0.5 * (x**2 / variance[0] + y[:, None] ** 2 / variance[1]))
    want[want < 1 / 255] = 0
    torch.testing.assert_close(alpha, want, rtol=1e-4, atol=1e-6)  # the fixture's centre is rounded to float32
    torch.testing.assert_close(image, 0.5 * alpha[..., None] + (1 - alpha)[..., None] * behind)


def test_projection_matches_finite_differences() -> None:
    """``J W Sigma W^T J^T + variance``, J from finite differences of the pinhole, Sigma from a rotation matrix."""
    g = torch.Generator().manual_seed(0)
    view = camera(80, 60)
    points = torch.tensor([[0.3, 0.2, 2.0]]).double() + 0.3 * torch.randn(5, 3, generator=g).double()
    quats, scales = torch.randn(5, 4, generator=g).double(), torch.rand(5, 3, generator=g).double() + 0.01
    viewmat, K = view.viewmat.double(), view.K.double()
    centres, factors = reference.project(points, quats, scales, viewmat, K, view)
    covariances, _ = reference.blurred(factors, torch.ones(5).double(), ScreenFilter(variance=0.7))
    torch.testing.assert_close(centres, pixels_of(view, points))
    for point, (w, *v), scale, found in zip(points, quats, scales, covariances, strict=True):
        h = 1e-6 * torch.eye(3, dtype=torch.float64)
        jacobian = (pixels_of(view, point + h) - pixels_of(view, point - h)).T / 2e-6
        axis, half = torch.stack(v), torch.atan2(torch.stack(v).norm(), w)
        x, y, z = axis / axis.norm()
        cross = torch.stack([torch.stack([0 * x, -z, y]), torch.stack([z, 0 * x, -x]), torch.stack([-y, x, 0 * x])])
        rotation = torch.linalg.matrix_exp(2 * half * cross)
        sigma = rotation @ torch.diag(scale**2) @ rotation.T
        W = viewmat[:3, :3]
        want = jacobian @ W @ sigma @ W.T @ jacobian.T + 0.7 * torch.eye(2, dtype=torch.float64)
        torch.testing.assert_close(found, want, rtol=1e-6, atol=1e-6)


def test_blending_is_front_to_back() -> None:
    """Compared with a loop over the list of each pixel."""
    g = torch.Generator().manual_seed(0)
    alphas = torch.rand(40, 30, generator=g).double() ** 2
    alphas[torch.rand(40, 30, generator=g) < 0.3] = 0
    alphas[::2] *= 0.2  # some pixels that do not end
    weights, through = reference.blend(alphas)
    for p in range(40):
        t, want = 1.0, [0.0] * 30
        for i, a in enumerate(alphas[p].tolist()):
            if a == 0:
                continue
            if t * (1 - a) <= 1e-4:
                break
            want[i], t = a * t, t * (1 - a)
        torch.testing.assert_close(weights[p].tolist(), want)
        assert through[p].item() == pytest.approx(t, abs=1e-12)
    assert (through < 1e-3).any() and (through > 1e-2).any()


def test_harmonics_match_mpmath() -> None:
    """sqrt(2) Im Y_lm for m < 0 and Re for m > 0, with the Condon-Shortley phase, in the order of l, then m."""
    g = torch.Generator().manual_seed(0)
    directions = torch.randn(50, 3, generator=g).double()
    directions /= directions.norm(dim=1, keepdim=True)
    x, y, z = directions.numpy().T
    found = reference.sh_basis(directions).numpy()
    polar, azimuth = np.arccos(z), np.arctan2(y, x)
    for degree in range(5):
        for m in range(-degree, degree + 1):
            value = np.array([mpmath.fp.spherharm(degree, abs(m), *pair) for pair in zip(polar, azimuth, strict=True)])
            want = value.real if m == 0 else math.sqrt(2) * (value.imag if m < 0 else value.real)
            np.testing.assert_allclose(
                found[:, degree * degree + degree + m], want, atol=1e-12, err_msg=f"l {degree}, m {m}"
            )

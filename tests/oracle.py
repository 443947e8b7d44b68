"""Comparison of a rasterizer with the float64 reference, forward and backward.

Image and alpha differ by at most IMAGE, and the gradient of each input by at most GRADIENT of its
length. Pixels at a threshold (an alpha at 1/255 or at the clamp, a transmittance at 1e-4) are
excluded: they must be few, and may differ by the effect of one Gaussian at 1/255.
"""

import math
from typing import NamedTuple

import pytest
import torch
from torch import Tensor

from clod_adapter.config import CLASSIC
from clod_adapter.rasterizers import reference
from scenes import seeded

IMAGE, GRADIENT, ON_A_CUT = 2e-5, 5e-4, 0.02
BACKGROUND = torch.tensor([0.2, 0.5, 0.7])
Parameters = dict[str, Tensor]


class Result(NamedTuple):
    """An image and, by name, the gradients of a weighted sum of its pixels."""

    image: Tensor
    alpha: Tensor
    gradients: dict[str, Tensor]


def weights(camera):
    g = seeded(0)
    size = (camera.height, camera.width)
    return torch.randn(*size, 3, generator=g), torch.randn(*size, generator=g)


def differentiate(
    rasterize,
    scene,
    camera,
    v,
    screen_filter=CLASSIC,
):
    """Forward and backward, in the scene's float type."""
    dtype = scene["means"].dtype
    leaves = {name: value.clone().requires_grad_() for name, value in scene.items()}
    behind = BACKGROUND.to(dtype, copy=True).requires_grad_()
    image, alpha = rasterize(
        **leaves, camera=camera, background=behind, screen_filter=screen_filter
    )
    total = (image * v[0].to(dtype)).sum() + (alpha * v[1].to(dtype)).sum()
    found = torch.autograd.grad(total, [*leaves.values(), behind])
    return Result(
        image.detach(), alpha.detach(), dict(zip([*leaves, "background"], found, strict=True))
    )


def on_a_cut(scene, camera, nudge, screen_filter):
    """``[H, W]`` bool: pixels that change if the cuts move by ``nudge``, or have an alpha as near
    to the clamp.
    """

    def draw(patch, **constants):
        for name, value in constants.items():
            patch.setattr(reference, name, value)
        behind = BACKGROUND.double()
        return reference.rasterize(
            **scene, camera=camera, background=behind, screen_filter=screen_filter
        )[0]

    images = []
    seen = []
    blend = reference.blend
    for factor in (1 - nudge, 1 + nudge):
        with pytest.MonkeyPatch.context() as patch:
            images.append(
                draw(patch, ALPHA_MIN=reference.ALPHA_MIN * factor, T_MIN=reference.T_MIN * factor)
            )
    with pytest.MonkeyPatch.context() as patch:
        draw(
            patch,
            ALPHA_MAX=math.inf,
            blend=lambda alphas: seen.append(alphas) or blend(alphas.clamp(max=0.5)),
        )
    at_the_clamp = ((seen[0] / reference.ALPHA_MAX - 1).abs() < nudge).any(1)
    return (images[0] != images[1]).any(-1) | at_the_clamp.reshape(camera.height, camera.width)


def without_last(alphas, blend=reference.blend):
    """``reference.blend`` without the Gaussians that end a pixel."""
    return blend(torch.where(torch.cumprod(1 - alphas, 1) > reference.T_MIN, alphas, 0))


def assert_agrees(
    rasterize,
    scene,
    camera,
    *,
    image=IMAGE,
    gradient=GRADIENT,
    cut=ON_A_CUT,
    nudge=1e-4,
    rows=None,
    screen_filter=CLASSIC,
):
    """Asserts agreement; with ``rows``, with the picture of those alone, and gradients of 0 for the
    others.
    """
    looser = getattr(rasterize, "looser", 1.0)  # a backend in float32 with fast intrinsics
    image = image * looser
    gradient = gradient * looser
    cut = cut * looser**0.5
    nudge = nudge * looser**0.5
    twin = {
        name: (value if rows is None else value[rows]).double() for name, value in scene.items()
    }
    with pytest.MonkeyPatch.context() as patch:
        if getattr(rasterize, "drops_last", False):
            patch.setattr(reference, "blend", without_last)
        unsure = on_a_cut(twin, camera, nudge, screen_filter)
        v_image, v_alpha = weights(camera)
        v = v_image * ~unsure[..., None], v_alpha * ~unsure
        want = differentiate(reference.rasterize, twin, camera, v, screen_filter)
    share = unsure.double().mean().item() if unsure.numel() else 0.0
    assert share <= cut, f"{share:.2%} of the pixels are on a cut: this scene tests nothing"
    found = differentiate(rasterize, scene, camera, v, screen_filter)
    colors = want.image.abs().max().clamp(min=1)
    for name in ("image", "alpha"):
        error = (getattr(found, name) - getattr(want, name)).abs()
        worst = error[~unsure].max().item() if (~unsure).any() else 0.0
        assert worst <= image, f"{name} is off by {worst:.1e}"
        assert (error[unsure] <= 4 / 255 * colors).all(), (
            f"{name} on a cut is off by {error[unsure].max():.1e}"
        )
    for name, expected in want.gradients.items():
        got = found.gradients[name].double()
        if rows is not None and name != "background":
            assert (got[~rows] == 0).all(), f"rows that are not drawn have a gradient of {name}"
            got = got[rows]
        error = (got - expected).norm().item()
        length = expected.norm().item()
        assert error <= gradient * length, (
            f"gradient of {name} is off by {error:.1e} of {length:.1e}"
        )


def assert_same(a, b, **tolerance):
    """Asserts equality: bit for bit, or within ``torch.testing.assert_close``'s tolerances."""
    pairs = [("image", a.image, b.image), ("alpha", a.alpha, b.alpha)]
    for name, x, y in [
        *pairs,
        *((name, a.gradients[name], b.gradients[name]) for name in a.gradients),
    ]:
        if tolerance:
            torch.testing.assert_close(x, y, **tolerance, msg=lambda m, name=name: f"{name}: {m}")
        else:
            assert torch.equal(x, y), f"{name} differs by {(x - y).abs().max():.1e}"

"""Image and gradients of the CPU rasterizer against ``rasterizers/reference.py`` in float64, patch by patch.

Each patch of 16x16 pixels gets only the Gaussians whose ellipse of alpha 1/255 reaches it; the weight of all others is
exactly 0. The gradients of the patches are summed and carried through the projection once.

Float32 rounding may change a decision: whether an alpha reaches 1/255, whether a pixel ends at transmittance 1e-4,
which of two Gaussians is in front. A pixel is *unsure* where the reference is within a small relative margin of such a
decision. Elsewhere the target for the image is IMAGE. The gradients, for a loss over all pixels and for one over the
sure pixels, have a target of 5e-4 of their length.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import Any, NamedTuple

import workloads
from clod_adapter.cameras import Camera
from clod_adapter.config import CLASSIC
from clod_adapter.rasterizers import cpu, reference
from contenders import THREADS
from workloads import Workload

import torch
from torch import Tensor

IMAGE = 2e-5
CUT, DEPTH = 3e-4, 1e-6  # margins: of alphas and transmittances, of depths
KINDS = ("cut", "end", "order")
PATCH = 16
CHUNK = 512  # Gaussians that pairs are counted of in one go
EVERY = {"W1": 1, "W2": 5}  # 60,000 of W2's rows are enough for a reference that takes minutes
Fields = dict[str, Tensor]


class Drawn(NamedTuple):
    """Projected Gaussians, front to back."""

    centres: Tensor
    conics: Tensor
    opacities: Tensor
    colors: Tensor
    depths: Tensor
    reach: Tensor  # [n, 2]: distance from the centre at which alpha is 1/255, along x and y, with a margin


class Exact(NamedTuple):
    """The reference's picture, unsure pixels by kind, and gradients for all pixels and for the sure ones."""

    image: Tensor
    unsure: Tensor
    gradients: Fields
    sure_gradients: Fields
    pairs: int


def compare(name: str) -> dict[str, Any]:
    """How our rasterizer agrees with float64, with itself, and with itself on one thread."""
    began, whole = time.perf_counter(), workloads.make(name)
    scene = whole.changed(name, slice(None, None, EVERY[name]))
    exact = differentiate_exactly(scene)
    unsure = exact.unsure.any(-1)
    image, gradients = differentiate(scene, scene.weights)
    sure_gradients = differentiate(scene, scene.weights * ~unsure[..., None])[1]
    error = (image - exact.image).abs().amax(-1)
    by_kind = {f"unsure_{kind}": int(exact.unsure[..., k].sum()) for k, kind in enumerate(KINDS)}
    errors = {field: apart(gradients[field], exact.gradients[field]) for field in gradients}
    sure_errors = {field: apart(sure_gradients[field], exact.sure_gradients[field]) for field in gradients}
    return {
        "workload": name, "gaussians": len(scene.means), "pixels": unsure.numel(), "pairs": exact.pairs,
        "unsure": int(unsure.sum()), **by_kind,
        "flipped": int((error > IMAGE)[unsure].sum()), "flipped_error": error[unsure].max().item(),
        "sure_error": error[~unsure].max().item(), "sure_over_target": int((error > IMAGE)[~unsure].sum()),
        "mean_error": error.mean().item(), "gradient_errors": errors, "sure_gradient_errors": sure_errors,
        **repeatability(scene, image, gradients), "seconds": round(time.perf_counter() - began, 1),
    }  # fmt: skip


def apart(found: Tensor, expected: Tensor) -> float:
    """The length of the difference, relative to that of the expected value."""
    return ((found - expected).norm() / expected.norm()).item()


def repeatability(scene: Workload, image: Tensor, gradients: Fields) -> dict[str, Any]:
    """The same bits a second time? And how far is one thread from two: the image, the worst gradient by its length."""
    again, alike = differentiate(scene, scene.weights)
    torch.set_num_threads(1)
    single, alone = differentiate(scene, scene.weights)
    torch.set_num_threads(THREADS)
    same = torch.equal(again, image) and all(torch.equal(alike[field], gradients[field]) for field in gradients)
    return {
        "same_bits_twice": same, "one_thread_image_error": (single - image).abs().max().item(),
        "one_thread_gradient_error": max(apart(alone[field], gradients[field]) for field in gradients),
    }  # fmt: skip


def differentiate(scene: Workload, weights: Tensor) -> tuple[Tensor, Fields]:
    """Ours: the image, and the gradients of its weighted sum."""
    leaves = {name: value.clone().requires_grad_() for name, value in scene.parameters().items()}
    image, _ = cpu.rasterize(**leaves, camera=scene.camera, background=torch.zeros(3))
    found = torch.autograd.grad((image * weights).sum(), list(leaves.values()))
    return image.detach(), dict(zip(leaves, found, strict=True))


def differentiate_exactly(scene: Workload) -> Exact:
    """The reference's image and gradients."""
    leaves = {name: value.double().requires_grad_() for name, value in scene.parameters().items()}
    drawn, camera = project(leaves, scene.camera), scene.camera
    weights, image = scene.weights.double(), torch.zeros(camera.height, camera.width, 3, dtype=torch.float64)
    unsure, pairs = torch.zeros(camera.height, camera.width, len(KINDS), dtype=torch.bool), 0
    totals = [[torch.zeros_like(field) for field in drawn[:4]] for _ in range(2)]
    for at, pixels, rows in patches(drawn, camera):
        part = [field[rows].detach().requires_grad_() for field in drawn[:4]]
        alphas = alphas_of(pixels, *part[:3])
        blended, _ = reference.blend(torch.where(alphas >= reference.ALPHA_MIN, alphas, 0))
        colors = blended @ part[3]
        doubtful = doubts(alphas.detach(), blended.detach(), drawn.depths[rows])
        shape = image[at].shape[:2]
        image[at], unsure[at] = colors.detach().reshape(*shape, 3), doubtful.reshape(*shape, len(KINDS))
        pairs += int((blended > 0).sum())
        loss = colors * weights[at].reshape(-1, 3)
        for total, pixel_loss in zip(totals, (loss, loss * ~doubtful.any(1, keepdim=True)), strict=True):
            for sums, found in zip(total, torch.autograd.grad(pixel_loss.sum(), part, retain_graph=True), strict=True):
                sums[rows] += found
    found = [torch.autograd.grad(drawn[:4], list(leaves.values()), total, retain_graph=True) for total in totals]
    return Exact(image, unsure, *(dict(zip(leaves, grads, strict=True)) for grads in found), pairs)


def project(leaves: Fields, camera: Camera) -> Drawn:
    """What the reference would draw, up to the blending."""
    means, opacities = leaves["means"], leaves["opacities"]
    viewmat, K = camera.viewmat.to(means), camera.K.to(means)
    points = means @ viewmat[:3, :3].T + viewmat[:3, 3]
    rows = ((points[:, 2] >= camera.near) & (opacities >= reference.ALPHA_MIN)).nonzero()[:, 0]
    rows = rows[points[rows, 2].argsort(stable=True)]
    quats, scales = leaves["quats"][rows], leaves["scales"][rows]
    centres, projected = reference.project(points[rows], quats, scales, viewmat, K, camera)
    covariance, _ = reference.blurred(projected, opacities[rows], CLASSIC)
    colors = reference.shade(means[rows], leaves["sh0"][rows], leaves["shN"][rows], camera.position.to(means))
    fall = 2 * (opacities[rows] / (reference.ALPHA_MIN * (1 - 2 * CUT))).log()
    reach = (fall[:, None] * covariance.diagonal(dim1=1, dim2=2)).sqrt().detach()
    return Drawn(centres, torch.linalg.inv(covariance), opacities[rows], colors, points[rows, 2].detach(), reach)


def patches(drawn: Drawn, camera: Camera) -> Iterator[tuple[tuple[slice, slice], Tensor, Tensor]]:
    """Each patch's place in the image, its pixel centres ``[p, 2]``, and the Gaussians that may be seen there."""
    low, high = drawn.centres.detach() - drawn.reach, drawn.centres.detach() + drawn.reach
    for top in range(0, camera.height, PATCH):
        bottom = min(top + PATCH, camera.height)
        level = ((low[:, 1] <= bottom - 0.5) & (high[:, 1] >= top + 0.5)).nonzero()[:, 0]
        for left in range(0, camera.width, PATCH):
            right = min(left + PATCH, camera.width)
            rows = level[(low[level, 0] <= right - 0.5) & (high[level, 0] >= left + 0.5)]
            x, y = torch.arange(left, right).to(low) + 0.5, torch.arange(top, bottom).to(low) + 0.5
            pixels = torch.stack(torch.meshgrid(x, y, indexing="xy"), -1).reshape(-1, 2)
            yield (slice(top, bottom), slice(left, right)), pixels, rows


def alphas_of(pixels: Tensor, centres: Tensor, conics: Tensor, opacities: Tensor) -> Tensor:
    """``[p, n]``, clamped, but not 0 below 1/255."""
    x, y = (pixels[:, None] - centres).unbind(-1)
    power = -0.5 * (conics[:, 0, 0] * x * x + conics[:, 1, 1] * y * y) - conics[:, 0, 1] * x * y
    return (opacities * power.exp()).clamp(max=reference.ALPHA_MAX)


def doubts(alphas: Tensor, weights: Tensor, depths: Tensor) -> Tensor:
    """``[p, 3]``: pixels near a decision: an alpha at 1/255, the pixel's end, the order of two Gaussians."""
    seen = torch.where(alphas >= reference.ALPHA_MIN, alphas, 0)
    through = torch.cumprod(1 - seen, 1)
    before = torch.cat([torch.ones_like(through[:, :1]), through[:, :-1]], 1)
    at_cut = ((alphas / reference.ALPHA_MIN - 1).abs() < CUT) & (before > reference.T_MIN * (1 - CUT))
    at_end = (through / reference.T_MIN - 1).abs() < CUT
    close = depths.diff() < DEPTH * depths[1:]
    swapped = (weights[:, :-1] > 0) & (seen[:, 1:] > 0) & close
    return torch.stack([at_cut.any(1), at_end.any(1), swapped.any(1)], 1)


@torch.no_grad()
def count_pairs(scene: Workload) -> int:
    """Pairs of Gaussian and pixel that are blended."""
    drawn, pairs = project({name: value.double() for name, value in scene.parameters().items()}, scene.camera), 0
    for _, pixels, rows in patches(drawn, scene.camera):
        light = torch.ones(len(pixels), 1, dtype=torch.float64)
        for some in rows.split(CHUNK) if len(rows) else ():
            alphas = alphas_of(pixels, *(field[some] for field in drawn[:3]))
            seen = torch.where(alphas >= reference.ALPHA_MIN, alphas, 0)
            through = light * torch.cumprod(1 - seen, 1)
            pairs += int(((seen > 0) & (through > reference.T_MIN)).sum())
            light = through[:, -1:]
            alive = light[:, 0] > reference.T_MIN
            pixels, light = pixels[alive], light[alive]
            if not len(pixels):
                break
    return pairs

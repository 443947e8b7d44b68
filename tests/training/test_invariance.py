"""The result of adapting does not depend on unit, place and direction of a scene, nor on what is far from it."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from clod_adapter import AdaptConfig, AttenuationConfig, Camera, Gaussians, Scene, View, evaluate, make_plan
from clod_adapter.cameras import in_its_unit
from clod_adapter.equation.distances import typical_distance
from clod_adapter.initialization.importance import scene_distance
from clod_adapter.rasterizers.reference import rotations
from clod_adapter.training.pseudo_views import reaches
from scenes import gaussians, photograph, ring

Pair = tuple[Gaussians, Scene]
CONFIG = AdaptConfig(max_sv=4, iters=200, lr_shN=0)
TURN = torch.linalg.qr(torch.tensor([[0.3, 0.9, -0.2], [0.5, -0.4, 0.7], [0.8, 0.1, 0.6]], dtype=torch.float64))[0]
TURN = TURN * TURN.det()


@pytest.fixture(scope="module")
def pair() -> Pair:
    """Photographs of Gaussians without SH degrees, which a turned scene would have to turn, and a perturbed copy."""
    truth, random = gaussians(600, 0, 0, size=0.15), torch.Generator().manual_seed(1)
    by = {"means": 0.01, "log_scales": 0.1, "sh0": 0.1, "opacity_logits": 0.3}
    changed = {n: t + by.get(n, 0.0) * torch.randn(t.shape, generator=random) for n, t in truth.tensors().items()}
    seen = photograph(truth, ring(24, 64, 48))
    return truth.replace(**changed), Scene(tuple(v for k, v in enumerate(seen) if k % 4), seen[::4])


def results(base: Gaussians, scene: Scene) -> list[tuple[float, float]]:
    """PSNR and share kept on the held-out views, at s = 1, 2 and 4."""
    plan = make_plan(base, scene, CONFIG)
    rows = evaluate(plan.whole(base, plan.adapt(scene).gaussians), scene.test, (1.0, 2.0, 4.0))
    return [(row.psnr, row.kept_share) for row in rows]


def placed(base: Gaussians, scene: Scene, scale: float, turn: Tensor, shift: float) -> Pair:
    """The scene with ``scale * turn x + shift`` in place of x."""
    means = scale * base.means.double() @ turn.T + shift
    own = torch.stack([matrix_to_quat(turn @ old) for old in rotations(base.quats.double())])
    moved = base.replace(means=means.float(), quats=own.float(), log_scales=base.log_scales + math.log(scale))

    def change(camera: Camera) -> Camera:
        old, new = camera.viewmat.double(), torch.eye(4, dtype=torch.float64)
        new[:3, :3] = old[:3, :3] @ turn.T
        new[:3, 3] = scale * old[:3, 3] - new[:3, :3] @ torch.full((3,), shift, dtype=torch.float64)
        return replace(camera, viewmat=new.float())

    train, test = (tuple(View(change(v.camera), v.image) for v in views) for views in (scene.train, scene.test))
    return moved, in_its_unit(Scene(train, test))


def matrix_to_quat(matrix: Tensor) -> Tensor:
    """The eigenvector of Bar-Itzhack's matrix, which has no special cases."""
    m = matrix
    k = torch.tensor([
        [m[0, 0] - m[1, 1] - m[2, 2], 0, 0, 0],
        [m[0, 1] + m[1, 0], m[1, 1] - m[0, 0] - m[2, 2], 0, 0],
        [m[0, 2] + m[2, 0], m[1, 2] + m[2, 1], m[2, 2] - m[0, 0] - m[1, 1], 0],
        [m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1], m.trace()],
    ], dtype=torch.float64)  # fmt: skip
    x, y, z, w = torch.linalg.eigh(k).eigenvectors[:, -1].tolist()
    return torch.tensor([w, x, y, z], dtype=torch.float64)


@pytest.mark.parametrize(("scale", "shift"), [(1024.0, 0.0), (1.0, 100.0)])
def test_unit_direction_and_place(pair: Pair, scale: float, shift: float) -> None:
    """Within the noise of roundings, which is larger in a scene as small as this.

    Files store float32: loading moves the origin of a scene that is farther away (``Checkpoint.origin``).
    """
    found, wanted = results(*placed(*pair, scale, TURN, shift)), results(*pair)
    for (psnr, kept), (other, share) in zip(found, wanted, strict=True):
        assert psnr == pytest.approx(other, abs=0.5) and kept == pytest.approx(share, abs=0.02), (found, wanted)


def test_a_far_camera_changes_no_length(pair: Pair) -> None:
    """Where growth begins, offsets of pseudo views, and typical distances: to a few per cent."""
    base, scene = pair
    views = (*scene.train, *photograph(base, ring(1, 48, 36, radius=120.0)))
    cameras, usual = ([view.camera for view in some] for some in (views, scene.train))
    assert scene_distance(base, views) == pytest.approx(scene_distance(base, scene.train), rel=0.05)
    assert reaches(base, cameras)[: len(usual)] == pytest.approx(reaches(base, usual), rel=0.1)
    found, wanted = (typical_distance(base.means, each, AttenuationConfig()).median() for each in (cameras, usual))
    assert float(found) == pytest.approx(float(wanted), rel=0.05)

"""The library gives the same results whatever the caller has set of torch."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor

import clod_adapter as clod


def results(capture: Any) -> tuple[list[Tensor], str]:
    """Of a session from files to a baked dial value."""
    base, scene = clod.load(capture.ply).gaussians, clod.load_scene(capture.scene)
    adapted = clod.adapt(base, scene, clod.AdaptConfig(iters=4, max_sv=3), progress=False).gaussians
    cameras = [view.camera for view in scene.train]
    image = clod.render(adapted, cameras[0], virtual_scale=2).image
    attached = clod.attach(base, cameras)
    (row,) = clod.evaluate(adapted, scene.test, [2.0])
    plan = clod.make_plan(base, scene)
    baked = clod.bake(adapted, 2, cameras=cameras)
    dialled = [attached.sigma_d, clod.place_cameras(base, views=2)[0].viewmat, *baked.tensors().values()]
    return [*adapted.tensors().values(), image, *dialled], repr((plan.decisions, row.psnr, row.kept))


@contextmanager
def doubles() -> Iterator[None]:
    torch.set_default_dtype(torch.float64)
    try:
        yield
    finally:
        torch.set_default_dtype(torch.float32)


def test_results_do_not_depend_on_torchs_modes(capture: Any) -> None:
    tensors, texts = results(capture)
    for mode in (torch.inference_mode(), doubles()):
        with mode:
            found, said = results(capture)
        assert said == texts, mode
        for one, other in zip(found, tensors, strict=True):
            assert one.dtype == other.dtype and torch.equal(one, other), mode

"""Pseudo views: renders of the checkpoint as target images."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch

import clod_adapter as clod
import scenes
from clod_adapter.evaluation.baselines import matching_dial
from clod_adapter.training import pseudo_views
from clod_adapter.training.camera_placement import place_cameras
from clod_adapter.training.pseudo_views import (
    FARTHER,
    MOVED,
    TURNED,
    ZOOMED,
    PseudoView,
    add_pseudo_views,
    render_pseudo_views,
)
from clod_adapter.training.schedule import ViewSampler


def test_images_are_renders_of_the_checkpoint(blob: clod.Gaussians) -> None:
    """Renders of a file with a dial are at s = 1."""
    cameras, told = scenes.ring(9, 40, 30), []
    own = clod.with_dial(blob, torch.full((len(blob),), 0.3), clod.AttenuationConfig(scene_distance=4.0))
    scene = render_pseudo_views(own, cameras, progress=lambda now: told.append((now.done, now.total)))
    assert [view.camera for view in scene.test] == [cameras[0], cameras[8]] and len(scene.train) == 7
    image, plain = ((clod.render(g, cameras[1]).image.clamp(0, 1) * 255).round().byte() for g in (own, blob))
    assert torch.equal(scene.train[0].image, image) and not torch.equal(image, plain)
    assert "7 pseudo views to train on, 2 held out, 40x30" in scene.notes[0] and told == [(1, 2), (2, 2)]
    assert render_pseudo_views(own, cameras[:1]).test == ()


def test_each_step_renders_the_checkpoint_from_another_camera(blob: clod.Gaussians) -> None:
    """Near the placed ones; reproducible from a state; a photograph stays where it is."""
    cameras = scenes.ring(3, 40, 30)
    placed = render_pseudo_views(blob, cameras).train
    photograph = scenes.photograph(blob, cameras[:1])[0]
    sampler = ViewSampler((*placed, photograph), clod.AdaptConfig())
    state = sampler.state()
    drawn = [sampler.draw(k, 0.0).view for k in range(9)]
    assert sum(view is photograph for view in drawn) == 3
    for view in drawn:
        if view is not photograph:
            assert torch.equal(view.image, clod.render(blob, view.camera).pixels)
            (own,) = (v for v in placed if v.camera.name == view.camera.name)
            assert isinstance(own, PseudoView)
            assert 0 < (view.camera.position - own.camera.position).norm() < (6 * MOVED + FARTHER) * own.reach
            assert not torch.equal(view.image, own.image)
    sampler.restore(*state)
    again = [sampler.draw(k, 0.0).view for k in range(9)]
    assert all(torch.equal(a.camera.viewmat, b.camera.viewmat) for a, b in zip(drawn, again, strict=True))


def test_training_on_pseudo_views_improves_held_out_views() -> None:
    """At the same count, PSNR on other cameras exceeds that of the initialization."""
    base, scene = scenes.capture(300, views=8, seed=2)
    placed = render_pseudo_views(base, place_cameras(base, views=8))
    config = clod.AdaptConfig(max_sv=4, iters=0)
    untrained = clod.adapt(base, placed, config).gaussians
    trained = clod.adapt(base, placed, dataclasses.replace(config, iters=60)).gaussians
    (after,) = clod.evaluate(trained, scene.test, [4.0])
    same = matching_dial(untrained, [view.camera for view in scene.test], after.kept)
    (before,) = clod.evaluate(untrained, scene.test, [same])
    assert before.kept == pytest.approx(after.kept, abs=1) and after.psnr > before.psnr + 0.5


def test_photographs_that_show_too_little_get_pseudo_views(
    blob: clod.Gaussians, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pseudo_views, "ADDED", 9)
    monkeypatch.setattr(pseudo_views, "MANY", 64)
    monkeypatch.setattr(pseudo_views, "SHOWN", 0.9)
    around, config = scenes.photograph(blob, scenes.ring(40, 80, 60)), clod.AdaptConfig(iters=1)
    for enough in (clod.Scene(around, ()), clod.Scene(around[:1] * 64, ())):
        assert add_pseudo_views(blob, enough, config) == (enough, config)
    scene, lighter = add_pseudo_views(blob, clod.Scene(around[:1], around[1:]), config)
    assert scene.train[0] is around[0] and len(scene.train) == 1 + 9 and scene.test == around[1:]
    assert "only 1 photographs to train on: 9 pseudo views" in scene.notes[-1]
    assert [torch.equal(view.camera.viewmat, around[0].camera.viewmat) for view in scene.train].count(True) == 1 + 4
    assert lighter.lr_means == config.lr_means / 2 and lighter.lr_sigma == config.lr_sigma
    # As many photographs as before, of one part of a scene that has another one.
    apart = {name: torch.zeros_like(value) for name, value in blob.tensors().items()}
    apart["means"] += torch.tensor([40.0, 0, 0])
    two = blob.replace(**{name: torch.cat([value, value + apart[name]]) for name, value in blob.tensors().items()})
    scene, _ = add_pseudo_views(two, clod.Scene(around, ()), config)
    assert len(scene.train) == 40 + 40 + 4 and "the 40 photographs to train on show only" in scene.notes[-1]
    faint = blob.replace(opacity_logits=torch.full((len(blob),), -4.6))  # too faint to place a camera by
    scene, lighter = add_pseudo_views(faint, clod.Scene(around[:2], ()), config)
    assert scene.train == around[:2] and "no pseudo views can be added" in scene.notes[-1]
    assert clod.adapt(faint, scene, lighter).steps == 1


def test_moved_cameras_have_the_documented_offsets(blob: clod.Gaussians) -> None:
    """Of position, direction and focal length; some step back along their direction of view, up to FARTHER reaches."""
    camera, random = scenes.ring(1, 40, 30)[0], np.random.default_rng(0)
    near, back = (
        [PseudoView(camera, blob, 3.0, share).moved(random).camera for _ in range(500)] for share in (0.0, 1.0)
    )
    steps = torch.stack([each.viewmat.double() @ camera.viewmat.double().inverse() for each in near])
    assert steps[:, :3, 3].std(0).tolist() == pytest.approx([MOVED * 3.0] * 3, rel=0.2)
    angles = ((steps.diagonal(dim1=1, dim2=2).sum(1) - 2) / 2).clamp(-1, 1).acos()
    assert angles.square().mean().sqrt() == pytest.approx(TURNED * 3**0.5, rel=0.2)
    zooms = torch.stack([each.K / camera.K for each in near])[:, [0, 1], [0, 1]].log()
    assert torch.equal(zooms[:, 0], zooms[:, 1]) and 0.9 * ZOOMED < zooms.abs().max() <= 1.001 * ZOOMED
    eyes = torch.stack([each.position for each in back])
    behind = (camera.position - eyes) @ camera.viewmat[2, :3] / 3.0
    assert behind.min() > -6 * MOVED and FARTHER / 2 < behind.max() < FARTHER - 1 + 6 * MOVED

"""Pseudo views: renders of the checkpoint as target images."""

from __future__ import annotations

import dataclasses

import pytest
import torch

import clod_adapter as clod
import scenes
from clod_adapter.evaluation.baselines import matching_dial
from clod_adapter.training.camera_placement import place_cameras
from clod_adapter.training.pseudo_views import FEW, OWN, add_pseudo_views, render_pseudo_views


@pytest.mark.parametrize("with_dial", [False, True])
def test_images_are_renders_of_the_checkpoint(blob: clod.Gaussians, with_dial: bool) -> None:
    """Renders of a file with a dial are at s = 1."""
    own, cameras, told = blob, scenes.ring(9, 40, 30), []
    if with_dial:
        own = clod.attach(blob, torch.full((len(blob),), 0.3), clod.AttenuationConfig(scene_distance=4.0))
    scene = render_pseudo_views(own, cameras, progress=lambda now: told.append((now.done, now.total)))
    assert [view.camera for view in scene.test] == [cameras[0], cameras[8]] and len(scene.train) == 7
    image, plain = ((clod.render(g, cameras[1]).image.clamp(0, 1) * 255).round().byte() for g in (own, blob))
    assert torch.equal(scene.train[0].image, image) and torch.equal(image, plain) != with_dial
    assert "7 pseudo views to train on, 2 held out, 40x30" in scene.notes[0] and told == [(k, 9) for k in range(1, 10)]
    assert render_pseudo_views(own, cameras[:1]).test == ()


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


def test_few_photographs_get_pseudo_views(blob: clod.Gaussians) -> None:
    views, config = scenes.photograph(blob, scenes.ring(FEW, 24, 18)), clod.AdaptConfig(iters=1)
    enough = clod.Scene(views, ())
    assert add_pseudo_views(blob, enough, config) == (enough, config)
    scene, lighter = add_pseudo_views(blob, clod.Scene(views[:1], views[1:]), config)
    assert scene.train[0] is views[0] and len(scene.train) == 1 + OWN and scene.test == views[1:]
    assert "only 1 photographs" in scene.notes[-1]
    assert lighter.lr_means == config.lr_means / 2 and lighter.lr_sigma == config.lr_sigma
    faint = blob.replace(opacity_logits=torch.full((len(blob),), -4.6))  # too faint to place a camera by
    scene, lighter = add_pseudo_views(faint, clod.Scene(views[:2], ()), config)
    assert scene.train == views[:2] and "no pseudo views can be added" in scene.notes[-1]
    assert clod.adapt(faint, scene, lighter).steps == 1

"""A result depends neither on where its run was interrupted and resumed, nor on unit, place and
direction of a scene, nor on what is far from it or set of torch.
"""

import copy
import math
import signal
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

import clod_adapter as clod
from clod_adapter import (
    AdaptConfig,
    AttenuationConfig,
    Scene,
    View,
    adapt,
    evaluate,
    make_plan,
)
from clod_adapter.adapter import ATTRIBUTES, with_dial
from clod_adapter.cameras import in_its_unit
from clod_adapter.equation.distances import typical_distance
from clod_adapter.initialization.importance import scene_distance
from clod_adapter.progress import GracefulStop, Phase
from clod_adapter.training import trainer
from clod_adapter.training.pseudo_views import reaches
from runs import config_of, pressing, states_of
from scenes import assert_equal, capture, gaussians, photograph, ring, seeded

RATES = ("means", "quats", "scales", "opacities", "sh0", "shN")
RESUMED = {
    "ours": {},
    "paper": vars(AdaptConfig.paper(iters=12, max_sv=4.0)),
    "sigma_d alone": {"growth": "off", **{f"lr_{name}": 0.0 for name in RATES}},
}


@pytest.mark.parametrize("form", RESUMED)
def test_a_resumed_run_ends_with_the_same_bits(captured, form):
    """From states within and at the end of a round of views, and before, during and after
    averaging.
    """
    base, scene = captured
    if form == "sigma_d alone":
        base = base.replace(shN=torch.zeros_like(base.shN))
    if form == "paper":
        reaches = torch.full((len(base),), 1.5)
        base = with_dial(base, reaches, AttenuationConfig(form="paper", max_sv=3.0))
    config = config_of(**{"iters": 12, **RESUMED[form]})
    states = {}
    whole = adapt(base, scene, config, states_of({1, 6, 10, 11}, states))
    if form == "sigma_d alone":
        start = adapt(base, scene, replace(config, iters=0)).gaussians
        for name in ATTRIBUTES:
            assert torch.equal(getattr(whole.gaussians, name), getattr(start, name))
    seen = []
    for state in states.values():
        again = adapt(base, scene, config, seen.append, copy.deepcopy(state))
        assert_equal(again.gaussians, whole.gaussians)
        assert again.steps == 12 and not again.interrupted
        assert again.start_seconds == whole.start_seconds and again.seconds > state.seconds
    done = [p.done for p in seen if p.phase == Phase.TRAINING]
    assert done[:11] == list(range(2, 13))


@pytest.fixture(autouse=True)
def default_handler():
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def test_an_interrupt_within_the_update_completes_the_step(monkeypatch):
    given = *capture(60, views=4, width=16, height=12), AdaptConfig(iters=12, max_sv=3.0)
    whole = adapt(*given).gaussians
    states = []
    monkeypatch.setattr(
        trainer, "nonfinite_rows", pressing(trainer.nonfinite_rows, signal.SIGINT, at=5)
    )
    found = adapt(*given, lambda now: states.append(now.state) if now.state else None)
    assert found.interrupted and found.signalled and found.steps == 5
    assert_equal(adapt(*given, resume=states[-1]()).gaussians, whole)
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_other_handlers_are_not_affected():
    heard = []
    stop = GracefulStop()
    signal.signal(signal.SIGINT, lambda number, frame: heard.append(number))
    with stop.listening(in_place_of=signal.default_int_handler):
        signal.raise_signal(signal.SIGINT)
    assert heard == [signal.SIGINT] and not stop.requests


CONFIG = AdaptConfig(max_sv=4, iters=60, lr_shN=0)
TURN = Rotation.from_quat([-0.7, 0.1, 0.5, 0.5])


@pytest.fixture(scope="module")
def pair():
    """Photographs of Gaussians without SH degrees, which a turned scene would have to turn, and a
    perturbed copy.
    """
    truth = gaussians(400, 0, 0, size=0.15)
    random = seeded(1)
    by = {"means": 0.01, "log_scales": 0.1, "sh0": 0.1, "opacity_logits": 0.3}
    changed = {
        n: t + by.get(n, 0.0) * torch.randn(t.shape, generator=random)
        for n, t in truth.tensors().items()
    }
    seen = photograph(truth, ring(16, 48, 36))
    return truth.replace(**changed), Scene(tuple(v for k, v in enumerate(seen) if k % 4), seen[::4])


def results(base, scene):
    """PSNR and share kept on the held-out views, at s = 1, 2 and 4."""
    plan = make_plan(base, scene, CONFIG)
    rows = evaluate(plan.adapt(scene).gaussians, scene.test, (1.0, 2.0, 4.0))
    return [(row.psnr, row.kept_share) for row in rows]


def placed(base, scene, scale, shift):
    """The scene turned by TURN, ``scale`` times as large and moved by ``shift``."""
    turn = torch.from_numpy(TURN.as_matrix())
    quats = base.quats.double().roll(-1, 1)
    means = scale * base.means.double() @ turn.T + shift
    quats = (TURN * Rotation.from_quat(quats)).as_quat()
    moved = base.replace(
        means=means.float(),
        quats=torch.from_numpy(quats).float().roll(1, 1),
        log_scales=base.log_scales + math.log(scale),
    )

    def change(view):
        viewmat = view.camera.viewmat.double()
        viewmat[:3, :3] = viewmat[:3, :3] @ turn.T
        viewmat[:3, 3] = scale * viewmat[:3, 3] - viewmat[:3, :3].sum(1) * shift
        return View(replace(view.camera, viewmat=viewmat.float()), view.image)

    return moved, in_its_unit(
        Scene(*(tuple(map(change, views)) for views in (scene.train, scene.test)))
    )


def test_unit_direction_and_place(pair):
    """Within the noise of roundings, large in a scene so small; farther away, ``Checkpoint.origin``
    is for float32.
    """
    moved = results(*placed(*pair, 1024.0, 1024.0 * 100))
    for (psnr, kept), (other, share) in zip(moved, results(*pair), strict=True):
        assert psnr == pytest.approx(other, abs=0.5) and kept == pytest.approx(share, abs=0.02)


def test_a_far_camera_changes_no_length(pair):
    """Where growth begins, offsets of pseudo views, and typical distances: to a few per cent."""
    base, scene = pair
    views = (*scene.train, *photograph(base, ring(1, 48, 36, radius=120.0)))
    cameras = [view.camera for view in views]
    usual = [view.camera for view in scene.train]
    assert scene_distance(base, views) == pytest.approx(scene_distance(base, scene.train), rel=0.05)
    assert reaches(base, cameras)[: len(usual)] == pytest.approx(reaches(base, usual), rel=0.1)

    def median(cameras):
        return float(typical_distance(base.means, cameras, AttenuationConfig()).median())

    assert median(cameras) == pytest.approx(median(usual), rel=0.05)


def session_of(capture):
    """Of a session from files to a baked dial value."""
    base = clod.load(capture.ply).gaussians
    scene = clod.load_scene(capture.scene)
    adapted = adapt(base, scene, AdaptConfig(iters=4, max_sv=3), progress=False).gaussians
    cameras = [view.camera for view in scene.train]
    image = clod.render(adapted, cameras[0], virtual_scale=2).image
    attached = clod.attach(base, cameras)
    (row,) = evaluate(adapted, scene.test, [2.0])
    plan = make_plan(base, scene)
    baked = clod.bake(adapted, 2, cameras=cameras)
    attenuated = [
        attached.sigma_d,
        clod.place_cameras(base, views=2)[0].viewmat,
        *baked.tensors().values(),
    ]
    return [*adapted.tensors().values(), image, *attenuated], repr(
        (plan.decisions, row.psnr, row.kept)
    )


@contextmanager
def doubles():
    torch.set_default_dtype(torch.float64)
    try:
        yield
    finally:
        torch.set_default_dtype(torch.float32)


def test_results_do_not_depend_on_torchs_modes(capture):
    tensors, texts = session_of(capture)
    for mode in (torch.inference_mode(), doubles(), np.errstate(all="raise")):
        with mode:
            found, said = session_of(capture)
        assert said == texts, mode
        for one, other in zip(found, tensors, strict=True):
            assert one.dtype == other.dtype and torch.equal(one, other), mode

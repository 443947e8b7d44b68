"""Cells of the robustness experiment: measurements, baseline, distributions and fingerprints."""

import dataclasses

import pytest
import torch

from clod_adapter.adapter import with_dial
from clod_adapter.cameras import Scene
from clod_adapter.config import AdaptConfig
from clod_adapter.evaluation.evaluate import evaluate
from clod_adapter.evaluation.robustness import adapt_at_range, baseline, scene_fingerprint
from clod_adapter.progress import Phase, Stopped
from scenes import capture


def test_a_range_is_adapted_and_measured_beyond_it() -> None:
    base, scene = capture()
    frames: list[tuple[int, int]] = []
    outcome = adapt_at_range(
        base, scene, AdaptConfig(iters=20, max_sv=2), [1.0, 2.0, 4.0], fingerprint="f",
        progress=lambda now: frames.append((now.done, now.total)),
    )  # fmt: skip
    assert [row["virtual_scale"] for row in outcome.rows] == [1, 2, 4]
    kept = [row["kept"] for row in outcome.rows]
    assert kept == sorted(kept, reverse=True) and kept[-1] < kept[0]
    assert outcome.adapter is not None and outcome.adapter.attenuation.max_sv == 2 and outcome.seconds > 0
    (again,) = evaluate(outcome.adapter.apply(base), scene.test, [2.0])
    assert (again.psnr, again.kept) == (outcome.rows[1]["psnr"], outcome.rows[1]["kept"])
    assert frames[-1] == (3 * len(scene.test), 3 * len(scene.test))


def test_an_interrupted_adaptation_gives_no_cell() -> None:
    base, scene = capture()
    for phase in (Phase.TRAINING, Phase.EVALUATION):
        config, listener = AdaptConfig(iters=4), lambda now, phase=phase: now.phase != phase
        with pytest.raises(Stopped):
            adapt_at_range(base, scene, config, [1.0], fingerprint="f", progress=listener)


def test_baseline_keeps_the_most_opaque() -> None:
    base, scene = capture()
    frames: list[tuple[int, int]] = []
    outcome = baseline(with_dial(base, torch.full((300,), 0.1)), scene.test, (1.0, 0.5, 0.1),
                       progress=lambda now: frames.append((now.done, now.total)))  # fmt: skip
    assert [row["kept"] for row in outcome.rows] == [300, 150, 30]
    assert [row["kept_share"] for row in outcome.rows] == [1, 0.5, 0.1]
    few = base.select(base.opacities.argsort(descending=True)[:30])
    (whole,), (part,) = (evaluate(each, scene.test, [1.0]) for each in (base, few))  # its dial plays no part
    assert [row["psnr"] for row in outcome.rows[::2]] == pytest.approx([whole.psnr, part.psnr], rel=1e-6)
    assert outcome.adapter is None and "log10_sigma_d" not in outcome.distribution
    assert frames == [(k + 1, 3 * len(scene.test)) for k in range(3 * len(scene.test))]


def test_fingerprint_depends_on_images_and_split() -> None:
    _, scene = capture()
    _, same = capture()
    assert scene_fingerprint(scene) == scene_fingerprint(same)
    pixel = scene.train[0].image.clone()
    pixel[0, 0, 0] ^= 1
    changed = (dataclasses.replace(scene.train[0], image=pixel), *scene.train[1:])
    others = [Scene(changed, scene.test), Scene(scene.train[1:], scene.test), Scene(scene.train, scene.train)]
    assert len({scene_fingerprint(s) for s in (scene, *others)}) == 4

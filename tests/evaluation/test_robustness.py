"""Cells of the robustness experiment: measurements, baseline, distributions and fingerprints."""

import dataclasses

import pytest
import torch

from clod_adapter.adapter import with_dial
from clod_adapter.cameras import Scene
from clod_adapter.evaluation.evaluate import evaluate
from clod_adapter.evaluation.robustness import baseline, scene_fingerprint
from scenes import capture


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

"""Culling and sorting by WebGPU and by the worker: the same order, without the Gaussians outside the picture.

The page refuses a software device, on which the worker is faster; ``REAL_GPU`` hides that Chromium's is one.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch

import scenes
from clod_adapter.cameras import Camera
from clod_adapter.config import ScreenFilter
from clod_adapter.gaussians import Gaussians
from clod_adapter.render import render
from clod_adapter.viewer.payload import Payload
from shown import COUNTS, REAL_GPU, Shown, assert_alike, serve, sorts_on_gpu, take

SAME = 50.0  # dB between the two pictures
COUNT = 5000  # Gaussians, more than one workgroup sorts
LOSE = """
    const { requestDevice } = GPUAdapter.prototype;
    GPUAdapter.prototype.requestDevice = async function (...all) {
        return (window.device = await requestDevice.apply(this, all));
    };
"""


class Tabs(NamedTuple):
    """The page sorting by the worker, and by WebGPU."""

    worker: Shown
    gpu: Shown

    def take(self, path: Path) -> None:
        for each in self:
            take(each, path)
        assert sorts_on_gpu(self.gpu)

    def run(self, script: str, *given: object) -> list[Any]:
        return [each.run(script, *given) for each in self]

    def camera(self, camera: Camera) -> None:
        for each in self:
            each.camera(camera)


def test_in_software_no_adapter_is_asked_for(tab: Any, model: Path) -> None:
    """Chromium logs a warning where it has none."""
    tab.add_init_script(
        "Object.defineProperty(navigator, 'gpu', { value: { requestAdapter() { window.asked = true } } })"
    )
    with serve(model) as url:
        assert Shown(tab).ready(url).errors == [] and tab.evaluate("window.asked") is None


@pytest.fixture(scope="module")
def both(tabs: Any, model: Path) -> Iterator[Tabs]:
    with serve(model) as url:
        opened = []
        for script in ("", REAL_GPU + LOSE):
            page = tabs.new_page()
            page.add_init_script(script)
            page.set_viewport_size({"width": 160, "height": 120})  # fast in software
            opened.append(Shown(page).ready(url))
        found = Tabs(*opened)
        if not sorts_on_gpu(found.gpu):
            pytest.skip("this Chromium has no WebGPU adapter")
        yield found
        for each in found:
            each.page.close()


@pytest.fixture
def compared(both: Tabs) -> Iterator[Tabs]:
    """Resets dial, equation and marks by showing a file, as each test does."""
    yield both
    assert both.worker.errors == both.gpu.errors == []


def compare(tabs: Tabs, gaussians: Gaussians, camera: Camera) -> tuple[list[int], list[int], list[int]]:
    """The rows in front of the camera, and those that the worker and WebGPU draw: all with their centre in the picture.

    Order, count and picture of both agree.
    """
    tabs.camera(camera)
    whole = tabs.worker.run("clod.order(false)")["rows"]
    slow, fast = tabs.run("clod.order()")
    assert fast["onGpu"] and not slow["onGpu"]
    assert abs(fast["kept"] - slow["kept"]) <= COUNTS * slow["kept"]
    points = gaussians.means.double() @ camera.viewmat[:3, :3].double().T + camera.viewmat[:3, 3].double()
    depth = points[fast["rows"], 2].numpy()
    assert (np.diff(depth) <= 1e-5).all() and len(set(fast["rows"])) == len(fast["rows"])
    assert len(set(fast["rows"]) - set(slow["rows"])) <= COUNTS * slow["kept"]  # at the threshold
    pixel = points[:, :2] / points[:, 2:] @ camera.K[:2, :2].double().T + camera.K[:2, 2].double()
    inside = ((pixel >= 0) & (pixel <= torch.tensor([camera.width, camera.height]))).all(1)
    for each in (slow, fast):
        left_out = sorted(set(whole) - set(each["rows"]))
        assert int(inside[left_out].sum()) <= COUNTS * slow["kept"]
    a, b = (each.picture().astype(np.float64) for each in tabs)
    assert a.std() > 5 and 10 * np.log10(255**2 / max(((a - b) ** 2).mean(), 1e-9)) >= SAME
    assert [each.counts()["drawn"] for each in tabs] == [len(slow["rows"]), len(fast["rows"])]
    return whole, slow["rows"], fast["rows"]


def small(count: int = COUNT, **settings: Any) -> Gaussians:
    """Gaussians that two pictures of software WebGL draw quickly."""
    model = scenes.dialled(count, 0, 7, **settings)
    return model.replace(log_scales=model.log_scales - 1.5)


HARD = {"cut": "hard", "tau": 0.05, "eps": 0.5, "scene_distance": 2.0}


@pytest.mark.parametrize(
    ("settings", "script"),
    [
        (HARD, "clod.setDial(2)"),
        ({}, "clod.setEquation(false)"),
        ({}, "(clod.setDial(3), document.getElementById('marks').click())"),
    ],
    ids=["dial", "off", "marks"],
)
def test_the_order_and_the_picture_are_the_workers(
    compared: Tabs, save: Callable[..., Path], settings: dict[str, Any], script: str
) -> None:
    """A narrow picture leaves Gaussians out; one that shows all leaves out none."""
    model = small(**settings)
    compared.take(save(model))
    compared.run(script)
    every, *some = compare(compared, model, scenes.camera(160, 120, fov=20))
    assert all(100 < len(rows) < 0.9 * len(every) for rows in some)
    far = torch.eye(4)
    far[2, 3] = 12.0
    whole = replace(scenes.camera(160, 120), viewmat=far)
    compared.run("clod.setDial(1)")
    compared.run(script)
    every, *some = compare(compared, model, whole)
    assert all(abs(len(rows) - len(every)) <= COUNTS * len(every) for rows in some)


def test_the_extent_of_a_gaussian_outside_the_picture(
    compared: Tabs, save: Callable[..., Path], tmp_path: Path
) -> None:
    """Gaussians that reach into it, also grown ones, and by a screen-space filter that is wider than the margin."""
    big = scenes.dialled(800, 0, 7, max_sv=10.0, reference_distance=2.0)
    grown = big.replace(growth_d=torch.linspace(-1, 1.5, 800), log_scales=big.log_scales - 1.0)
    blurred = big.replace(log_scales=big.log_scales - 4, screen_filter=ScreenFilter(variance=100.0))
    for model in (big, grown, blurred):
        path = tmp_path / "model.ply"
        path.write_bytes(b"".join(Payload("model.ply", model).blocks()))
        compared.take(path)
        s = 4.0 if model is grown else 1.0
        compared.run(f"clod.setDial({s})")
        camera = scenes.camera(64, 48, fov=10)
        every, *some = compare(compared, model, camera)
        assert all(len(rows) < len(every) for rows in some)
        assert_alike(compared.worker.picture(), render(model, camera, s).pixels.numpy(), tmp_path / "picture.png")


def test_equal_depths_keep_the_order_of_the_file(compared: Tabs, save: Callable[..., Path]) -> None:
    """Two copies of each Gaussian, thousands of rows apart."""
    model = small(COUNT // 2)
    model = model.replace(attenuation=None, sigma_d=None)
    twice = model.replace(**{
        name: torch.cat([getattr(model, name)] * 2)
        for name in ("means", "quats", "log_scales", "opacity_logits", "sh0", "shN")
    })  # fmt: skip
    compared.take(save(twice))
    *_, fast = compare(compared, twice, scenes.camera(160, 120))
    place = {row: at for at, row in enumerate(fast)}
    pairs = [(place[row], place[row + COUNT // 2]) for row in fast if row < COUNT // 2]
    assert len(pairs) > 1000 and all(second > first for first, second in pairs)


def test_a_view_without_gaussians(compared: Tabs, save: Callable[..., Path]) -> None:
    model = small(500)
    compared.take(save(model))
    away = torch.eye(4)
    away[2, 3] = -100.0
    compared.camera(replace(scenes.camera(160, 120), viewmat=away))
    slow, fast = compared.run("clod.order()")
    assert slow["rows"] == fast["rows"] == [] and compared.gpu.picture().max() == 0


def test_the_worker_takes_over(compared: Tabs, save: Callable[..., Path]) -> None:
    """For a distance unit that depends on the view, and after the device is lost."""
    take(compared.gpu, save(small(500, normalizer="quantile", quantile=0.3), "quantile.ply"))
    assert not sorts_on_gpu(compared.gpu, seconds=1)
    model = small(500)
    compared.take(save(model))
    compared.gpu.page.evaluate("window.device.destroy()")
    camera = scenes.camera(160, 120)
    compared.camera(camera)
    slow, fast = compared.run("clod.order()")
    assert not fast["onGpu"] and fast["rows"] == slow["rows"]
    assert np.array_equal(*(each.picture() for each in compared))

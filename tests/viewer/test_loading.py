"""A file that arrives slowly: its first rows are shown while it loads, and the whole at its end."""

from __future__ import annotations

import base64
import io
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

import clod_adapter
import scenes
from clod_adapter.bake import order_by_extinction
from clod_adapter.gaussians import Gaussians
from clod_adapter.render import render
from shown import Shown, assert_same, drop, serve

COUNT = 6000  # a twentieth has more bytes than the page requests at least
OTHER = 2000  # of the other file in the list
SIZE = {"width": 200, "height": 150}
PARTS = [0.05, 0.1, 0.2, 0.4, 0.8, 1.0]  # of the bytes, at which requests end
# The first picture of the page: {total, text, picture}.
FIRST = """async () => {
    while (!window.clod?.counts().total) await new Promise((resolve) => setTimeout(resolve, 10));
    const picture = await clod.capture();
    return { total: clod.counts().total, text: document.getElementById("busy").textContent, picture };
}"""
# Notes the lengths of the large arrays of bytes that the page allocates or copies.
ALLOCATED = """
    window.allocated = [];
    window.Uint8Array = new Proxy(Uint8Array, {
        construct(target, given) {
            const array = Reflect.construct(target, given);
            if (!(given[0] instanceof ArrayBuffer) && array.length >= 1 << 16) allocated.push(array.length);
            return array;
        },
    });
"""


@pytest.fixture(scope="module")
def coarse_first() -> Gaussians:
    """A wall of large Gaussians and of fine ones with nearly the same colours, which the dial culls first."""
    camera, coarse = scenes.camera(*SIZE.values()), COUNT // 20
    x, y = torch.meshgrid(torch.linspace(-2.4, 2.4, 20), torch.linspace(-1.8, 1.8, coarse // 20), indexing="ij")
    random = torch.Generator().manual_seed(1)
    fine = (torch.rand(COUNT - coarse, 2, generator=random) - 0.5) * torch.tensor([4.8, 3.6])
    at = torch.cat([torch.stack([x.flatten(), y.flatten()], 1), fine])
    first = torch.arange(COUNT) < coarse
    depth = 3.0 + 0.1 * first + 0.05 * torch.rand(COUNT, generator=random)  # at equal ones, rounding decides the order
    colours = torch.stack([at[:, 0].sin(), at[:, 1].cos(), (at[:, 0] + at[:, 1]).cos()], 1)
    model = scenes.dialled(COUNT, 3, 7).replace(
        means=scenes.in_front(camera, torch.cat([at, depth[:, None]], 1)),
        log_scales=torch.where(first, 0.2, 0.02).log()[:, None].repeat(1, 3),
        opacity_logits=torch.where(first, 3.0, 0.0),
        sh0=(colours + 0.1 * torch.randn(COUNT, 3, generator=random))[:, None],
        shN=0.01 * torch.randn(COUNT, 15, 3, generator=random),
        sigma_d=torch.where(first, 30.0, 3.0),
    )
    rows = order_by_extinction(model, [camera])
    assert set(rows[:coarse].tolist()) == set(range(coarse))
    return model.select(rows)


class Slow:
    """The page in a tab, on a network that holds the requests for the file until ``release``."""

    def __init__(self, tabs: Any, url: str) -> None:
        page = tabs.new_page()
        page.set_viewport_size(SIZE)
        self.held: list[Any] = []
        self.ranges: list[str] = []
        page.route("**/files/model", self.hold)
        page.add_init_script(ALLOCATED)
        self.aborted: list[str] = []
        page.on("requestfailed", lambda request: self.aborted.append(request.url))
        self.shown = Shown(page)
        page.goto(url)
        self.wait()
        page.wait_for_timeout(300)  # the rest of the file would take at least 19 times as long
        self.release()

    def hold(self, route: Any) -> None:
        self.ranges.append(route.request.headers["range"])
        self.held.append(route)

    def wait(self) -> None:
        while not self.held:
            self.shown.page.wait_for_timeout(20)

    def release(self) -> None:
        self.held.pop().continue_()

    def finish(self) -> None:
        """Releases all that is requested, until the whole file is shown."""
        while self.shown.page.is_visible("#busy"):
            if self.held:
                self.release()
            self.shown.page.wait_for_timeout(20)
        self.shown.run("clod.ready")


@pytest.fixture
def slow(tabs: Any, coarse_first: Gaussians, tmp_path: Path) -> Iterator[Callable[..., Slow]]:
    """Opens the page of the file ``coarse_first`` and another one at an address with this fragment."""
    path, other = tmp_path / "model.ply", tmp_path / "other.ply"
    clod_adapter.save(path, coarse_first)
    clod_adapter.save(other, coarse_first.select(torch.arange(OTHER)))
    with serve(path, other) as url:
        opened: list[Slow] = []

        def start(fragment: str = "") -> Slow:
            opened.append(Slow(tabs, url + fragment))
            return opened[0]

        yield start
        assert opened[0].shown.errors == []
        opened[0].shown.page.close()


def test_a_slow_file_is_shown_coarse_first(slow: Any, coarse_first: Gaussians, artefacts: Path) -> None:
    """After a twentieth of it, and much like the whole; what the user changes meanwhile stays."""
    loading, camera = slow(), scenes.camera(*SIZE.values())
    shown = loading.shown
    found = shown.page.evaluate(FIRST)
    assert 0.04 * COUNT < found["total"] <= 0.05 * COUNT and found["text"].startswith("Loading model.ply: ")
    data = base64.b64decode(found["picture"].partition(",")[2])
    assert np.asarray(Image.open(io.BytesIO(data))).std() > 5
    shown.camera(camera)
    first = shown.picture()
    shown.run("clod.setDial(2)")
    loading.finish()
    assert shown.page.is_hidden("#busy") and shown.text("#dial-value") == "s = 2.00"
    assert_same(shown, render(coarse_first, camera, 2.0), artefacts / "loaded.png")
    shown.run("clod.setDial(1)")
    last = shown.picture()
    Image.fromarray(np.concatenate([first, last], axis=1)).save(artefacts / "coarse_first.png")
    assert 10 * np.log10(255**2 / float(((first.astype(np.float64) - last) ** 2).mean())) > 20
    ends = [int(each.rpartition("-")[2]) + 1 for each in loading.ranges]
    found = [round(end / ends[-1], 3) for end in ends]
    assert len(found) > 2 and found[:2] == PARTS[:2] and set(found) <= set(PARTS)


def test_a_link_opens_its_view_at_the_first_picture(slow: Any) -> None:
    """And keeps it to the end."""
    loading = slow("#eye=0,0,-3&axes=1,0,0,0,1,0&distance=2&dial=3")
    shown = loading.shown
    assert shown.page.evaluate(FIRST)["total"] < COUNT and shown.text("#dial-value") == "s = 3.00"
    loading.finish()
    assert shown.counts()["total"] == COUNT and shown.text("#dial-value") == "s = 3.00"
    shown.page.keyboard.press("l")
    shown.until("location.hash.startsWith('#eye=0,0,-3&axes=1,0,0,0,1,0&fov=')")


@pytest.mark.parametrize("listed", [False, True])
def test_a_file_that_cannot_be_read_leaves_the_loading_one(slow: Any, listed: bool) -> None:
    """Dropped or chosen from the list, it does not end the loading of the first file."""
    loading = slow()
    shown = loading.shown
    shown.page.evaluate(FIRST)
    loading.wait()
    if listed:
        shown.page.route("**/files/1", lambda route: route.fulfill(body=b"good morning"))
        shown.page.keyboard.press("2")
    else:
        drop(shown, "dropped.ply", b"good morning")
    shown.until("document.getElementById('message').textContent.includes('it is not a splat')")
    assert shown.text("#busy").startswith("Loading model.ply: ") and not loading.aborted
    loading.finish()
    assert shown.counts()["total"] == COUNT and shown.page.title() == "model.ply"


@pytest.mark.parametrize("listed", [False, True])
def test_a_file_shown_meanwhile_ends_the_loading(slow: Any, listed: bool, tmp_path: Path) -> None:
    """Dropped or chosen from the list."""
    loading = slow()
    shown = loading.shown
    shown.page.evaluate(FIRST)
    loading.wait()
    if listed:
        shown.page.keyboard.press("2")
    else:
        drop(shown, "other.ply", (tmp_path / "other.ply").read_bytes())
    shown.until("document.title === 'other.ply' && document.getElementById('busy').hidden")
    shown.run("clod.ready")
    assert shown.counts()["total"] == OTHER and len(loading.aborted) == 1
    asked = len(loading.ranges)
    shown.page.wait_for_timeout(300)
    assert shown.page.is_hidden("#busy") and shown.page.is_hidden("#message") and len(loading.ranges) == asked
    assert shown.counts()["total"] == OTHER and shown.page.title() == "other.ply"


def test_the_bytes_of_a_file_are_kept_once(slow: Any) -> None:
    """One array for a file in parts, none for one in a single response."""
    loading = slow()
    loading.shown.page.evaluate(FIRST)
    loading.finish()
    sizes = loading.shown.page.evaluate("allocated")
    assert sizes == [int(loading.ranges[-1].rpartition("-")[2]) + 1]
    loading.shown.page.keyboard.press("2")
    loading.shown.until("document.title === 'other.ply' && document.getElementById('busy').hidden")
    assert loading.shown.page.evaluate("allocated") == sizes

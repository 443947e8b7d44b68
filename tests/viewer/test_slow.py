"""The page with slow frames and slow sorting."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest

import clod_adapter
import scenes
from shown import Shown, serve

SMALL = {"width": 200, "height": 150}  # fast in software

SLOW = """
    window.frameTakes = window.sortTakes = window.frames = 0;
    const { fenceSync, clientWaitSync, drawElementsInstanced } = WebGL2RenderingContext.prototype;
    const { postMessage } = Worker.prototype, starts = new Map();
    Object.assign(WebGL2RenderingContext.prototype, {
        fenceSync(...all) {
            const fence = fenceSync.apply(this, all);
            starts.set(fence, performance.now());
            return fence;
        },
        clientWaitSync(fence, ...all) {
            if (performance.now() - starts.get(fence) < window.frameTakes) return this.TIMEOUT_EXPIRED;
            return clientWaitSync.call(this, fence, ...all);
        },
        drawElementsInstanced(...all) {
            window.frames++;
            return drawElementsInstanced.apply(this, all);
        },
    });
    Worker.prototype.postMessage = function (...all) {
        setTimeout(() => postMessage.apply(this, all), window.sortTakes);
    };
"""


@pytest.fixture(scope="module")
def slow(tabs: Any, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Shown]:
    """A page whose first frames were fast."""
    path = tmp_path_factory.mktemp("slow") / "model.ply"
    clod_adapter.save(path, scenes.gaussians(200, 0, 5))
    with serve(path) as url:
        page = tabs.new_page()
        page.set_viewport_size(SMALL)
        page.add_init_script(SLOW)
        shown = Shown(page).ready(url)
        for _ in range(12):
            page.mouse.wheel(0, 10)
            page.wait_for_timeout(40)
        page.wait_for_timeout(300)
        yield shown
        page.close()
        assert shown.errors == []


def test_the_last_frame_has_full_resolution(slow: Shown) -> None:
    """Also if the page measures a slow device during the only motion."""
    slow.page.evaluate("window.frameTakes = 60, window.sortTakes = 100")
    slow.page.mouse.wheel(0, 50)
    slow.page.wait_for_timeout(800)
    slow.page.evaluate("clod.whenDrawn()")
    assert slow.page.evaluate("document.getElementById('canvas').width") == SMALL["width"]


def test_frames_do_not_queue(slow: Shown) -> None:
    slow.page.evaluate("window.frameTakes = 250")
    slow.page.mouse.wheel(0, 10)
    slow.page.wait_for_timeout(1000)
    start = slow.page.evaluate("window.frames = 0, performance.now()")
    for _ in range(20):
        slow.page.mouse.wheel(0, 10)
        slow.page.wait_for_timeout(50)
    frames, end = slow.page.evaluate("[window.frames, performance.now()]")
    assert 2 <= frames <= 2 * (end - start) / 250  # a busy machine runs the loop longer, and draws more frames

"""The page on a device that takes long over a frame, and a worker that takes long to sort."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest

import clod_adapter
import scenes
from shown import Shown, serve

SMALL = {"width": 200, "height": 150}  # that software draws quickly

LATE = """
    window.frameTakes = window.sortTakes = window.frames = 0;
    const { fenceSync, clientWaitSync, drawElementsInstanced } = WebGL2RenderingContext.prototype;
    const ask = Worker.prototype.postMessage, began = new Map();
    Object.assign(WebGL2RenderingContext.prototype, {
        fenceSync(...all) {
            const fence = fenceSync.apply(this, all);
            began.set(fence, performance.now());
            return fence;
        },
        clientWaitSync(fence, ...all) {
            if (performance.now() - began.get(fence) < window.frameTakes) return this.TIMEOUT_EXPIRED;
            return clientWaitSync.call(this, fence, ...all);
        },
        drawElementsInstanced(...all) {
            window.frames++;
            return drawElementsInstanced.apply(this, all);
        },
    });
    Worker.prototype.postMessage = function (...all) { setTimeout(() => ask.apply(this, all), window.sortTakes); };
"""


@pytest.fixture(scope="module")
def late(tabs: Any, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Shown]:
    """A page that drew its first frames fast."""
    path = tmp_path_factory.mktemp("late") / "model.ply"
    clod_adapter.save(path, scenes.gaussians(200, 0, 5))
    with serve(path) as url:
        page = tabs.new_page()
        page.set_viewport_size(SMALL)
        page.add_init_script(LATE)
        shown = Shown(page).ready(url)
        for _ in range(12):
            page.mouse.wheel(0, 10)
            page.wait_for_timeout(40)
        page.wait_for_timeout(300)
        yield shown
        page.close()
        assert shown.errors == []


def test_the_last_frame_is_in_full(late: Shown) -> None:
    """Also where the page learns how slow the device is within the only movement."""
    late.page.evaluate("window.frameTakes = 60, window.sortTakes = 100")
    late.page.mouse.wheel(0, 50)
    late.page.wait_for_timeout(800)
    late.page.evaluate("clod.settled()")
    assert late.page.evaluate("document.getElementById('canvas').width") == SMALL["width"]


def test_frames_do_not_queue(late: Shown) -> None:
    late.page.evaluate("window.frameTakes = 250")
    late.page.mouse.wheel(0, 10)
    late.page.wait_for_timeout(1000)
    began = late.page.evaluate("window.frames = 0, performance.now()")
    for _ in range(20):
        late.page.mouse.wheel(0, 10)
        late.page.wait_for_timeout(50)
    frames, ended = late.page.evaluate("[window.frames, performance.now()]")
    assert 2 <= frames <= 2 * (ended - began) / 250  # a busy machine takes longer over the loop, and draws more of them

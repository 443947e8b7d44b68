"""A held frame rate: the law in JavaScript, and the page on a simulated GPU, whose time follows the
Gaussians drawn.
"""

import base64
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

import clod_adapter
from clod_adapter.frame_rate import excess, next_dial
from clod_adapter.viewer.page import write_viewer_page
from shown import Shown, serve

LAW = Path(__file__).parents[2] / "viewers" / "frame_rate.js"
BUDGET = 0.8 * 1000 / 60  # ms of a frame at 60 fps

# window.trace: dial value and milliseconds of each frame; a frame ends when its pixel is read.
GPU = """
    Object.assign(window, { load: 1, trace: [] });
    const now = performance.now.bind(performance);
    let waited = 0;
    WebGL2RenderingContext.prototype.readPixels = () => {
        const { kept, total } = clod.counts(), ms = window.load * (2 + 20 * kept / total);
        window.trace.push([Number(document.getElementById("dial-value").textContent.slice(4)), ms]);
        waited += ms;
    };
    performance.now = () => now() / 100 + waited; // this machine's own time hardly counts
    window.requestAnimationFrame = (draw) => setTimeout(() => draw(performance.now()));
"""


def opened(tabs, url, load):
    page = tabs.new_page()
    page.set_viewport_size({"width": 200, "height": 150})  # fast in software
    page.add_init_script(GPU.replace("load: 1", f"load: {load}"))
    return Shown(page).ready(url)


@pytest.fixture(scope="module")
def simulated(tabs, model):
    with serve(model) as url:
        shown = opened(tabs, url, 1)
        yield shown
        shown.page.close()


def frames(shown, script):
    """The dial value and the time of the frames from ``script`` until the page draws no more."""
    shown.run(f"(window.trace.length = 0, {script})")
    return [list(map(float, frame)) for frame in shown.evaluate("window.trace")]


def turned(shown, load):
    """The same for a change of the load, which shows at the next change of the page: the wipe's,
    from none to none.
    """
    return frames(shown, f"window.load = {load}, clod.setWipe(null)")


@pytest.fixture
def held(simulated):
    """The page holding 60 frames per second by its switch since s = 1, settled."""
    simulated.run("clod.setDial(1)")
    frames(simulated, "window.load = 1, document.getElementById('hold').click()")
    yield simulated
    assert simulated.errors == []


def dial_of(shown):
    return float(shown.dial.removeprefix("s = "))


def test_the_law_is_that_of_python(tab_of_model):
    """On frames with steps of the load, noise, outliers, and a time of 0."""
    random = np.random.default_rng(0)
    load = np.repeat([1.0, 2.5, 0.3, 0.9], 20) * random.lognormal(0, 0.2, 80)
    load[::13] *= 5
    load[40] = 0
    frames = [(1.0, 20.0)]
    for each in load:
        dial = next_dial(frames, 10.0, 5.0)
        frames.append((dial, round(float(each * 18 / dial), 3)))
    script = """async ([source, frames]) => {
        const { excess, nextDial } = await import(`data:text/javascript;base64,${source}`);
        const known = frames.map((_, k) => frames.slice(0, k + 1));
        return known.map((each) => [excess(each, 10), nextDial(each, 10, 5)]);
    }"""
    blank = tab_of_model.page.context.new_page()  # of no policy
    found = blank.evaluate(script, [base64.b64encode(LAW.read_bytes()).decode(), frames])
    blank.close()
    known = [frames[: k + 1] for k in range(len(frames))]
    want = [(excess(each, 10.0), next_dial(each, 10.0, 5.0)) for each in known]
    np.testing.assert_allclose(found, want, rtol=1e-9, atol=1e-9)
    assert len({dial for _, dial in want}) > 20


def test_the_dial_follows_a_load_that_is_switched_on_and_off(held):
    """Within 15 frames; the page then draws no more. A rate that is out of reach ends at the
    largest dial value.
    """
    before = dial_of(held)
    assert 1 < before < 3
    for load in (1.6, 1.0):
        dials, times = zip(*turned(held, load), strict=True)
        assert len(times) < 50, times
        assert all(0.9 * BUDGET < each < 1.1 * BUDGET for each in times[15:] or times[-1:]), times
        # the text has two decimals
        assert all(max(a, b) <= 1.1 * min(a, b) + 0.01 for a, b in pairwise(dials))
        assert dials[-1] > 1.4 * before if load > 1 else dials[-1] < 1.2 * before, (before, dials)
    drawn = (
        "(window.trace.length = 0, new Promise((later) => setTimeout(later, 300)).then(() =>"
        " window.trace.length))"
    )
    assert held.evaluate(drawn) == 0
    shown = float(held.text("#frame").removesuffix(" ms per frame"))
    assert shown == pytest.approx(times[-1], abs=0.6)
    turned(held, 20)
    assert dial_of(held) == 5
    assert "s = 5, the largest trained value, is too slow" in held.text("#target-note")
    turned(held, 1)
    assert dial_of(held) < 5 and held.text("#target-note") == ""
    rate = "document.getElementById('rate')"
    # more time for a frame
    frames(held, f"({rate}.value = 30, {rate}.dispatchEvent(new Event('change')))")
    assert dial_of(held) == 1
    held.evaluate(f"{rate}.value = 60")


def test_the_dial_by_hand_ends_it(simulated):
    shown = simulated
    for end in (
        "document.getElementById('hold').click()",
        "clod.setEquation(false)",
        "location.hash = '#dial=3'",
    ):
        shown.run("(clod.setDial(1), clod.setEquation(true))")
        shown.press("r")
        assert shown.page.is_checked("#hold")
        shown.evaluate(f"() => {{ {end} }}")
        shown.until("!document.getElementById('hold').checked")
        shown.run("clod.whenDrawn()")
        dial = shown.dial
        assert len(turned(shown, 3)) == 1 and shown.dial == dial, end
    for load, moved in ((1, True), (0.1, False)):
        shown.run("clod.setDial(0)")
        frames(shown, f"window.load = {load}, clod.setHold(60)")
        assert (1 < dial_of(shown) < 3) if moved else shown.dial == "all"


def test_a_file_opens_with_a_held_rate(tabs, model, tmp_path):
    """30 frames per second, from everything on, unless a link has a dial value."""
    write_viewer_page(tmp_path / "page.html", clod_adapter.load(model))
    url = (tmp_path / "page.html").as_uri()
    slow = opened(tabs, url, 2)
    dials, times = zip(*slow.evaluate("window.trace"), strict=True)
    assert times[0] == 44
    assert times[-1] == pytest.approx(0.8 * 1000 / 30, rel=0.1)
    assert 1 < dial_of(slow) < 5
    assert all(b <= 1.1 * max(a, 1) + 0.01 for a, b in pairwise(map(float, dials[2:])))
    assert slow.page.is_checked("#hold") and slow.page.input_value("#rate") == "30"
    hopeless = opened(tabs, url, 30)
    few = hopeless.evaluate("window.trace")
    assert len(few) <= 10 and max(dial for dial, _ in few) == 5
    assert hopeless.dial == "all" and not hopeless.page.is_checked("#hold")
    assert hopeless.text("#target-note") == "Dial not moved: under 15 fps at any value"
    # the largest dial value is fast enough, from where the dial then moves
    late = opened(tabs, url, 10)
    assert 1 < dial_of(late) < 5 and late.page.is_checked("#hold")
    linked = opened(tabs, f"{url}#dial=0", 2)
    assert linked.dial == "all" and not linked.page.is_checked("#hold")
    for each in (slow, hopeless, late, linked):
        assert each.errors == []
        each.page.close()

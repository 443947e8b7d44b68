"""A held frame rate: the law in JavaScript, and the page on a simulated GPU, whose time follows the Gaussians drawn."""

from __future__ import annotations

import base64
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from plyfile import PlyData

import clod_adapter
from clod_adapter.frame_rate import excess, next_dial
from clod_adapter.viewer.page import write_viewer_page
from shown import Shown, serve, take

LAW = Path(__file__).parents[2] / "viewers" / "frame_rate.js"
BUDGET = 0.8 * 1000 / 60  # ms of a frame at 60 fps

# window.trace: dial value and milliseconds of each frame timed; a query ends at once, or never if window.stuck.
GPU = """
    Object.assign(window, { load: 1, trace: [], stuck: false });
    const P = WebGL2RenderingContext.prototype, { getExtension, getParameter } = P;
    const now = performance.now.bind(performance);
    const timer = { TIME_ELAPSED_EXT: 1, GPU_DISJOINT_EXT: 2 };
    let waited = 0;
    function takes() {
        const { kept, total } = clod.counts(), ms = window.load * (2 + 20 * kept / total);
        window.trace.push([Number(document.getElementById("dial-value").textContent.slice(4)), ms]);
        return ms;
    }
    Object.assign(P, {
        getExtension(name) { return name.includes("timer_query") ? TIMER : getExtension.call(this, name); },
        getParameter(name) { return name === timer.GPU_DISJOINT_EXT ? false : getParameter.call(this, name); },
        createQuery: () => ({}), deleteQuery() {}, beginQuery() {}, endQuery() {},
        getQueryParameter(query, name) {
            return name === this.QUERY_RESULT_AVAILABLE ? !window.stuck : 1e6 * takes();
        },
        readPixels() { waited += takes(); },
    });
    performance.now = () => now() + waited;
"""
QUERIES, NO_QUERIES = GPU.replace("TIMER", "timer"), GPU.replace("TIMER", "null")


def opened(tabs: Any, url: str, gpu: str) -> Shown:
    page = tabs.new_page()
    page.set_viewport_size({"width": 200, "height": 150})  # fast in software
    page.add_init_script(gpu)
    return Shown(page).ready(url)


@pytest.fixture(scope="module")
def url(model: Path) -> Iterator[str]:
    with serve(model) as address:
        yield address


@pytest.fixture(scope="module")
def simulated(tabs: Any, url: str) -> Iterator[Shown]:
    """The page with a simulated GPU's timer."""
    shown = opened(tabs, url, QUERIES)
    yield shown
    shown.page.close()


@pytest.fixture
def held(simulated: Shown) -> Iterator[Shown]:
    """The same, holding 60 frames per second by its switch since s = 1, settled."""
    simulated.run("clod.setDial(1)")
    frames(simulated, "window.load = 1, document.getElementById('hold').click()")
    yield simulated
    assert simulated.errors == []


def frames(shown: Shown, script: str) -> list[list[float]]:
    """The dial value and the time of the frames from ``script`` until the page draws no more."""
    shown.run(f"(window.trace.length = 0, {script})")
    return [list(map(float, frame)) for frame in shown.page.evaluate("window.trace")]


def turned(shown: Shown, load: float) -> list[list[float]]:
    """The same for a change of the load, which shows at the next change of the page: the wipe's, from none to none."""
    return frames(shown, f"window.load = {load}, clod.setWipe(null)")


def dial_of(shown: Shown) -> float:
    return float(shown.text("#dial-value").removeprefix("s = "))


def test_the_law_is_that_of_python(tab: Any) -> None:
    """On sequences with steps of the load, noise, outliers, and times of 0."""
    random = np.random.default_rng(0)
    sequences = []
    for max_sv in (1.0, 5.0, 12.0):
        load = np.repeat([1.0, 2.5, 0.3, 0.9], 20) * random.lognormal(0, 0.2, 80)
        load[::13] *= 5
        load[40] = 0
        frames = [(1.0, 20.0)]
        for each in load:
            dial = next_dial(frames, 10.0, max_sv)
            frames.append((dial, round(float(each * 18 / dial), 3)))
        sequences.append((frames, max_sv))
    source = base64.b64encode(LAW.read_bytes()).decode()
    script = """async ([source, sequences]) => {
        const { excess, nextDial } = await import(`data:text/javascript;base64,${source}`);
        return sequences.map(([frames, maxSv]) => frames.map((_, k) => {
            const known = frames.slice(0, k + 1);
            return [excess(known, 10), nextDial(known, 10, maxSv)];
        }));
    }"""
    found = tab.evaluate(script, [source, sequences])
    want = [
        [(excess(frames[: k + 1], 10.0), next_dial(frames[: k + 1], 10.0, max_sv)) for k in range(len(frames))]
        for frames, max_sv in sequences
    ]
    for ours, theirs in zip(want, found, strict=True):
        np.testing.assert_allclose(theirs, ours, rtol=1e-9, atol=1e-9)
    assert len({dial for _, dial in want[1]}) > 20


def test_the_dial_follows_a_load_that_is_switched_on_and_off(held: Shown) -> None:
    """Within 15 frames; the page then draws no more."""
    before = dial_of(held)
    assert 1 < before < 3
    for load in (1.6, 1.0):
        dials, times = zip(*turned(held, load), strict=True)
        assert len(times) < 50 and all(0.9 * BUDGET < each < 1.1 * BUDGET for each in times[15:] or times[-1:]), times
        assert all(max(a, b) <= 1.1 * min(a, b) + 0.01 for a, b in pairwise(dials))  # the text has two decimals
        assert dials[-1] > 1.4 * before if load > 1 else dials[-1] < 1.2 * before, (before, dials)
    drawn = "(window.trace.length = 0, new Promise((later) => setTimeout(later, 300)).then(() => window.trace.length))"
    assert held.page.evaluate(drawn) == 0
    assert held.text("#frame") == f"{times[-1]:.0f} ms per frame"


def test_a_rate_out_of_reach_ends_at_the_largest_dial_value(held: Shown) -> None:
    turned(held, 20)
    assert dial_of(held) == 5 and "s = 5, the largest trained value, is too slow" in held.text("#target-note")
    turned(held, 1)
    assert dial_of(held) < 5 and held.text("#target-note") == ""
    change = "(rate) => { rate.value = 30; rate.dispatchEvent(new Event('change')); }"
    frames(held, f"({change})(document.getElementById('rate'))")  # more time for a frame
    assert dial_of(held) == 1
    held.page.evaluate("document.getElementById('rate').value = 60")


HAND = """
    document.getElementById('hold').click()
    clod.setDial(2)
    clod.setEquation(false)
    location.hash = '#dial=3'
    clod.setHold(null)
    target.value = '150', target.dispatchEvent(new Event('change'))
    document.body.dispatchEvent(new KeyboardEvent('keydown', { key: ']', bubbles: true }))
"""


def test_the_dial_by_hand_ends_it(simulated: Shown, model: Path) -> None:
    """So do the equation's switch, a link, and another file."""
    shown = simulated
    for end in (line.strip() for line in HAND.strip().splitlines()):
        shown.run("(clod.setDial(1), clod.setEquation(true))")
        shown.page.evaluate("document.getElementById('hold').click()")
        assert shown.page.is_checked("#hold")
        shown.page.evaluate(f"(target) => {{ {end} }}", shown.page.query_selector("#target"))
        shown.until("!document.getElementById('hold').checked")
        dial = shown.text("#dial-value")
        assert turned(shown, 3) == [] and shown.text("#dial-value") == dial, end
    shown.page.evaluate("document.getElementById('hold').click()")
    take(shown, model)
    assert not shown.page.is_checked("#hold") and shown.errors == []


def test_r_turns_it_on_and_off(simulated: Shown) -> None:
    simulated.run("clod.setDial(1)")
    for on in (True, False):
        simulated.page.keyboard.press("r")
        assert simulated.page.is_checked("#hold") == on


@pytest.mark.parametrize("gpu", [NO_QUERIES, QUERIES.replace("stuck: false", "stuck: true")])
def test_without_queries_a_frame_ends_when_its_pixel_is_read(tabs: Any, url: str, gpu: str) -> None:
    shown = opened(tabs, url, gpu)
    timed = frames(shown, "window.load = 100, clod.setHold(60)")
    assert timed[0][0] == 1 and timed[-1][0] == 5 and shown.errors == []
    shown.page.close()


def test_a_file_opens_with_everything_and_moves_to_what_the_device_holds(
    tabs: Any, model: Path, tmp_path: Path
) -> None:
    """30 frames per second, from 0 where there are no photographs, unless the dial is touched or a link has it."""
    write_viewer_page(tmp_path / "page.html", clod_adapter.load(model))
    url = (tmp_path / "page.html").as_uri()
    fast, slow = opened(tabs, url, QUERIES), opened(tabs, url, QUERIES.replace("load: 1", "load: 2"))
    assert fast.text("#dial-value") == "all" and fast.text("#target-note") == ""
    assert 1 < dial_of(slow) < 5
    assert slow.text("#target-note") == f"Moved to {slow.text('#dial-value')} for 30 fps on this device"
    dials, times = zip(*slow.page.evaluate("window.trace"), strict=True)
    assert times[-1] == pytest.approx(0.8 * 1000 / 30, rel=0.1) and times[0] == 44
    assert all(b <= 1.1 * max(a, 1) + 0.01 for a, b in pairwise(map(float, dials[1:])))
    assert not slow.page.is_checked("#hold")
    take(slow, model)
    assert 1 < dial_of(slow) < 5 and "Moved to s = " in slow.text("#target-note")
    script = "clod.load(Uint8Array.from(atob(given), (letter) => letter.charCodeAt(0)).buffer, 'a.ply')"
    touched = f"{script}.then(() => clod.setDial(0.5))"
    slow.run(touched, base64.b64encode(model.read_bytes()).decode())
    assert slow.text("#dial-value") == "s = 0.50" and slow.text("#target-note") == ""
    hopeless = opened(tabs, url, QUERIES.replace("load: 1", "load: 20"))
    assert hopeless.text("#dial-value") == "all" and "Dial not moved" in hopeless.text("#target-note")
    linked = opened(tabs, f"{url}#dial=0", QUERIES.replace("load: 1", "load: 2"))
    assert linked.text("#dial-value") == "all" and linked.errors == slow.errors == fast.errors == []
    for each in (fast, slow, hopeless, linked):
        each.page.close()


def test_a_file_opens_with_the_count_of_its_device(chromium: Any, model: Path, tmp_path: Path) -> None:
    """However fast it is; a slow one has fewer. Of a device with room for all nothing is said."""
    path = tmp_path / "page.html"
    write_viewer_page(path, clod_adapter.load(model))
    text = path.read_text(encoding="utf-8")
    assert '"devices": {"quest3": 500000, "phone": 1000000,' in text
    path.write_text(text.replace('"quest3": 500000, "phone": 1000000', '"quest3": 50, "phone": 100'), encoding="utf-8")
    devices = {"phone": {"has_touch": True, "is_mobile": True}, "quest3": {"user_agent": "OculusBrowser/40"}}
    for device, count in {"phone": 100, "quest3": 50, "desktop": 400}.items():
        with chromium.new_context(**devices.get(device, {})) as context:
            shown = opened(context, path.as_uri(), QUERIES.replace("load: 1", "load: 0.1"))
            assert shown.counts()["kept"] == count and shown.errors == [], device
            note = f"Opened at {shown.text('#dial-value')}, with {count} Gaussians for such devices"
            assert shown.text("#target-note") == ("" if device == "desktop" else note)
            if device == "phone":
                slow = opened(context, path.as_uri(), QUERIES.replace("load: 1", "load: 5"))
                assert dial_of(slow) > dial_of(shown) and "Moved to s" in slow.text("#target-note")


def test_notes_on_a_dropped_file_stay_when_the_dial_has_settled(tabs: Any, model: Path, tmp_path: Path) -> None:
    """Followed by what became of the dial: kept, moved, or not moved on a device that is too slow."""
    write_viewer_page(tmp_path / "page.html", clod_adapter.load(model))
    file, invalid = PlyData.read(str(model), mmap=False), tmp_path / "invalid.ply"
    file["vertex"]["x"][7] = np.nan
    file.write(str(invalid))
    shown = opened(tabs, (tmp_path / "page.html").as_uri(), QUERIES)
    note = "1 of 400 Gaussians cannot be drawn and were removed"
    ends = {1: "", 2: "; Moved to {} for 30 fps on this device", 20: "; Dial not moved: under 15 fps at any value"}
    for load, end in ends.items():
        shown.page.evaluate(f"window.load = {load}, window.trace.length = 0")
        take(shown, invalid)
        assert len(shown.page.evaluate("window.trace")) > 1
        assert shown.text("#target-note") == note + end.format(shown.text("#dial-value"))
    take(shown, model)
    assert "cannot be drawn" not in shown.text("#target-note") and shown.errors == []
    shown.page.close()


def test_a_rate_is_held_from_everything_on(simulated: Shown) -> None:
    simulated.run("clod.setDial(0)")
    frames(simulated, "window.load = 1, clod.setHold(60)")
    assert 1 < dial_of(simulated) < 3
    simulated.run("clod.setDial(0)")
    frames(simulated, "window.load = 0.1, clod.setHold(60)")
    assert simulated.text("#dial-value") == "all"


def test_without_a_dial_there_is_nothing_to_hold(show: Any, save: Any, plain: Any) -> None:
    shown = show(save(plain))
    assert shown.page.is_disabled("#hold") and shown.page.is_disabled("#rate")
    shown.page.keyboard.press("r")
    assert not shown.page.is_checked("#hold")

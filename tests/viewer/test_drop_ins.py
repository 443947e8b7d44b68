"""The dial in Spark and PlayCanvas: the pages of viewers/examples in a browser, with the engines
from npm.
"""

import io
import json
import re
import shutil
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import torch
from common import ROOT
from PIL import Image
from skimage.metrics import peak_signal_noise_ratio
from torch.testing import assert_close

import browser
import clod_adapter
import scenes
from clod_adapter.equation.attenuation import attenuate

KIT = ROOT / "viewers" / "kit"
SIZE = {"width": 192, "height": 144}  # of its pictures
# Cameras of these viewers look along -z with y up, and the pages turn the splat half a turn about
# x.
FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
PLACE = {
    "spark": (
        """([m, fov]) => {
        controls.enabled = false;
        controls.update = () => {};
        camera.matrix.fromArray(m).decompose(camera.position, camera.quaternion, camera.scale);
        camera.fov = fov;
        camera.updateProjectionMatrix();
    }"""
    ),
    "playcanvas": (
        """([m, fov]) => {
        controls.enabled = false;
        const matrix = new pc.Mat4();
        matrix.set(m);
        camera.setPosition(matrix.getTranslation());
        camera.setRotation(new pc.Quat().setFromMat4(matrix));
        camera.camera.fov = fov;
    }"""
    ),
}


KINDS = {".html": "text/html", ".js": "text/javascript", ".mjs": "text/javascript"}


def engines():
    """The folder that npm installed the viewers into, beside splat-transform."""
    tool = shutil.which("splat-transform")
    modules = Path(tool).parents[1] if tool else Path()
    if not (modules / "@sparkjsdev" / "spark").is_dir() or not (modules / "playcanvas").is_dir():
        pytest.skip("Spark and PlayCanvas are not installed: make peers")
    return modules


@contextmanager
def opened(tabs, viewer, file, script=""):
    """The example page of a viewer with a file; nothing is fetched from a network. ``script`` runs
    before the page's.
    """
    modules = engines()

    def answer(route):
        host, path = route.request.url.split("://")[1].split("?")[0].split("/", 1)
        source = modules / re.sub(r"@\d[\d.]*", "", path.removeprefix("npm/"))
        if host == "example":
            source = file if path == file.name else ROOT / path
        kind = KINDS.get(source.suffix, "application/octet-stream")
        route.fulfill(body=source.read_bytes(), content_type=kind)

    page = tabs.new_page()
    page.set_viewport_size(SIZE)
    page.set_default_timeout(60_000)
    page.route(re.compile("https://"), answer)
    page.add_init_script(script)
    address = f"https://example/viewers/examples/{viewer}.html?file=/{file.name}"
    page.goto(address, wait_until="commit")
    yield page
    page.close()


def placed(camera):
    """The argument of ``PLACE``."""
    to_world = FLIP @ np.linalg.inv(camera["world_to_camera"]) @ FLIP
    fov = 2 * np.degrees(np.arctan(camera["height"] / 2 / camera["focal"]))
    return [to_world.T.ravel().tolist(), fov]


def read_picture(file):
    return np.asarray(Image.open(file, formats=["PNG"]).convert("RGB"), np.float64)


def settled(page):
    """The picture, once it has stopped changing: both viewers sort in a worker."""
    before = b""
    picture = page.screenshot()
    while picture != before:
        page.wait_for_timeout(250)
        before = picture
        picture = page.screenshot()
    return read_picture(io.BytesIO(picture))


def assert_the_wgsl_of_playcanvas_gives_the_equation(page, about):
    """The modifier alone, as software lacks the engine's WebGPU; ``uniform NAME: TYPE;`` is a
    struct's member.
    """
    shown = clod_adapter.load(KIT / "kit.ply").gaussians
    camera = clod_adapter.Camera(torch.tensor(about["world_to_camera"]), torch.eye(3), 8, 8)
    columns = (
        shown.means,
        shown.opacities[:, None],
        shown.sigma_d[:, None],
        shown.growth_d[:, None],
    )
    rows = torch.cat(columns, 1)[::20].tolist()
    eye = ", ".join(map(str, camera.position.tolist()))
    statements = """
        let center = vec3f(rows[at], rows[at + 1], rows[at + 2]);
        let far = rows[at + 4] > 0.0;  // whose opacity the engine does not know
        clod = vec4f(rows[at + 4], rows[at + 5], 0.0, select(0.0, rows[at + 3], far));
        var color = vec4f(0, 0, 0, select(rows[at + 3], 0.0, far));
        var rotation = vec4f(0, 0, 0, 1);
        var scale = vec3f(1);
        modifySplatRotationScale(center, center, &rotation, &scale);
        modifySplatColor(center, &color);
        rows[at] = color.a;
        rows[at + 1] = scale.x;"""
    page.evaluate("app.autoRender = false")
    wgsl = page.evaluate(
        "import('/viewers/playcanvas.js').then(({ modifier }) => modifier(dial.file).wgsl)"
    )
    members = re.findall(r"uniform (\w+: \w+);", wgsl)
    body = re.sub(r"uniform \w+: \w+;", "", wgsl).replace("uniform.", "given.")
    for s in (0.0, 3.0):
        source = f"""
            struct Uniforms {{ {", ".join(members)} }}
            const given = Uniforms(vec3f({eye}), vec2f({s}, 1));
            var<private> clod: vec4f;
            fn loadClod() -> vec4f {{ return clod; }}
            {body}"""
        alpha, scale = torch.tensor(browser.compute(page, source, statements, rows))[:, :2].T
        want = attenuate(
            shown.opacity_logits,
            shown.sigma_d,
            (shown.means, camera),
            s,
            shown.attenuation,
            growth_d=shown.growth_d,
        )
        drawn = want.drawn[::20]
        growth = want.growth[::20]
        assert_close(alpha, drawn, rtol=1e-4, atol=1e-6)
        assert_close(scale[alpha > 0], growth[alpha > 0], rtol=1e-4, atol=0)


@pytest.mark.parametrize("viewer, suffix", [("spark", "spz"), ("playcanvas", "ply")])
def test_the_dial_is_as_exact_as_the_viewer(tabs, viewer, suffix, tmp_path):
    about = json.loads((KIT / "cameras.json").read_text())["cameras"][0]
    no_decay = 0.0
    with opened(tabs, viewer, KIT / f"kit.{suffix}") as page:
        page.wait_for_function("window.dial")
        page.evaluate("document.forms[0].hidden = true")
        page.evaluate(PLACE[viewer], placed(about))
        for frame in about["frames"][::2]:
            page.evaluate("(s) => dial.set(s)", frame["s"])
            within = 0.005 if suffix == "spz" else 0
            assert page.evaluate("dial.kept") == pytest.approx(frame["kept"], rel=within)
            wanted = read_picture(KIT / frame["picture"])
            psnr = peak_signal_noise_ratio(wanted, settled(page), data_range=255)
            no_decay = no_decay or psnr
            assert psnr > max(no_decay - 1, 25), (frame["s"], psnr, no_decay)
            if viewer == "spark":  # drops opacities below its 8 bits
                assert page.evaluate("spark.activeSplats") == pytest.approx(frame["kept"], rel=0.05)
        for value in ("5.01", "-1", "NaN", "'3'", "undefined", "{ keep: 'x' }", "{ keep: 0.5 }"):
            refused = page.evaluate(
                f"() => {{ try {{ dial.set({value}) }} catch (e) {{ return `${{e}}` }} }}"
            )
            assert "RangeError: the dial is set to a number from 0 to 5 or to {keep" in refused, (
                value
            )
        assert page.evaluate("dial.s") == frame["s"]
        again = (
            "attach(app, splat, camera)"
            if viewer == "playcanvas"
            else "attach(mesh, bytes, renderer)"
        )
        said = page.evaluate(
            f"async () => {{ try {{ await {again} }} catch (e) {{ return e.message }} }}"
        )
        assert said == "it has a dial already; use what the first attach returned"
        page.evaluate("dial.set({ keep: 600 })")
        assert page.evaluate("dial.kept") == 600
        page.evaluate("dial.hold(2000)")  # out of reach
        page.wait_for_function("dial.s === dial.file.settings.max_sv")
        page.evaluate("dial.set(2)")
        page.wait_for_timeout(200)
        assert page.evaluate("dial.s") == 2
        script = (
            "import('/viewers/dial.js').then((m) =>"
            " m.readDial(Uint8Array.from(given))).catch(String)"
        )
        for model, error in (
            (scenes.gaussians(50, 0, 7), "the file has no sigma_d, so no dial; adapt it with"),
            (
                scenes.attenuated(50, 0, 7, form="paper"),
                "the paper's form, which viewers do not draw",
            ),
        ):
            clod_adapter.save(tmp_path / "refused.ply", model)
            data = list((tmp_path / "refused.ply").read_bytes())
            assert error in page.evaluate(f"(given) => {script}", data)
        if viewer == "playcanvas":
            assert_the_wgsl_of_playcanvas_gives_the_equation(page, about)


@pytest.mark.parametrize("viewer", ["spark", "playcanvas"])
def test_the_examples_follow_the_pointer_and_the_window(tabs, viewer):
    with opened(tabs, viewer, KIT / "kit.ply") as page:
        page.wait_for_function("window.dial")
        assert page.get_attribute("input", "max") == "5"
        before = settled(page)
        page.mouse.move(100, 100)
        page.mouse.down()
        page.mouse.move(160, 110, steps=5)
        page.mouse.up()
        assert np.abs(settled(page) - before).mean() > 1
        page.set_viewport_size({"width": 300, "height": 120})
        canvas = "document.querySelector('canvas')"
        page.wait_for_function(f"{canvas}.clientWidth === 300 && {canvas}.clientHeight === 120")


@pytest.mark.parametrize("viewer", ["spark", "playcanvas"])
def test_the_examples_show_errors(tabs, viewer, tmp_path):
    clod_adapter.save(tmp_path / "plain.ply", scenes.gaussians(50, 0, 7))
    with opened(tabs, viewer, tmp_path / "plain.ply") as page:
        page.wait_for_function("document.querySelector('p').textContent")
        assert "the file has no sigma_d, so no dial" in page.inner_text("p")
        assert page.is_hidden("form")
        page.route("https://example/none.ply", lambda route: route.fulfill(status=404))
        page.goto(page.url.replace("plain.ply", "none.ply"))
        page.wait_for_function("document.querySelector('p').textContent")
        assert "none.ply: " in page.inner_text("p")


@pytest.mark.parametrize(
    "viewer, given, failing",
    [
        (
            "spark",
            "made, bytes, renderer",
            [
                "attach(made, bytes.slice(9))",
                "attach(Object.assign(made, { context: null }), bytes)",
            ],
        ),
        ("playcanvas", "app, made, camera", ["attach(app, made)"]),
    ],
)
def test_a_dial_is_attached_where_attaching_failed_before(tabs, viewer, given, failing):
    """By damaged bytes, a mesh without a context, or a missing camera."""
    make = {
        "spark": "new mesh.constructor({ fileBytes: bytes.slice() })",
        "playcanvas": "splat.clone()",
    }
    with opened(tabs, viewer, KIT / "kit.ply") as page:
        page.wait_for_function("window.dial")
        for call in failing:
            script = f"""async () => {{
                const made = {make[viewer]};
                await made.initialized;
                if (window.app) app.root.addChild(made);
                const {{ context }} = made;
                const failed = await Promise.resolve().then(() => {call}).catch(String);
                made.context = context;
                return [failed, (await attach({given})).file.count];
            }}"""
            failed, count = page.evaluate(script)
            assert "Error" in failed
            assert count == page.evaluate("dial.file.count")


def test_dials_that_hold_a_rate_share_the_frame(tabs):
    """They turn together, until the frame is fast enough."""
    script = """async () => {
        const { Dial, readDial } = await import("/viewers/dial.js");
        const file = await readDial(await (await fetch("/kit.ply")).arrayBuffer());
        const cost = ({ s }) => 20 * s ** -0.75;
        const time = async (draw) => { await draw(); return cost(one) + cost(other); };
        const viewer = { eye: () => [0, 0, 3], show() {}, time };
        const [one, other] = [new Dial(file, viewer), new Dial(file, viewer)];
        for (const dial of [one, other]) dial.hold(40);
        for (let k = 0; k < 60; k++) await one.frame(() => other.frame(() => {}));
        return [one.s, other.s, cost(one) + cost(other)];
    }"""
    with opened(tabs, "playcanvas", KIT / "kit.ply") as page:
        page.wait_for_function("window.dial")
        one, other, milliseconds = page.evaluate(script)
        assert one == pytest.approx(other, rel=0.1)
        assert milliseconds == pytest.approx(0.8 * 1000 / 40, rel=0.1)


def test_each_module_of_the_package_has_its_types():
    package = json.loads((KIT.parent / "package.json").read_text())
    assert set(package["exports"]) == {".", "./spark", "./playcanvas"}
    for entry in package["exports"].values():
        exported = set(re.findall(r"export (?:async )?function (\w+)", read(entry["default"])))
        typed = set(re.findall(r"export function (\w+)", read(entry["types"])))
        assert typed and typed <= exported
        assert "object" not in re.sub(r"/\*.*?\*/", "", read(entry["types"]), flags=re.DOTALL)


def read(name):
    return (KIT.parent / name).read_text()


def test_playcanvas_draws_a_change_that_comes_while_it_sorts(tabs):
    """In the frame after ``attach``, of which the engine sorts the first one."""
    about = json.loads((KIT / "cameras.json").read_text())["cameras"][0]
    change = f"({PLACE['playcanvas']})({json.dumps(placed(about))}); dial.set(2);"
    attached = f"set() {{ requestAnimationFrame(() => {{ {change} window.changed = true; }}) }}"
    script = f"Object.defineProperty(window, 'splat', {{ {attached} }})"  # named last by the page
    with opened(tabs, "playcanvas", KIT / "kit.ply", script) as page:
        page.wait_for_function("window.changed")
        page.evaluate("document.forms[0].hidden = true")
        picture = settled(page)
        page.evaluate("dial.set(2.0001)")
        assert peak_signal_noise_ratio(settled(page), picture, data_range=255) > 50

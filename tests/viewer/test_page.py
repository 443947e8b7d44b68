"""The page's text, the page as one file, and its messages."""

import hashlib
import json
import re
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

import clod_adapter
import scenes
from clod_adapter import load
from clod_adapter.quality_table import QualityRow, QualityTable
from clod_adapter.render import render
from clod_adapter.viewer import page
from runs import data_in
from scenes import attenuated
from shown import Shown, assert_same, decoded, serve

VIEWER = Path(clod_adapter.__file__).parent / "viewer"
NAME = "<img src=x onerror=clod=1><script>clod=1<!script>&amp;'\".ply"


def test_parts_are_built_from_these_sources():
    """After a change of the sources: npm ci && npm run build, in clod_adapter/viewer/web."""
    texts = {
        name: (VIEWER / "static" / name).read_text("utf-8")
        for name in ("page.html", "viewer.css", "viewer.js")
    }
    for name, text in texts.items():
        assert not re.search(r"""(?:src|href)=["']?https?:|@import|url\(["']?https?:""", text), name
    assert not re.search("</script|<!--", texts["viewer.js"])
    assert "</style" not in texts["viewer.css"]
    web = VIEWER / "web"
    if not web.is_dir():
        pytest.skip("only a checkout contains the sources of the page")
    lines = (VIEWER / "static" / "SOURCES.sha256").read_text("utf-8").splitlines()
    pairs = (line.split("  ") for line in lines)
    listed = {(web / name).resolve(): digest for digest, name in pairs}
    assert {path for path in (web / "src").rglob("*.*") if path.is_file()} <= set(listed)
    for path, digest in listed.items():
        assert hashlib.sha256(path.read_bytes()).hexdigest() == digest, (
            f"{path} has changed since: build again"
        )


def test_the_text_of_one_file(tmp_path):
    """A picture of the first camera, a policy that allows no connection, and no names of
    folders.
    """
    clod_adapter.save(tmp_path / "model.ply", clod_adapter.with_dial(scenes.gaussians(50, 1, 0)))
    saved = load(tmp_path / "model.ply")
    cameras = scenes.ring(2, 1000, 500)
    out = tmp_path / "out" / "page.html"
    out.parent.mkdir()
    shown, losses = page.write_viewer_page(out, saved, cameras=cameras, virtual_scale=2.0)
    assert [each.name for each in out.parent.iterdir()] == ["page.html"] and losses
    text = out.read_text("utf-8")
    policy = re.search('<meta http-equiv="Content-Security-Policy" content="([^"]*)">', text)
    assert policy
    assert "default-src 'none'" in policy[1]
    assert "'self'" not in policy[1]
    assert "unsafe" not in policy[1]
    assert str(tmp_path) not in text
    (poster,) = re.findall('<img id="poster" alt="" src="data:image/jpeg;base64,([^"]*)">', text)
    picture = decoded(poster).astype(float)
    wanted = render(shown, cameras[0].resized(512, 256), 2.0).pixels.numpy()
    assert len(poster) < 60_000
    assert picture.shape == wanted.shape
    assert np.abs(picture - wanted).mean() < 3
    page.write_viewer_page(tmp_path / "alone.html", saved)
    text = (tmp_path / "alone.html").read_text("utf-8")
    assert '<img id="poster"' not in text  # no viewpoint is stored


def test_the_exact_file_is_a_plain_ply(capture, tmp_path):
    """In blocks of rows, without empty SH degrees and rows that were dropped."""
    model = attenuated(20_000, 3, 3, scene_distance=1.0)
    model = model.replace(shN=model.shN.where(torch.arange(15)[:, None] < 8, 0))
    model.means[7, 1] = torch.nan
    capture.write(tmp_path / "a.ply", model)
    loaded = load(tmp_path / "a.ply")
    payload = page.Payload.of(replace(loaded, path=Path("b\udcff.ply")))
    (tmp_path / "payload.ply").write_bytes(b"".join(payload.blocks()))
    assert (tmp_path / "payload.ply").stat().st_size == payload.size
    assert payload.name == "b\\xff.ply"
    read = load(tmp_path / "payload.ply")
    scenes.assert_equal(read.gaussians, loaded.gaussians.replace(shN=loaded.gaussians.shN[:, :8]))
    assert {kind for kind, _ in read.vertex.dtype.fields.values()} == {np.dtype("<f4")}


@pytest.mark.parametrize("exact", [False, True])
def test_a_page_of_one_file(show, save, monkeypatch, exact):
    """What Python reads of its SPZ or PLY, with growth, in units that float16 does not hold, and an
    opacity of 1; its dB near its cameras only. Large data are divided among several elements,
    because browsers limit a text's size.
    """
    monkeypatch.setattr(page, "PART", 15_000)
    size = 1000.0
    model = attenuated(1000, 3, 4, scene_distance=1.0, reference_distance=3.0)
    far = model.replace(
        means=size * model.means,
        log_scales=model.log_scales + float(np.log(size)),
        sigma_d=size * model.sigma_d,
        growth_d=torch.linspace(-0.5, 1, 1000),
        attenuation=replace(model.attenuation, reference_distance=3 * size),
    )
    path = save(far)
    row = QualityRow(1.0, 900.0, 31.5, 0.9, 4.0)
    calibrated = replace(load(path), quality_table=QualityTable((row,), 1000, 2, 8, 6, "a machine"))
    calibrated.gaussians.opacity_logits[3] = torch.inf
    camera = scenes.camera(320, 240)
    viewmat = camera.viewmat.clone()
    viewmat[:3, 3] *= size
    seen = replace(camera, viewmat=viewmat)
    out = path.with_suffix(".html")
    options = {"cameras": [seen], "virtual_scale": 1.0, "exact": exact}
    read, _ = page.write_viewer_page(out, calibrated, **options)
    assert out.read_text("utf-8").count('id="clod-model"') > 2
    shown = show(url=out.as_uri())
    assert shown.text("#quality") == "31.5 dB to the photographs"
    here = shown.link()
    away = re.sub("eye=[^&]*", f"eye={40 * size},0,{-40 * size}", here)
    for view, quality in ((away, ""), (here, "31.5 dB to the photographs")):
        shown.evaluate("hash => { location.hash = hash }", view)
        shown.until(f"document.getElementById('quality').textContent === '{quality}'")
    shown.camera(seen)
    for s in (1.0, 3.0):
        shown.run("clod.setDial(given)", s)
        assert_same(shown, render(read, seen, s))


def test_a_file_without_sigma_d_has_no_dial(show, save, plain):
    """The page shows the reason, and the file's name as text; a name does not end its element."""
    title = f"</script>{NAME}"
    document = page.document(page.page_config([{"name": title}], None, [], 1.0))
    (config,) = data_in(b"".join(document).decode(), "clod-config")
    assert json.loads(config)["title"] == title
    shown = show(save(plain, NAME))
    assert shown.text("#title") == NAME
    assert shown.page.title() == NAME
    assert shown.page.query_selector("img") is None
    for name in ("dial", "target", "equation", "hold", "rate"):
        assert shown.page.is_disabled(f"#{name}")
    assert f"{NAME} has no sigma_d" in shown.text("#no-dial")
    assert f"clod-adapt {NAME}" in shown.text("#no-dial")
    for key in "]re":
        shown.press(key)
    assert shown.counts()["kept"] == 400
    assert shown.picture().max() > 50
    assert not shown.page.is_checked("#hold")
    # a link with a comparison, which needs a dial
    shown.evaluate("location.hash = '#wipe=0.5&dial=3'")
    shown.run("clod.whenDrawn()")
    assert not shown.page.is_checked("#compare")


FEW = """const real = WebGL2RenderingContext.prototype.getParameter;
    WebGL2RenderingContext.prototype.getParameter = function (name) {
        return name === this.MAX_TEXTURE_SIZE ? 0 : real.call(this, name);
    };"""


@pytest.mark.parametrize(
    "error, script",
    [
        ("model.ply: the PLY header has no end_header line", ""),
        ("this graphics device holds at most 0 of the 400 Gaussians", FEW),
        ("WebGL2", "HTMLCanvasElement.prototype.getContext = () => null"),
    ],
)
def test_a_page_that_cannot_show_its_model_says_why(tabs, model, error, script):
    """Keys have no effect then; without WebGL there is no panel either."""
    with serve(model) as url, closing(tabs.new_page()) as tab:
        if not script:
            tab.route("**/files/model", lambda route: route.fulfill(body=b"ply\nformat"))
        tab.add_init_script(script)
        shown = Shown(tab)
        tab.goto(url)
        tab.wait_for_selector("#message:not([hidden])")
        assert error in shown.text("#message") and tab.is_hidden("#panel") == ("WebGL2" in error)
        assert error in tab.evaluate("clod.ready.then(() => '', (error) => error.message)")
        if "WebGL2" not in error:
            for key in "0lvncpe[w+":
                tab.keyboard.press(key)
        assert shown.errors == []

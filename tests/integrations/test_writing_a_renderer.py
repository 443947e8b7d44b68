"""For authors of renderers: the page docs/writing_a_renderer.md, and the golden values of the
shader functions.
"""

import json
import re
from contextlib import closing
from dataclasses import fields
from importlib.resources import files

import pytest
import torch
from common import ROOT

import browser
import clod_adapter
import scenes
from clod_adapter.config import AttenuationConfig
from clod_adapter.equation.attenuation import attenuate, growth_factors
from clod_adapter.hook import Hook

SHADERS = files("clod_adapter.integrations.shaders")
STORED = json.loads(SHADERS.joinpath("golden.json").read_text(encoding="utf-8"))
CALLS = {  # the golden rows of each function, and its call
    "rows": "clodOpacity(a.x, a.y, a.z, a.w, 0.0)",
    "near_rows": f"clodOpacity(a.x, a.y, a.z, a.w, {STORED['near_distance']:.8f})",
    "scale_rows": "clodScale(a.x, a.y, a.z, a.w)",
}

# One vertex a row, its result caught by transform feedback.
WEBGL = """([source, call, rows]) => {
  const gl = document.createElement("canvas").getContext("webgl2"), program = gl.createProgram();
  const vertex = `in vec4 a; out float drawn;\n${source}\nvoid main() { drawn = ${call}; }`;
  for (const [type, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, "void main() {}"]]) {
    const shader = gl.createShader(type);
    gl.shaderSource(shader, "#version 300 es\\nprecision highp float;\\n" + text);
    gl.compileShader(shader);
    gl.attachShader(program, shader);
  }
  gl.bindAttribLocation(program, 0, "a");
  gl.transformFeedbackVaryings(program, ["drawn"], gl.SEPARATE_ATTRIBS);
  gl.linkProgram(program);
  const log = gl.getAttachedShaders(program).map((shader) => gl.getShaderInfoLog(shader)).join();
  if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(log);
  gl.useProgram(program);
  gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
  gl.bufferData(gl.ARRAY_BUFFER, new Float32Array(rows.flat()), gl.STATIC_DRAW);
  gl.enableVertexAttribArray(0);
  gl.vertexAttribPointer(0, 4, gl.FLOAT, false, 0, 0);
  gl.bindBufferBase(gl.TRANSFORM_FEEDBACK_BUFFER, 0, gl.createBuffer());
  gl.bufferData(gl.TRANSFORM_FEEDBACK_BUFFER, 4 * rows.length, gl.STREAM_READ);
  gl.enable(gl.RASTERIZER_DISCARD);
  gl.beginTransformFeedback(gl.POINTS);
  gl.drawArrays(gl.POINTS, 0, rows.length);
  gl.endTransformFeedback();
  const drawn = new Float32Array(rows.length);
  gl.getBufferSubData(gl.TRANSFORM_FEEDBACK_BUFFER, 0, drawn);
  if (gl.getError()) throw new Error("WebGL reports an error");
  return Array.from(drawn);
}"""


def run(page, shader, table):
    """The shader's result for every golden row of a table, of four inputs each."""
    source, rows = (
        SHADERS.joinpath(shader).read_text(encoding="utf-8"),
        [row[:4] for row in STORED[table]],
    )
    if not shader.endswith("wgsl"):  # the HLSL is of what both languages have
        return list(page.evaluate(WEBGL, [source, CALLS[table], rows]))
    statements = "let a = vec4f(rows[at], rows[at + 1], rows[at + 2], rows[at + 3]);"
    return [
        row[0]
        for row in browser.compute(page, source, f"{statements} rows[at] = {CALLS[table]};", rows)
    ]


@pytest.fixture(scope="module")
def page(chromium):
    """A page from a secure place, as WebGPU needs it; nothing is fetched."""
    with closing(chromium.new_page()) as page:
        page.route(
            "**/*", lambda route: route.fulfill(body="<!doctype html>", content_type="text/html")
        )
        page.goto("http://127.0.0.1/")
        yield page


@pytest.mark.parametrize("shader", ["attenuation.glsl", "attenuation.hlsl", "attenuation.wgsl"])
def test_shaders_match_the_golden_values(page, shader):
    for table in ("rows", "near_rows"):
        for got, row in zip(run(page, shader, table), STORED[table], strict=True):
            opacity, *_, want = row
            assert abs(got - want) <= STORED["tolerance"] * opacity and (want > 0 or got == 0), (
                row,
                got,
            )
    for got, row in zip(run(page, shader, "scale_rows"), STORED["scale_rows"], strict=True):
        assert abs(got - row[-1]) <= STORED["tolerance"] * row[-1], (row, got)


def my_opacity(opacity, sigma, distance, scale, near=0.0):
    row = torch.tensor([[opacity], [sigma], [distance]], dtype=torch.float64)
    return float(
        attenuate(*row, scale, AttenuationConfig(near_distance=near), activated=True).drawn
    )


def my_scale(growth, distance, scale, start):
    return float(
        growth_factors(*torch.tensor([[growth], [distance]], dtype=torch.float64), scale, start)
    )


def test_golden_values_match_the_equation():
    """The inputs are usual, extreme and near the end of the reach, all exact in float32; the last
    columns are the equation's in float64, equal to rounding, since exp differs between
    processors.
    """
    for table, near in (("rows", 0.0), ("near_rows", STORED["near_distance"])):
        for *row, drawn in STORED[table]:
            assert my_opacity(*row, near) == pytest.approx(drawn, rel=1e-12, abs=1e-300)
    for *row, factor in STORED["scale_rows"]:
        assert my_scale(*row) == pytest.approx(factor, rel=1e-12, abs=1e-300)


PAGE = (ROOT / "docs" / "writing_a_renderer.md").read_text(encoding="utf-8")


def block(word):
    (found,) = (text for text in re.findall(r"```python\n(.*?)```", PAGE, re.S) if word in text)
    return str(found)


def test_the_code_of_the_page_runs(tmp_path, monkeypatch):
    """The golden loop, which refuses functions that are off; the hook; and a held frame time, with
    20 ms a frame.
    """
    monkeypatch.chdir(tmp_path)
    adapted = scenes.attenuated(300, 1, 3, scene_distance=1.0, reference_distance=5.0)
    adapted = adapted.replace(growth_d=torch.linspace(0, 1, 300))
    clod_adapter.save("model.ply", adapted)
    own = {"my_opacity": my_opacity, "my_scale": my_scale}
    exec(block("golden"), dict(own))
    for name, function in own.items():
        with pytest.raises(AssertionError):
            exec(
                block("golden"),
                own | {name: lambda *row, function=function: function(*row) * 1.001},
            )
    names = {
        "means": adapted.means,
        "opacities": adapted.opacities,
        "viewmat": torch.eye(4),
    }
    names |= {
        "scales": adapted.scales,
        "K": torch.eye(3),
        "width": 2,
        "height": 2,
        "clod_adapter": clod_adapter,
    }
    exec(block(".hook("), names, names)
    hook = Hook(adapted.sigma_d, adapted.attenuation, 3.0, adapted.growth_d)
    want = hook(adapted.means, adapted.opacities, torch.eye(4))
    assert torch.equal(names["opacities"], want[0]) and torch.equal(names["keep"], want[1])
    assert torch.equal(names["scales"], adapted.scales * want[2][:, None]) and want[2].max() > 1.1
    monkeypatch.setattr(
        "clod_adapter.hook.time.perf_counter", iter(0.02 * k for k in range(99)).__next__
    )
    names |= {"hook": hook, "a": adapted.opacities, "path": [torch.eye(4)] * 4}
    exec(block(".hold("), names, names)
    assert names["hook"].virtual_scale == pytest.approx(3.3)
    assert names["hold"].hook.virtual_scale == pytest.approx(3.63)


def test_defaults_of_the_page_match_the_reader():
    told = dict(
        re.findall(r"`(\w+)`\s+\(`?(?:default )?([\w./-]+)`?\)", PAGE.split("2. **Activate**")[0])
    )
    assert set(told) == {field.name for field in fields(AttenuationConfig)}
    for name, value in told.items():
        default = getattr(AttenuationConfig(), name)
        assert (
            value == default if isinstance(default, str) else eval(value) == pytest.approx(default)
        )

"""The shader functions match the golden values in WebGL 2 and WebGPU, and so does the equation."""

from __future__ import annotations

import json
import math
from contextlib import closing
from importlib.resources import files
from typing import Any

import pytest

import browser
from clod_adapter.integrations.shaders import golden

SHADERS = files("clod_adapter.integrations.shaders")
STORED = json.loads(SHADERS.joinpath("golden.json").read_text(encoding="utf-8"))
CALLS = {  # the golden rows of each function, and its call
    "rows": "clodOpacity(a.x, a.y, a.z, a.w, b.x, b.y, b.z > 0.5)",
    "scale_rows": "clodScale(a.x, a.y, a.z, a.w)",
}

# One vertex a row, its result caught by transform feedback.
WEBGL = """([source, call, rows]) => {
  const gl = document.createElement("canvas").getContext("webgl2");
  if (!gl) return "this Chromium has no WebGL 2";
  const shader = (type, text) => {
    const made = gl.createShader(type);
    gl.shaderSource(made, "#version 300 es\\nprecision highp float;\\n" + text);
    gl.compileShader(made);
    if (!gl.getShaderParameter(made, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(made));
    return made;
  };
  const program = gl.createProgram();
  gl.attachShader(program, shader(gl.VERTEX_SHADER, `
    in vec4 a; in vec3 b; out float drawn;
    ${source}
    void main() { drawn = ${call}; gl_PointSize = 1.0; }`));
  gl.attachShader(program, shader(gl.FRAGMENT_SHADER, "out vec4 colour; void main() { colour = vec4(1.0); }"));
  gl.transformFeedbackVaryings(program, ["drawn"], gl.SEPARATE_ATTRIBS);
  gl.linkProgram(program);
  if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(program));
  gl.useProgram(program);
  gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
  gl.bufferData(gl.ARRAY_BUFFER, new Float32Array(rows.flat()), gl.STATIC_DRAW);
  for (const [name, size, offset] of [["a", 4, 0], ["b", 3, 16]]) {
    const at = gl.getAttribLocation(program, name);
    if (at < 0) continue;  // not read by this function
    gl.enableVertexAttribArray(at);
    gl.vertexAttribPointer(at, size, gl.FLOAT, false, 28, offset);
  }
  const caught = gl.createBuffer();
  gl.bindBuffer(gl.TRANSFORM_FEEDBACK_BUFFER, caught);
  gl.bufferData(gl.TRANSFORM_FEEDBACK_BUFFER, 4 * rows.length, gl.STREAM_READ);
  gl.bindBufferBase(gl.TRANSFORM_FEEDBACK_BUFFER, 0, caught);
  gl.enable(gl.RASTERIZER_DISCARD);
  gl.beginTransformFeedback(gl.POINTS);
  gl.drawArrays(gl.POINTS, 0, rows.length);
  gl.endTransformFeedback();
  const drawn = new Float32Array(rows.length);
  gl.getBufferSubData(gl.TRANSFORM_FEEDBACK_BUFFER, 0, drawn);
  if (gl.getError()) throw new Error("WebGL reports an error");
  return Array.from(drawn);
}"""

# One invocation a row, from one storage buffer to another.
WEBGPU = """async ([source, call, rows]) => {
  const adapter = navigator.gpu && await navigator.gpu.requestAdapter();
  if (!adapter) return "this Chromium has no WebGPU adapter";
  const device = await adapter.requestDevice();
  const module = device.createShaderModule({code: source + `
    @group(0) @binding(0) var<storage, read> rows: array<f32>;
    @group(0) @binding(1) var<storage, read_write> drawn: array<f32>;
    @compute @workgroup_size(1) fn main(@builtin(global_invocation_id) id: vec3u) {
      let at = 7u * id.x;
      let a = vec4f(rows[at], rows[at + 1u], rows[at + 2u], rows[at + 3u]);
      let b = vec3f(rows[at + 4u], rows[at + 5u], rows[at + 6u]);
      drawn[id.x] = ${call};
    }`});
  const faults = (await module.getCompilationInfo()).messages;
  if (faults.length) throw new Error(faults.map(fault => fault.message).join("; "));
  const pipeline = device.createComputePipeline({layout: "auto", compute: {module, entryPoint: "main"}});
  const given = new Float32Array(rows.flat()), bytes = 4 * rows.length;
  const input = device.createBuffer({size: given.byteLength, usage: GPUBufferUsage.STORAGE | GPUBufferUsage.COPY_DST});
  const output = device.createBuffer({size: bytes, usage: GPUBufferUsage.STORAGE | GPUBufferUsage.COPY_SRC});
  const copy = device.createBuffer({size: bytes, usage: GPUBufferUsage.MAP_READ | GPUBufferUsage.COPY_DST});
  device.queue.writeBuffer(input, 0, given);
  const encoder = device.createCommandEncoder(), pass = encoder.beginComputePass();
  pass.setPipeline(pipeline);
  pass.setBindGroup(0, device.createBindGroup({layout: pipeline.getBindGroupLayout(0), entries: [
    {binding: 0, resource: {buffer: input}}, {binding: 1, resource: {buffer: output}}]}));
  pass.dispatchWorkgroups(rows.length);
  pass.end();
  encoder.copyBufferToBuffer(output, 0, copy, 0, bytes);
  device.queue.submit([encoder.finish()]);
  await copy.mapAsync(GPUMapMode.READ);
  return Array.from(new Float32Array(copy.getMappedRange()));
}"""


def run(chromium: Any, script: str, shader: str, table: str) -> list[float]:
    """The shader's result for every golden row of a table; rows are padded to seven inputs."""
    source = SHADERS.joinpath(shader).read_text(encoding="utf-8")
    inputs = len(STORED[table.replace("rows", "columns")]) - (2 if table == "rows" else 1)
    rows = [[*map(float, row[:inputs]), *[0.0] * (7 - inputs)] for row in STORED[table]]
    with closing(chromium.new_page()) as page:
        page.route("**/*", lambda route: route.fulfill(body="<!doctype html>", content_type="text/html"))
        page.goto("http://127.0.0.1/")  # answered above; WebGPU is only given to pages from a secure place
        result: Any = page.evaluate(script, [source, CALLS[table], rows])
    if isinstance(result, str):
        browser.missing(result)
    assert len(result) == len(rows)
    return result


@pytest.mark.parametrize(("script", "shader"), [(WEBGL, "attenuation.glsl"), (WEBGPU, "attenuation.wgsl")])
def test_shaders_match_the_golden_values(chromium: Any, script: str, shader: str) -> None:
    for got, row in zip(run(chromium, script, shader, "rows"), STORED["rows"], strict=True):
        *_, faded, want = row
        assert abs(got - want) <= STORED["tolerance"] * faded and (want > 0 or got == 0), (row, got)
    for got, row in zip(run(chromium, script, shader, "scale_rows"), STORED["scale_rows"], strict=True):
        assert abs(got - row[-1]) <= STORED["tolerance"] * row[-1], (row, got)


def test_golden_values_match_the_equation() -> None:
    """Equal to rounding, since exp differs between processors."""
    made = golden.golden()
    for name in ("columns", "scale_columns"):
        assert list(made[name]) == STORED[name]
    assert made["tolerance"] == STORED["tolerance"]
    for table, inputs in (("rows", 7), ("scale_rows", 4)):
        for row, want in zip(made[table], STORED[table], strict=True):
            assert row[:inputs] == want[:inputs]
            assert row[inputs:] == pytest.approx(want[inputs:], rel=1e-12, abs=1e-300)


def test_golden_rows_cover_every_branch() -> None:
    """Attenuated, culled and unchanged rows; distance 0, sigma 0, and both sides of the soft and hard thresholds."""
    rows = [dict(zip(STORED["columns"], row, strict=True)) for row in STORED["rows"]]
    assert 200 <= len(rows) <= 400
    for soft in (False, True):
        mine = [row for row in rows if row["soft"] is soft]
        assert any(row["drawn"] == 0 < row["faded"] for row in mine)
        assert any(row["drawn"] == row["faded"] < row["opacity"] for row in mine)
        assert any(0 < row["drawn"] < row["faded"] for row in mine) is soft
        assert any(row["distance"] == 0 and row["sigma"] <= 0 and row["eps"] == 0 and row["drawn"] > 0 for row in mine)
        assert any(row["distance"] > 0 and row["sigma"] <= 0 and row["eps"] == 0 for row in mine)
        assert any(abs(row["faded"] - row["tau"] * row["scale"]) < 0.01 * row["faded"] for row in mine)
        assert any(row["scale"] == 0 and row["drawn"] == row["opacity"] > 0 for row in mine)


def test_golden_scale_rows_cover_every_branch() -> None:
    """Growth of both signs and 0, within and beyond the reach, and both bounds of the factor."""
    rows = [dict(zip(STORED["scale_columns"], row, strict=True)) for row in STORED["scale_rows"]]
    beyond = [row for row in rows if row["distance"] * row["scale"] > row["reach"]]
    assert any(row["factor"] > 1 for row in beyond) and any(row["factor"] < 1 for row in beyond)
    assert all(row["factor"] == 1 for row in rows if row not in beyond or row["growth"] == 0)
    assert any(row["growth"] != 0 for row in rows if row not in beyond)
    factors = [row["factor"] for row in rows]
    assert max(factors) == pytest.approx(math.exp(20)) and min(factors) == pytest.approx(math.exp(-20))

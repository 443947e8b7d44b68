"""A headless Chromium for tests of what runs in a browser: WebGL 2 and WebGPU in software, nothing
from the network.

    with browser.launch() as chromium:
        page = chromium.new_page()

Needs Playwright's Python package (not its browsers) and a Chromium or Chrome on the PATH, or at
CLOD_CHROMIUM. Where one is missing the test is skipped with a reason; with CLOD_NEED_BROWSER=1 it
fails instead.
"""

import os
import shutil
from contextlib import contextmanager

import pytest

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")
SOFTWARE = [
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",  # WebGL
    "--disable-gpu-compositing",  # of the page around it, which a software GPU slows down
    # WebGPU
    "--enable-unsafe-webgpu",
    "--use-webgpu-adapter=swiftshader",
    "--enable-features=Vulkan",
    "--disable-background-networking",
]

# Runs WGSL statements on each row of a table, in place: `rows[at]` is the row's first number. One
# invocation a row.
COMPUTE = """async ([source, statements, table]) => {
  const adapter = await navigator.gpu?.requestAdapter();
  if (!adapter) return null;
  const device = await adapter.requestDevice();
  const rows = new Float32Array(table.flat()), width = table[0].length;
  const module = device.createShaderModule({ code: `${source}
    @group(0) @binding(0) var<storage, read_write> rows: array<f32>;
    @compute @workgroup_size(1) fn main(@builtin(global_invocation_id) id: vec3u) {
      let at = ${width} * id.x;
      ${statements}
    }` });
  const faults = (await module.getCompilationInfo()).messages;
  if (faults.length) throw new Error(faults.map((fault) => fault.message).join("; "));
  const { STORAGE, COPY_SRC, COPY_DST, MAP_READ } = GPUBufferUsage, size = rows.byteLength;
  const buffer = device.createBuffer({ size, usage: STORAGE | COPY_DST | COPY_SRC });
  const copy = device.createBuffer({ size, usage: MAP_READ | COPY_DST });
  device.queue.writeBuffer(buffer, 0, rows);
  const compute = { module, entryPoint: "main" };
  const pipeline = device.createComputePipeline({ layout: "auto", compute });
  const encoder = device.createCommandEncoder(), pass = encoder.beginComputePass();
  const entries = [{ binding: 0, resource: { buffer } }];
  pass.setPipeline(pipeline);
  pass.setBindGroup(0, device.createBindGroup({ layout: pipeline.getBindGroupLayout(0), entries }));
  pass.dispatchWorkgroups(table.length);
  pass.end();
  encoder.copyBufferToBuffer(buffer, 0, copy, 0, size);
  device.queue.submit([encoder.finish()]);
  await copy.mapAsync(GPUMapMode.READ);
  const found = Array.from(new Float32Array(copy.getMappedRange()));
  return table.map((_, k) => found.slice(width * k, width * (k + 1)));
}"""


def compute(page, source, statements, table):
    """The table after ``statements``; the page is from a secure place, such as loopback. Skips
    without WebGPU.
    """
    found = page.evaluate(COMPUTE, [source, statements, table])
    if found is None:
        missing("this Chromium has no WebGPU adapter")
    return found


def find():
    named = os.environ.get("CLOD_CHROMIUM")
    for name in (named,) if named else NAMES:
        if path := shutil.which(name):
            return path
    missing(
        f"{named} is not a program"
        if named
        else "no Chromium on the PATH: apt-get install chromium"
    )


@contextmanager
def launch():
    """A Playwright browser with its own profile; skips where there is none. Pages load as in a
    user's browser.
    """
    path = find()
    try:
        from playwright.sync_api import sync_playwright
    except ImportError:
        missing("Playwright is not installed: pip install playwright")
    with sync_playwright() as playwright:
        # A test has root in many containers, where Chromium's sandbox refuses to start.
        chromium = playwright.chromium.launch(
            executable_path=path, chromium_sandbox=False, args=SOFTWARE
        )
        try:
            yield chromium
        finally:
            chromium.close()


def missing(what):
    """Skips the test; fails it if CLOD_NEED_BROWSER is 1."""
    if os.environ.get("CLOD_NEED_BROWSER") == "1":
        pytest.fail(f"{what} (CLOD_NEED_BROWSER=1)")
    pytest.skip(what)

// The time of a frame's work. The interval between two frames would not do: a display rounds it up to whole refreshes.

/** Calls `draw()`, and waits until a pixel of its picture can be read; returns milliseconds. `gl`: of WebGL 2. */
export function timed(gl, draw) {
  const start = performance.now();
  draw();
  gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4));
  return performance.now() - start;
}

/** The same for a WebGPU device, whose queue tells when it is empty; resolves with milliseconds. */
export async function timedByQueue(device, draw) {
  const start = performance.now();
  draw();
  await device.queue.onSubmittedWorkDone();
  return performance.now() - start;
}

// The time of a frame's work. The interval between two frames would not do: a display rounds it up to whole refreshes.

const PATIENCE = 1000; // ms until the result of a query
const FAILURES = 5; // of queries that the GPU could not time, after which it is not asked again

/** Of a WebGL 2 context, or without one of a WebGPU device. */
export function createTimer(gl, device) {
  let query = gl?.getExtension("EXT_disjoint_timer_query_webgl2"), failures = 0;

  /** Resolves after the first check that returns true. */
  const until = (check) => new Promise((resolve) => {
    const poll = () => (check() ? resolve() : setTimeout(poll, 1));
    setTimeout(poll, 0);
  });

  /** The GPU's own time; null, and no further queries, if a result never comes or the GPU cannot tell it ("disjoint"). */
  async function byQuery(draw) {
    const { TIME_ELAPSED_EXT, GPU_DISJOINT_EXT } = query, handle = gl.createQuery(), late = performance.now() + PATIENCE;
    gl.getParameter(GPU_DISJOINT_EXT); // clears it
    gl.beginQuery(TIME_ELAPSED_EXT, handle);
    draw();
    gl.endQuery(TIME_ELAPSED_EXT);
    let ready = false;
    await until(() => {
      gl.flush(); // Chromium looks for results only when commands arrive
      ready = gl.getQueryParameter(handle, gl.QUERY_RESULT_AVAILABLE);
      return ready || performance.now() > late;
    });
    const ms = ready && !gl.getParameter(GPU_DISJOINT_EXT) ? gl.getQueryParameter(handle, gl.QUERY_RESULT) / 1e6 : null;
    gl.deleteQuery(handle);
    if (ms === null && (!ready || ++failures === FAILURES)) query = null;
    return ms;
  }

  /** Until a pixel of the frame is read, for which the page waits: Safari and Firefox have no queries. */
  async function byPixel(draw) {
    const start = performance.now();
    draw();
    gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4));
    return performance.now() - start;
  }

  /** Until the page notices the frame's end, without waiting: up to 5 ms more than the work. */
  async function byFence(draw) {
    const start = performance.now();
    draw();
    const fence = gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
    gl.flush();
    await until(() => gl.clientWaitSync(fence, 0, 0) !== gl.TIMEOUT_EXPIRED);
    gl.deleteSync(fence);
    return performance.now() - start;
  }

  /** WebGPU's queue tells when it is empty. */
  async function byQueue(draw) {
    const start = performance.now();
    draw();
    await device.queue.onSubmittedWorkDone();
    return performance.now() - start;
  }

  return {
    /** Calls `draw()`; resolves with the milliseconds of its work. `exact` is for control, else for display. */
    measure: (draw, exact) => (!gl ? byQueue : !exact ? byFence : query ? byQuery : byPixel)(draw),
  };
}

// The view as the fragment of a link: #eye=..&axes=..&fov=..&distance=..&dial=..&equation=off&wipe=..&other=..
// eye: position, world units. axes: right and down, unit vectors. fov: radians across the shorter side of the picture, and
// its width over height. distance: to the
// pivot, world units. up: the axis, if one was chosen. file: its number, from 1.
// wipe: share of the width. other: a dial value or "base".

const digits = (values) => values.map((value) => Number(value.toPrecision(7))).join(",");

export function writeLink(camera, state, up, file) {
  const [right, down] = [camera.rotation.slice(0, 3), camera.rotation.slice(3, 6)];
  const parts = {
    eye: digits(camera.eye), axes: digits([...right, ...down]), fov: digits([camera.fov, camera.aspect]), distance: digits([camera.distance]),
    dial: digits([state.dial]),
  };
  if (up) parts.up = up;
  if (file) parts.file = file + 1;
  if (!state.equation) parts.equation = "off";
  if (state.wipe !== null) {
    parts.wipe = digits([state.wipe]);
    parts.other = state.other === "base" ? "base" : digits([state.other]);
  }
  const url = new URL(location.href);
  url.hash = Object.entries(parts).map(([name, value]) => `${name}=${value}`).join("&");
  return url.href;
}

/** {eye, rotation, fov, distance, dial, equation, wipe, other} of a link; a value that is missing or invalid is null. */
export function readLink(hash) {
  const parts = new URLSearchParams(hash.replace(/^#/, ""));
  const numbers = (name, count) => {
    const values = (parts.get(name) ?? "").split(",").map(Number);
    return parts.has(name) && values.length === count && values.every(Number.isFinite) ? values : null;
  };
  const axes = numbers("axes", 6);
  const [fov, aspect] = numbers("fov", 2) ?? [numbers("fov", 1)?.[0] ?? null, 1], [distance] = numbers("distance", 1) ?? [null];
  return {
    eye: numbers("eye", 3), rotation: axes && orthonormal(axes.slice(0, 3), axes.slice(3)),
    fov: fov > 0.01 && fov < 3 ? fov : null, aspect: aspect > 0.01 && aspect < 100 ? aspect : 1, distance: distance > 0 ? distance : null,
    dial: numbers("dial", 1)?.[0] ?? null, equation: parts.get("equation") !== "off",
    wipe: numbers("wipe", 1)?.[0] ?? null, other: numbers("other", 1)?.[0] ?? "base",
    up: numbers("up", 3), file: (numbers("file", 1)?.[0] ?? 1) - 1,
  };
}

/** Right, down and forward by Gram-Schmidt; null where right and down are parallel or 0. */
function orthonormal(right, down) {
  const rightLength = Math.hypot(...right), x = right.map((v) => v / rightLength);
  const along = x.reduce((sum, v, k) => sum + v * down[k], 0);
  const rest = down.map((v, k) => v - along * x[k]), downLength = Math.hypot(...rest);
  if (!(rightLength > 0 && downLength > 0)) return null;
  const y = rest.map((v) => v / downLength);
  return [...x, ...y, x[1] * y[2] - x[2] * y[1], x[2] * y[0] - x[0] * y[2], x[0] * y[1] - x[1] * y[0]];
}

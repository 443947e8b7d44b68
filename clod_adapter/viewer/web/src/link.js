// The view as the fragment of a link: #eye=..&axes=..&fov=..&distance=..&dial=..&equation=off&wipe=..
// eye: position, world units. axes: right and down, unit vectors. fov: radians across the shorter side of the picture, and
// its width over height. distance: to the pivot, world units. up: the axis, if one was chosen. file: its number, from 1.
// wipe: share of the width.

export function writeLink({ eye, rotation, fov, aspect, distance }, state, up, file) {
  const parts = { eye, axes: rotation.slice(0, 6), fov: [fov, aspect], distance: [distance], dial: [state.dial] };
  if (up) parts.up = up.split(",").map(Number);
  if (file) parts.file = [file + 1];
  if (state.wipe !== null) parts.wipe = [state.wipe];
  const texts = Object.entries(parts).map(([name, values]) => `${name}=${values.map((value) => Number(value.toPrecision(7)))}`);
  const url = new URL(location.href);
  url.hash = [...texts, ...(state.equation ? [] : ["equation=off"])].join("&");
  return url.href;
}

/** {eye, axes, fov, distance, up, dial, file, wipe}: lists of numbers of the right length, undefined where missing or invalid,
 *  and equation. */
export function readLink(hash) {
  const parts = new URLSearchParams(hash.replace(/^#/, "")), lengths = { eye: 3, axes: 6, fov: 2, distance: 1, up: 3, dial: 1, file: 1, wipe: 1 };
  const found = Object.entries(lengths).map(([name, length]) => [name, (parts.get(name) ?? "x").split(",").map(Number), length]);
  const valid = found.filter(([, values, length]) => values.length === length && values.every(Number.isFinite));
  return { ...Object.fromEntries(valid), equation: parts.get("equation") !== "off" };
}

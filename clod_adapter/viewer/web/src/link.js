// The view as the fragment of a link: #eye=..&axes=..&fov=..&distance=..&dial=..&equation=off&wipe=..&other=..
// eye: position, world units. axes: right and down, unit vectors. fov: radians across the shorter side of the picture, and
// its width over height. distance: to the pivot, world units. up: the axis, if one was chosen. file: its number, from 1.
// wipe: share of the width. other: a dial value or "base".
import { cross } from "./vector.js";

const digits = (...values) => values.map((value) => Number(value.toPrecision(7))).join(",");

export function writeLink({ eye, rotation, fov, aspect, distance }, state, up, file) {
  const parts = { eye: digits(...eye), axes: digits(...rotation.slice(0, 6)), fov: digits(fov, aspect), distance: digits(distance), dial: digits(state.dial) };
  if (up) parts.up = up;
  if (file) parts.file = file + 1;
  if (!state.equation) parts.equation = "off";
  if (state.wipe !== null) Object.assign(parts, { wipe: digits(state.wipe), other: state.other === "base" ? "base" : digits(state.other) });
  const url = new URL(location.href);
  url.hash = Object.entries(parts).map(([name, value]) => `${name}=${value}`).join("&");
  return url.href;
}

/** {eye, forward, down, fov, aspect, distance, up, dial, equation, wipe, other, file} of a link; a value that is missing or
 *  invalid is null. */
export function readLink(hash) {
  const parts = new URLSearchParams(hash.replace(/^#/, ""));
  const numbers = (name, count) => {
    const values = (parts.get(name) ?? "").split(",").map(Number);
    return parts.has(name) && values.length === count && values.every(Number.isFinite) ? values : null;
  };
  const number = (name, valid = () => true) => numbers(name, 1)?.filter(valid)[0] ?? null;
  const axes = numbers("axes", 6) ?? [0, 0, 0, 0, 0, 0], down = axes.slice(3), forward = cross(axes.slice(0, 3), down), up = numbers("up", 3);
  const [fov, aspect] = numbers("fov", 2) ?? [number("fov"), 1];
  return {
    eye: numbers("eye", 3), down, forward: Math.hypot(...forward) > 0 ? forward : null, up: up && Math.hypot(...up) > 0 ? up : null,
    fov: fov > 0.01 && fov < 3 ? fov : null, aspect: aspect > 0.01 && aspect < 100 ? aspect : 1, distance: number("distance", (d) => d > 0),
    dial: number("dial"), equation: parts.get("equation") !== "off", wipe: number("wipe"), other: number("other") ?? "base",
    file: (number("file") ?? 1) - 1,
  };
}

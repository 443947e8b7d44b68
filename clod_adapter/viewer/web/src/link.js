// The view in the address: #eye=..&turn=..&field=..&dial=..&equation=off&wipe=..&other=.. A link opens what is seen.

const digits = (values) => values.map((value) => Number(value.toPrecision(7))).join(",");

export function writeLink(camera, state) {
  const [right, down] = [camera.rotation.slice(0, 3), camera.rotation.slice(3, 6)];
  const parts = {
    eye: digits(camera.eye), turn: digits([...right, ...down]), field: digits([camera.field]), reach: digits([camera.reach]),
    dial: digits([state.dial]),
  };
  if (!state.equation) parts.equation = "off";
  if (state.wipe !== null) {
    parts.wipe = digits([state.wipe]);
    parts.other = state.other === "base" ? "base" : digits([state.other]);
  }
  const url = new URL(location.href);
  url.hash = Object.entries(parts).map(([name, value]) => `${name}=${value}`).join("&");
  return url.href;
}

/** What a link says, null where it says nothing usable: {eye, rotation, field, reach, dial, equation, wipe, other}. */
export function readLink(hash) {
  const parts = new URLSearchParams(hash.replace(/^#/, ""));
  const numbers = (name, count) => {
    const values = (parts.get(name) ?? "").split(",").map(Number);
    return parts.has(name) && values.length === count && values.every(Number.isFinite) ? values : null;
  };
  const turn = numbers("turn", 6);
  const [field] = numbers("field", 1) ?? [null], [reach] = numbers("reach", 1) ?? [null];
  return {
    eye: numbers("eye", 3), rotation: turn && orthonormal(turn.slice(0, 3), turn.slice(3)),
    field: field > 0.01 && field < 3 ? field : null, reach: reach > 0 ? reach : null,
    dial: numbers("dial", 1)?.[0] ?? null, equation: parts.get("equation") !== "off",
    wipe: numbers("wipe", 1)?.[0] ?? null, other: numbers("other", 1)?.[0] ?? "base",
  };
}

function orthonormal(right, down) {
  const long = Math.hypot(...right), x = right.map((v) => v / long);
  const along = x.reduce((sum, v, k) => sum + v * down[k], 0);
  const rest = down.map((v, k) => v - along * x[k]), tall = Math.hypot(...rest);
  if (!(long > 0 && tall > 0)) return null;
  const y = rest.map((v) => v / tall);
  return [...x, ...y, x[1] * y[2] - x[2] * y[1], x[2] * y[0] - x[0] * y[2], x[0] * y[1] - x[1] * y[0]];
}

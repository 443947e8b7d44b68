// Files for the page, with what it shows of them.
import { readGaussians } from "../../../../viewers/read.js";

const PART = 2 ** 30; // bytes
const SHORTEST = 1e-15, LONGEST = 1e15; // quaternion (clod_adapter/_kernels)

/** The bytes of a file, in parts: of 2 GB and more, Chromium gives a script none at once. */
async function bytesOf(blob) {
  if (blob.size <= PART) return new Uint8Array(await blob.arrayBuffer());
  const bytes = new Uint8Array(blob.size);
  for (let at = 0; at < blob.size; at += PART) bytes.set(new Uint8Array(await blob.slice(at, at + PART).arrayBuffer()), at);
  return bytes;
}

/** {gaussians, metadata} of a file, a Blob. */
export async function readFile(blob, name) {
  const failed = (message) => { throw new Error(`${name}: ${message}`); };
  const bytes = await bytesOf(blob).catch(() => failed("the browser cannot read it: it is a folder or too large"));
  const refuse = ({ message }) => failed(/again$/.test(message) ? message : `${message}; clod-adapt view ${name} opens every format`);
  const read = await readGaussians(bytes).catch(refuse);
  const rows = usable(read), gaussians = rows.length === read.count ? read : select(read, rows), { settings } = gaussians;
  if (!rows.length) failed("no Gaussian in it can be drawn: values are not finite or rotations are 0; export it again");
  return {
    gaussians,
    metadata: {
      name, attenuation: settings, max_sv: settings?.max_sv ?? 1, screen_filter: gaussians.screenFilter, calibration: gaussians.calibration,
      notes: rows.length < read.count ? `${read.count - rows.length} of ${read.count} Gaussians cannot be drawn and were removed` : "",
      no_dial: settings ? null : `${name} has no sigma_d, so it has no dial; add one: clod-adapt ${name} --images SCENE`,
    },
  };
}

/** The rows that can be drawn: without a value that is not finite, or a rotation too short or long. */
function usable(gaussians) {
  const { count, quats, opacityLogits } = gaussians, good = new Uint8Array(count).fill(1);
  for (const [name, values] of Object.entries(gaussians)) {
    if (!(values instanceof Float32Array) || name === "opacityLogits") continue;
    for (let i = 0, at = 0, width = values.length / count; i < count; i++) for (let k = 0; k < width; k++) if (!Number.isFinite(values[at++])) good[i] = 0;
  }
  for (let i = 0; i < count; i++) {
    const norm = Math.hypot(quats[4 * i], quats[4 * i + 1], quats[4 * i + 2], quats[4 * i + 3]);
    if (!(norm >= SHORTEST && norm <= LONGEST && opacityLogits[i] > -Infinity)) good[i] = 0;
  }
  return [...good.keys()].filter((i) => good[i]);
}

/** These rows of Gaussians. */
export function select(gaussians, rows) {
  const picked = Object.entries(gaussians).map(([name, values]) => {
    if (!(values instanceof Float32Array)) return [name, values];
    const width = values.length / gaussians.count, found = new Float32Array(width * rows.length);
    rows.forEach((row, i) => { for (let k = 0; k < width; k++) found[width * i + k] = values[width * row + k]; });
    return [name, found];
  });
  return { ...Object.fromEntries(picked), count: rows.length };
}

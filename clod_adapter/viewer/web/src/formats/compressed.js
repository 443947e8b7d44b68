// SuperSplat's .compressed.ply: 16 bytes per Gaussian, relative to value ranges of each chunk of 256; SH in 8 bits.
import { SH_C0, allocate, logit, smallestThree } from "./gaussians.js";

const ROWS = 256; // per chunk
const RANGES = ["x", "y", "z", "scale_x", "scale_y", "scale_z", "r", "g", "b"];

export const isCompressed = (header) =>
  header.elements.some(({ name, properties }) => name === "vertex" && properties.some((p) => p.name === "packed_position"));

export function readCompressed(bytes, header) {
  const element = (name) => header.elements.find((candidate) => candidate.name === name);
  const chunk = element("chunk"), vertex = element("vertex"), sh = element("sh");
  const starts = new Map();
  let end = header.length;
  for (const each of header.elements) {
    starts.set(each, end);
    end += each.count * each.size;
  }
  if (header.format !== "binary_little_endian" || !chunk || chunk.count * ROWS < vertex.count || (sh && sh.count !== vertex.count)) {
    throw new Error("it is a compressed PLY of an unknown layout; decompress it first: splat-transform IN.ply OUT.ply");
  }
  if (!(bytes.length >= end)) throw new Error("it is truncated; copy or export it again");
  const view = new DataView(bytes.buffer, bytes.byteOffset), at = ({ properties }, name) => properties.find((p) => p.name === name)?.offset;
  const degree = sh ? [0, 9, 24, 45].indexOf(sh.properties.length) : 0;
  const gaussians = { ...allocate(vertex.count, Math.max(degree, 0)), comments: header.comments };

  /** `fraction`, in [0, 1], of the range of `name` in the chunk of row i; unchanged if the chunk has no such range. */
  const interpolate = (i, name, fraction) => {
    const low = at(chunk, `min_${name}`), base = starts.get(chunk) + Math.floor(i / ROWS) * chunk.size;
    if (low === undefined) return fraction;
    return view.getFloat32(base + low, true) * (1 - fraction) + view.getFloat32(base + at(chunk, `max_${name}`), true) * fraction;
  };
  const offsets = ["position", "rotation", "scale", "color"].map((name) => at(vertex, `packed_${name}`));
  for (let i = 0; i < vertex.count; i++) {
    const [position, rotation, scale, color] = offsets.map((offset) => view.getUint32(starts.get(vertex) + i * vertex.size + offset, true));
    const fractions = [...unpack3(position), ...unpack3(scale), color >>> 24, (color >>> 16) & 255, (color >>> 8) & 255];
    const values = fractions.map((value, k) => interpolate(i, RANGES[k], k < 6 ? value : value / 255));
    gaussians.means.set(values.slice(0, 3), 3 * i);
    gaussians.logScales.set(values.slice(3, 6), 3 * i);
    gaussians.sh0.set(values.slice(6).map((value) => (value - 0.5) / SH_C0), 3 * i);
    gaussians.opacityLogits[i] = logit((color & 255) / 255);
    const three = [20, 10, 0].map((shift) => (((rotation >>> shift) & 1023) / 1023 - 0.5) * Math.SQRT2);
    gaussians.quats.set(smallestThree(rotation >>> 30, three), 4 * i);
  }
  readSh(gaussians, bytes, sh && starts.get(sh));
  return gaussians;
}

/** Integers of 11, 10 and 11 bits, as fractions. */
const unpack3 = (packed) => [(packed >>> 21) / 2047, ((packed >>> 11) & 1023) / 1023, (packed & 2047) / 2047];

/** SH of degrees 1 and up, stored channel by channel as in Inria's PLY. */
function readSh({ count, coefficients, shN }, bytes, start) {
  for (let i = 0; i < count; i++) {
    for (let k = 0; k < coefficients; k++) for (let c = 0; c < 3; c++) {
      shN[3 * (coefficients * i + k) + c] = bytes[start + 3 * coefficients * i + c * coefficients + k] * (8 / 255) - 4;
    }
  }
}

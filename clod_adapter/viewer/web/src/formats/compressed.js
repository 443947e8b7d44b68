// SuperSplat's .compressed.ply: chunks of 256 Gaussians with ranges, in which each has 16 bytes; bands of 8 bits.
import { SH_C0, blank, logit, smallestThree } from "./gaussians.js";

const ROWS = 256; // a chunk
const RANGES = ["x", "y", "z", "scale_x", "scale_y", "scale_z", "r", "g", "b"];

export const isCompressed = (header) =>
  header.elements.some(({ name, properties }) => name === "vertex" && properties.some((p) => p.name === "packed_position"));

export function readCompressed(bytes, header) {
  const element = (name) => header.elements.find((candidate) => candidate.name === name);
  const chunk = element("chunk"), vertex = element("vertex"), bands = element("sh");
  const starts = new Map();
  let end = header.length;
  for (const each of header.elements) {
    starts.set(each, end);
    end += each.count * each.size;
  }
  if (header.format !== "binary_little_endian" || !chunk || chunk.count * ROWS < vertex.count || (bands && bands.count !== vertex.count)) {
    throw new Error("it is no compressed PLY that this page knows; decompress it first: splat-transform IN.ply OUT.ply");
  }
  if (!(bytes.length >= end)) throw new Error("it is truncated; copy or export it again");
  const view = new DataView(bytes.buffer, bytes.byteOffset), at = ({ properties }, name) => properties.find((p) => p.name === name)?.offset;
  const degree = bands ? [0, 9, 24, 45].indexOf(bands.properties.length) : 0;
  const gaussians = { ...blank(vertex.count, Math.max(degree, 0)), comments: header.comments };

  /** `part` of 0 to 1 in the range that the chunk of row i gives for `name`, or itself where there is none. */
  const within = (i, name, part) => {
    const low = at(chunk, `min_${name}`), base = starts.get(chunk) + Math.floor(i / ROWS) * chunk.size;
    if (low === undefined) return part;
    return view.getFloat32(base + low, true) * (1 - part) + view.getFloat32(base + at(chunk, `max_${name}`), true) * part;
  };
  const places = ["position", "rotation", "scale", "color"].map((name) => at(vertex, `packed_${name}`));
  for (let i = 0; i < vertex.count; i++) {
    const [position, rotation, scale, color] = places.map((place) => view.getUint32(starts.get(vertex) + i * vertex.size + place, true));
    const parts = [...thirds(position), ...thirds(scale), color >>> 24, (color >>> 16) & 255, (color >>> 8) & 255];
    const values = parts.map((part, k) => within(i, RANGES[k], k < 6 ? part : part / 255));
    gaussians.means.set(values.slice(0, 3), 3 * i);
    gaussians.logScales.set(values.slice(3, 6), 3 * i);
    gaussians.sh0.set(values.slice(6).map((value) => (value - 0.5) / SH_C0), 3 * i);
    gaussians.opacityLogits[i] = logit((color & 255) / 255);
    const three = [20, 10, 0].map((shift) => (((rotation >>> shift) & 1023) / 1023 - 0.5) * Math.SQRT2);
    gaussians.quats.set(smallestThree(rotation >>> 30, three), 4 * i);
  }
  readBands(gaussians, bytes, bands && starts.get(bands));
  return gaussians;
}

/** 11, 10 and 11 bits as parts of 1. */
const thirds = (packed) => [(packed >>> 21) / 2047, ((packed >>> 11) & 1023) / 1023, (packed & 2047) / 2047];

/** Channel by channel in the file, as Inria's. */
function readBands({ count, coefficients, shN }, bytes, start) {
  for (let i = 0; i < count; i++) {
    for (let k = 0; k < coefficients; k++) for (let c = 0; c < 3; c++) {
      shN[3 * (coefficients * i + k) + c] = bytes[start + 3 * coefficients * i + c * coefficients + k] * (8 / 255) - 4;
    }
  }
}

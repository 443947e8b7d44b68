// Niantic's .spz, versions 2 and 3: gzip of one block per attribute and then vendor records, of which ours has the
// dial's columns (io/formats/spz.py). Axes are not converted: converters keep those of the PLY.
import { DIAL, allocate, described, logit, smallestThree } from "./gaussians.js";

const MAGIC = 0x5053474e, HEADER = 16;
const COLOR = 0.15; // colours are stored as 0.15 f_dc + 0.5
const ANTIALIASED = 1, EXTENDED = 2, RECORD = 0x434c0001; // flags: compensated opacities, vendor records; type of our record

export function readSpz(bytes) {
  const view = new DataView(bytes.buffer, bytes.byteOffset);
  if (bytes.length < HEADER || view.getUint32(0, true) !== MAGIC) throw new Error("it is gzip data but not .spz; open a .spz of version 2 or 3");
  const version = view.getUint32(4, true), count = view.getUint32(8, true), degree = bytes[12], unit = 2 ** -bytes[13];
  if (version < 2 || version > 3 || degree > 3) throw new Error(`it is .spz of version ${version} and SH degree ${degree}; export it as version 2 or 3 with degree 3 at most`);
  const quatSize = version === 3 ? 4 : 3, shSize = 3 * ((degree + 1) ** 2 - 1);
  const sizes = [9, 1, 3, 3, quatSize, shSize], starts = [HEADER];
  sizes.forEach((size) => starts.push(starts.at(-1) + size * count));
  if (bytes.length < starts[6]) throw new Error("it is truncated; copy or export it again");
  const gaussians = { ...allocate(count, degree), screenFilter: { variance: 0.3, compensate: (bytes[14] & ANTIALIASED) > 0 } };
  for (let i = 0; i < count; i++) {
    for (let k = 0; k < 3; k++) {
      const p = starts[0] + 9 * i + 3 * k, raw = bytes[p] | (bytes[p + 1] << 8) | (bytes[p + 2] << 16);
      gaussians.means[3 * i + k] = ((raw << 8) >> 8) * unit;
      gaussians.sh0[3 * i + k] = (bytes[starts[2] + 3 * i + k] / 255 - 0.5) / COLOR;
      gaussians.logScales[3 * i + k] = bytes[starts[3] + 3 * i + k] / 16 - 10;
    }
    gaussians.opacityLogits[i] = logit(bytes[starts[1] + i] / 255);
    const [w, x, y, z] = version === 3 ? quatOfBits(view.getUint32(starts[4] + 4 * i, true)) : quatOfBytes(bytes, starts[4] + 3 * i);
    gaussians.quats.set([w, x, y, z], 4 * i);
    for (let k = 0; k < shSize; k++) {
      gaussians.shN[shSize * i + k] = (bytes[starts[5] + shSize * i + k] - 128) / 128;
    }
  }
  return bytes[14] & EXTENDED ? readRecord(gaussians, bytes, view, starts[6]) : gaussians;
}

/** Adds the data of our record: the length of a JSON text, the text, its columns as float16. */
function readRecord(gaussians, bytes, view, at) {
  while (at + 8 <= bytes.length) {
    const type = view.getUint32(at, true), length = view.getUint32(at + 4, true), start = at + 12;
    at += 8 + length;
    if (type !== RECORD || at > bytes.length) continue;
    const end = start + view.getUint32(start - 4, true);
    const metadata = JSON.parse(new TextDecoder().decode(bytes.subarray(start, end)));
    const { columns = ["sigma_d"] } = metadata, { count } = gaussians, found = { ...gaussians, ...described(metadata, count) };
    if (at - end !== 2 * count * columns.length || !metadata.attenuation) return found;
    columns.forEach((name, k) => {
      const first = end + 2 * count * k, value = (_, i) => floatOfHalf(view.getUint16(first + 2 * i, true));
      found[DIAL[name]] = Float32Array.from({ length: count }, value);
    });
    return found;
  }
  return gaussians;
}

/** The value of a finite float16. */
function floatOfHalf(bits) {
  const exponent = (bits >> 10) & 31, fraction = (bits & 1023) / 1024;
  return (bits & 0x8000 ? -1 : 1) * (exponent ? 2 ** (exponent - 15) * (1 + fraction) : 2 ** -14 * fraction);
}

function quatOfBytes(bytes, at) {
  const [x, y, z] = [0, 1, 2].map((k) => bytes[at + k] / 127.5 - 1);
  return [Math.sqrt(Math.max(0, 1 - x * x - y * y - z * z)), x, y, z];
}

/** Two bits for the index of the largest of x, y, z, w; a sign and nine bits for each of the others. */
function quatOfBits(bits) {
  const three = [20, 10, 0].map((shift) => {
    const value = bits >>> shift, size = ((value & 511) / 511) * Math.SQRT1_2;
    return (value >>> 9) & 1 ? -size : size;
  });
  const [x, y, z, w] = smallestThree(bits >>> 30, three);
  return [w, x, y, z];
}

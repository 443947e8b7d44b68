// Niantic's .spz as Gaussians. Axes are not converted: converters keep those of the PLY.
import { layoutOf, readPositions, readRecord } from "../../../../../viewers/spz.js";
import { DIAL, allocate, described, logit, smallestThree } from "./gaussians.js";

const COLOR = 0.15; // colours are stored as 0.15 f_dc + 0.5
const ANTIALIASED = 1; // flag: compensated opacities

export function readSpz(bytes) {
  const layout = layoutOf(bytes), { view, version, count, degree, starts } = layout, shSize = 3 * ((degree + 1) ** 2 - 1);
  const gaussians = { ...allocate(count, degree), screenFilter: { variance: 0.3, compensate: (bytes[14] & ANTIALIASED) > 0 } };
  readPositions(bytes, layout, gaussians.means);
  for (let i = 0; i < count; i++) {
    for (let k = 0; k < 3; k++) {
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
  const record = readRecord(bytes, layout);
  if (!record) return gaussians;
  const dial = Object.entries(record.columns).map(([name, values]) => [DIAL[name], values]);
  return { ...gaussians, ...described(record.metadata, count), ...Object.fromEntries(dial) };
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

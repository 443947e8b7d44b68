// Niantic's .spz, versions 2 and 3, and our vendor record, which has the dial's columns (io/formats/spz.py).

const MAGIC = 0x5053474e, HEADER = 16;
const ANTIALIASED = 1, EXTENDED = 2, RECORD = 0x434c0001; // flags: compensated opacities, vendor records; type of our record
const COLOR = 0.15; // colours are 0.15 f_dc + 0.5

export async function readSpz(file) {
  const stream = new Blob([file]).stream().pipeThrough(new DecompressionStream("gzip"));
  const bytes = new Uint8Array(await new Response(stream).arrayBuffer()), view = new DataView(bytes.buffer);
  if (bytes.length < HEADER || view.getUint32(0, true) !== MAGIC) throw new Error("it is gzip data but not .spz");
  const version = view.getUint32(4, true), count = view.getUint32(8, true), degree = bytes[12], shSize = 3 * ((degree + 1) ** 2 - 1);
  if (version < 2 || version > 3 || degree > 3) throw new Error(`it is .spz of version ${version} and SH degree ${degree}, not of 2 or 3 and 3 at most`);
  const sizes = [9, 1, 3, 3, version === 3 ? 4 : 3, shSize], starts = [HEADER];
  sizes.forEach((size) => starts.push(starts.at(-1) + size * count));
  const [means, alphas, colours, scales, rotations, harmonics, end] = starts, unit = 2 ** -bytes[13];
  if (bytes.length < end) throw new Error("it is truncated; copy or export it again");
  const read = (stride, value) => new Float32Array(stride * count).map((_, k) => value(k));
  const quats = new Float32Array(4 * count);
  for (let i = 0; i < count; i++) quats.set(version === 3 ? quatOfBits(view.getUint32(rotations + 4 * i, true)) : quatOfBytes(bytes, rotations + 3 * i), 4 * i);
  const { metadata: { attenuation = null, screen_filter: screenFilter, calibration, about = [] } = {}, columns } = recordOf(bytes, view, count, end);
  return {
    count, degree, quats, sigmaD: columns.sigma_d ?? null, growthD: columns.growth_d ?? null, opacityD: columns.opacity_d, attenuation, about,
    means: read(3, (k) => {
      const at = means + 3 * k, raw = bytes[at] | (bytes[at + 1] << 8) | (bytes[at + 2] << 16);
      return ((raw << 8) >> 8) * unit; // 24-bit fixed point
    }),
    opacityLogits: read(1, (k) => Math.min(Math.max(Math.log(bytes[alphas + k] / (255 - bytes[alphas + k])), -40), 40)),
    sh0: read(3, (k) => (bytes[colours + k] / 255 - 0.5) / COLOR), logScales: read(3, (k) => bytes[scales + k] / 16 - 10),
    shN: read(shSize, (k) => (bytes[harmonics + k] - 128) / 128),
    screenFilter: screenFilter ?? { variance: 0.3, compensate: (bytes[14] & ANTIALIASED) > 0 },
    calibration: calibration?.total === count ? calibration.rows : [], against: calibration?.against ?? "photographs",
  };
}

/** Our record: {metadata, columns}, a Float32Array for each name; both empty without a record. */
function recordOf(bytes, view, count, first) {
  const columns = {}, word = (at) => view.getUint32(at, true);
  let at = bytes[14] & EXTENDED ? first : bytes.length;
  while (at + 8 <= bytes.length && word(at) !== RECORD) at += 8 + word(at + 4);
  if (at + 8 > bytes.length) return { columns };
  let start = at + 12 + word(at + 8);
  const metadata = JSON.parse(new TextDecoder().decode(bytes.subarray(at + 12, start)));
  for (const name of metadata.attenuation ? metadata.columns ?? ["sigma_d"] : []) {
    columns[name] = Float32Array.from({ length: count }, (_, i) => floatOfHalf(view.getUint16(start + 2 * i, true)));
    start += 2 * count;
  }
  return { metadata, columns };
}

/** The value of a finite float16. */
function floatOfHalf(bits) {
  const exponent = (bits >> 10) & 31, fraction = (bits & 1023) / 1024;
  return (bits & 0x8000 ? -1 : 1) * (exponent ? 2 ** (exponent - 15) * (1 + fraction) : 2 ** -14 * fraction);
}

/** x, y and z in bytes; w >= 0. */
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
  const largest = Math.sqrt(Math.max(0, 1 - three.reduce((sum, value) => sum + value * value, 0)));
  const at = bits >>> 30, [x, y, z, w] = [...three.slice(0, at), largest, ...three.slice(at)];
  return [w, x, y, z];
}

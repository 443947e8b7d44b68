// Niantic's .spz, versions 2 and 3, unzipped: where its arrays are, its positions, and our vendor record, which has the
// dial's columns (io/formats/spz.py).

const MAGIC = 0x5053474e, HEADER = 16;
const EXTENDED = 2, RECORD = 0x434c0001; // flag: vendor records; type of our record

export async function inflate(bytes) {
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

/** {view, version, count, degree, starts}: the offsets of positions, opacities, colours, scales, rotations, harmonics,
 *  and of what follows these arrays. */
export function layoutOf(bytes) {
  const view = new DataView(bytes.buffer, bytes.byteOffset);
  if (bytes.length < HEADER || view.getUint32(0, true) !== MAGIC) throw new Error("it is gzip data but not .spz; open a .spz of version 2 or 3");
  const version = view.getUint32(4, true), count = view.getUint32(8, true), degree = bytes[12];
  if (version < 2 || version > 3 || degree > 3) throw new Error(`it is .spz of version ${version} and SH degree ${degree}; export it as version 2 or 3 with degree 3 at most`);
  const sizes = [9, 1, 3, 3, version === 3 ? 4 : 3, 3 * ((degree + 1) ** 2 - 1)], starts = [HEADER];
  sizes.forEach((size) => starts.push(starts.at(-1) + size * count));
  if (bytes.length < starts[6]) throw new Error("it is truncated; copy or export it again");
  return { view, version, count, degree, starts };
}

/** Writes the positions, 24-bit fixed point, to `means`. */
export function readPositions(bytes, { count, starts: [first] }, means) {
  const unit = 2 ** -bytes[13];
  for (let k = 0; k < 3 * count; k++) {
    const at = first + 3 * k, raw = bytes[at] | (bytes[at + 1] << 8) | (bytes[at + 2] << 16);
    means[k] = ((raw << 8) >> 8) * unit;
  }
}

/** Our record: {metadata, columns}, a Float32Array for each name; no columns if it has no dial; null without a record. */
export function readRecord(bytes, { view, count, starts }) {
  let at = bytes[14] & EXTENDED ? starts[6] : bytes.length;
  while (at + 8 <= bytes.length) {
    const type = view.getUint32(at, true), length = view.getUint32(at + 4, true), start = at + 12;
    at += 8 + length;
    if (type !== RECORD || at > bytes.length) continue;
    const end = start + view.getUint32(start - 4, true);
    const metadata = JSON.parse(new TextDecoder().decode(bytes.subarray(start, end)));
    const { columns: names = ["sigma_d"] } = metadata, columns = {};
    if (at - end !== 2 * count * names.length || !metadata.attenuation) return { metadata, columns };
    names.forEach((name, k) => {
      const first = end + 2 * count * k, value = (_, i) => floatOfHalf(view.getUint16(first + 2 * i, true));
      columns[name] = Float32Array.from({ length: count }, value);
    });
    return { metadata, columns };
  }
  return null;
}

/** The value of a finite float16. */
function floatOfHalf(bits) {
  const exponent = (bits >> 10) & 31, fraction = (bits & 1023) / 1024;
  return (bits & 0x8000 ? -1 : 1) * (exponent ? 2 ** (exponent - 15) * (1 + fraction) : 2 ** -14 * fraction);
}

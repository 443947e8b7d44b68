// Float32 to float16, for the higher bands, which the GPU unpacks.

const float = new Float32Array(1), bits = new Uint32Array(float.buffer);

/** The 16 bits of the nearest half; beyond its range the largest. */
export function half(value) {
  float[0] = value;
  const x = bits[0], sign = (x >>> 16) & 0x8000, size = x & 0x7fffffff;
  if (size >= 0x477ff000) return sign | 0x7bff;
  if (size < 0x38800000) return sign | Math.round(Math.abs(value) * 2 ** 24); // subnormal
  return sign | ((size - 0x38000000 + 0x0fff + ((size >>> 13) & 1)) >>> 13);
}

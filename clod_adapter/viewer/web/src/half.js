// Float32 to float16, for the SH coefficients of degrees 1 and up, which the GPU unpacks.

const float = new Float32Array(1), bits = new Uint32Array(float.buffer);

/** Bits of the nearest float16; values beyond its range become the largest finite one. */
export function half(value) {
  float[0] = value;
  const x = bits[0], sign = (x >>> 16) & 0x8000, magnitude = x & 0x7fffffff;
  if (magnitude >= 0x477ff000) return sign | 0x7bff;
  if (magnitude < 0x38800000) return sign | Math.round(Math.abs(value) * 2 ** 24); // subnormal
  return sign | ((magnitude - 0x38000000 + 0x0fff + ((magnitude >>> 13) & 1)) >>> 13);
}

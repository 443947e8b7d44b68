// The dial of an adapted file, without a viewer: what the file says, and what turns it.
import { dialForCount, extinctionScales, growthDistance, prepare } from "./equation.js";
import { createHold } from "./frame_rate.js";
import { readSettings } from "./settings.js";

const SPZ_MAGIC = 0x5053474e, SPZ_HEADER = 16, SPZ_RECORD = 0x434c0001, SPZ_EXTENDED = 2; // clod_adapter/io/formats/spz.py
const PLY_SIZES = { char: 1, uchar: 1, int8: 1, uint8: 1, short: 2, ushort: 2, int16: 2, uint16: 2, int: 4, uint: 4, int32: 4, uint32: 4, float: 4, float32: 4, double: 8, float64: 8 };

/** Reads the dial of an adapted PLY or SPZ (bytes): {count, means, opacityLogits, sigma, growth, settings}. */
export async function readDial(bytes) {
  const data = new Uint8Array(bytes.buffer ?? bytes, bytes.byteOffset ?? 0, bytes.byteLength);
  if (data[0] === 0x1f && data[1] === 0x8b) {
    const stream = new Blob([data]).stream().pipeThrough(new DecompressionStream("gzip"));
    return ofSpz(new Uint8Array(await new Response(stream).arrayBuffer()));
  }
  return ofPly(data);
}

function ofPly(bytes) {
  const text = new TextDecoder("latin1").decode(bytes.subarray(0, 1 << 20)), end = text.indexOf("end_header\n");
  const lines = end < 0 ? [] : text.slice(0, end).split("\n"), offsets = {};
  if (lines[0] !== "ply" || !lines.includes("format binary_little_endian 1.0")) throw new Error("no binary PLY or SPZ; open what clod-adapt wrote");
  const count = Number(lines.find((line) => line.startsWith("element vertex "))?.slice(15));
  let size = 0;
  for (const [, type, name] of lines.map((line) => line.split(" ")).filter(([word]) => word === "property")) {
    offsets[name] = [size, type];
    size += PLY_SIZES[type];
  }
  const view = new DataView(bytes.buffer, bytes.byteOffset + end + 11);
  const column = (name, out = new Float32Array(count), stride = 1, at = 0) => {
    if (!(name in offsets)) return null;
    const [offset, type] = offsets[name], get = view[type === "double" ? "getFloat64" : "getFloat32"].bind(view);
    for (let i = 0; i < count; i++) out[stride * i + at] = get(size * i + offset, true);
    return out;
  };
  const means = new Float32Array(3 * count);
  ["x", "y", "z"].forEach((name, k) => column(name, means, 3, k));
  const comments = lines.filter((line) => line.startsWith("comment ")).map((line) => line.slice(8));
  return checked({ count, means, opacityLogits: column("opacity"), sigma: column("sigma_d"), growth: column("growth_d"), settings: readSettings(comments) });
}

function ofSpz(bytes) {
  const view = new DataView(bytes.buffer), count = view.getUint32(8, true), version = view.getUint32(4, true);
  if (view.getUint32(0, true) !== SPZ_MAGIC || !(bytes[14] & SPZ_EXTENDED)) throw new Error("this .spz has no dial; export it with clod-adapt");
  const means = new Float32Array(3 * count), opacityLogits = new Float32Array(count), unit = 2 ** -bytes[13];
  for (let i = 0; i < 3 * count; i++) {
    const at = SPZ_HEADER + 3 * i;
    means[i] = (((bytes[at] | (bytes[at + 1] << 8) | (bytes[at + 2] << 16)) << 8) >> 8) * unit;
  }
  for (let i = 0; i < count; i++) opacityLogits[i] = Math.log(bytes[SPZ_HEADER + 9 * count + i] / (255 - bytes[SPZ_HEADER + 9 * count + i]));
  const harmonics = 3 * ((bytes[12] + 1) ** 2 - 1);
  let at = SPZ_HEADER + count * (9 + 1 + 3 + 3 + (version === 3 ? 4 : 3) + harmonics);
  while (at + 8 <= bytes.length && view.getUint32(at, true) !== SPZ_RECORD) at += 8 + view.getUint32(at + 4, true);
  if (at + 12 > bytes.length) throw new Error("this .spz has no dial; export it with clod-adapt");
  const first = at + 12 + view.getUint32(at + 8, true), about = JSON.parse(new TextDecoder().decode(bytes.subarray(at + 12, first)));
  const names = about.columns ?? ["sigma_d"];
  const columns = names.map((_, k) => Float32Array.from({ length: count }, (_, i) => half(view.getUint16(first + 2 * (count * k + i), true))));
  const named = Object.fromEntries(names.map((name, k) => [name, columns[k]]));
  return checked({ count, means, opacityLogits, sigma: named.sigma_d, growth: named.growth_d, settings: about.attenuation });
}

/** The value of a finite float16. */
function half(bits) {
  const exponent = (bits >> 10) & 31, fraction = (bits & 1023) / 1024;
  return (bits & 0x8000 ? -1 : 1) * (exponent ? 2 ** (exponent - 15) * (1 + fraction) : 2 ** -14 * fraction);
}

/** `dial` if a viewer can show it: it has sigma_d, and distances whose unit does not depend on the view. */
export function checked(dial) {
  if (!dial.sigma) throw new Error("the file has no sigma_d, so no dial; adapt it with clod-adapt");
  if (dial.settings.normalizer !== "scene") throw new Error(`the normalizer ${dial.settings.normalizer} depends on the view; adapt with --normalizer scene`);
  return { ...dial, growth: dial.growth ?? new Float32Array(dial.count) };
}

/** The two columns of a Gaussian as texels of an RG32F texture. */
export function texels({ count, sigma, growth }, length) {
  const data = new Float32Array(length);
  for (let i = 0; i < count; i++) data.set([sigma[i], growth[i]], 2 * i);
  return data;
}

/** The equation's constants as arguments of the shaders, in a shader's own syntax. */
export function constants({ settings }) {
  const number = (value) => value.toExponential(8), distance = number(settings.scene_distance);
  return { eps: number(settings.eps), tau: number(settings.tau), soft: String(settings.cut === "soft"), distance, reach: number(growthDistance(settings)) };
}

/** Turns the dial of a model in a viewer. `eye()`: the camera in the file's coordinates; `show(s)`: draws with s;
 *  `timer.measure(draw, true)`: milliseconds of a frame's work. */
export class Dial {
  #hold = null;

  constructor(file, { eye, show, timer }) {
    Object.assign(this, { file, eye, show, timer, s: 1 });
    show(1);
  }

  /** s >= 0, where 0 shows everything; or {keep}: the smallest s in [1, max_sv] with at most so many Gaussians from here. */
  set(value) {
    this.#hold = null;
    this.#turn(typeof value === "number" ? value : dialForCount(this.#extinctions(), value.keep, this.file.settings.max_sv).dial);
  }

  /** The number of Gaussians that the dial keeps for the camera. */
  get kept() {
    const scales = this.#extinctions();
    return this.s === 0 ? scales.length : scales.findLastIndex((scale) => scale > this.s) + 1;
  }

  /** Follows the time of frames from now on, so that `fps` are drawn each second. */
  hold(fps) {
    this.#hold = createHold(fps);
  }

  /** Calls `draw()`, which draws a frame, and turns the dial if a frame rate is held. */
  async frame(draw) {
    const hold = this.#hold;
    if (!hold || hold.busy) return draw();
    hold.busy = true;
    const milliseconds = await this.timer.measure(draw, true);
    hold.busy = false;
    if (hold === this.#hold && milliseconds !== null) this.#turn(hold.took(this.s, milliseconds, this.file.settings.max_sv));
  }

  #turn(s) {
    if (!(s >= 0 && s < Infinity)) throw new RangeError(`the dial is a number from 0 on, not ${s}`);
    if (s !== this.s) this.show((this.s = s));
  }

  #extinctions() {
    const { means, opacityLogits, sigma, settings } = this.file;
    this.prepared ??= prepare(opacityLogits, sigma, settings.eps);
    return extinctionScales(means, this.prepared, this.eye(), settings.scene_distance, settings.tau);
  }
}

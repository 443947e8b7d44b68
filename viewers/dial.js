// The dial of an adapted file, without a viewer: what the file says, and what turns it.
import { countKept, dialForCount, growthDistance, prepare } from "./equation.js";
import { createHold } from "./frame_rate.js";
import { readGaussians } from "./read.js";

/** Reads the dial of an adapted PLY or SPZ (bytes): {count, means, opacityLogits, sigma, growth, settings}. */
export async function readDial(bytes) {
  const data = new Uint8Array(bytes.buffer ?? bytes, bytes.byteOffset ?? 0, bytes.byteLength);
  const { count, means, opacityLogits, sigmaD: sigma, growthD: growth, settings } = await readGaussians(data);
  return checked({ count, means, opacityLogits, sigma, growth, settings });
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
 *  `time(draw)`: milliseconds of a frame's work, or a promise of these. */
export class Dial {
  #hold = null;

  constructor(file, { eye, show, time }) {
    Object.assign(this, { file, eye, show, time, s: 1 });
    show(1);
  }

  // The public methods are described in types.d.ts.
  set(value) {
    this.#hold = null;
    this.#turn(typeof value === "number" ? value : dialForCount((s) => this.#count(s), value.keep, this.file.settings.max_sv).dial);
  }

  get kept() {
    return this.#count(this.s);
  }

  hold(fps) {
    this.#hold = createHold(fps);
  }

  async frame(draw) {
    const hold = this.#hold;
    if (!hold || hold.busy) return draw();
    hold.busy = true;
    const milliseconds = await this.time(draw);
    hold.busy = false;
    if (hold === this.#hold) this.#turn(hold.took(this.s, milliseconds, this.file.settings.max_sv));
  }

  #turn(s) {
    if (!(s >= 0 && s < Infinity)) throw new RangeError(`the dial is a number from 0 on, not ${s}`);
    if (s !== this.s) this.show((this.s = s));
  }

  #count(s) {
    const { means, opacityLogits, sigma, settings } = this.file;
    this.prepared ??= prepare(opacityLogits, sigma, settings.eps);
    return countKept(means, this.prepared, settings.tau, this.eye(), settings.scene_distance, s);
  }
}

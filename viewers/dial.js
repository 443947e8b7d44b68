// The dial of an adapted file, without a viewer: what the file says, and what turns it.
import { bandsOf, countKept, dialForCount, growthStart } from "./equation.js";
import { createHold } from "./frame_rate.js";
import { readGaussians } from "./read.js";

/** Reads the dial of an adapted PLY or SPZ (bytes): {count, means, logits, sigma, growth, settings}. */
export async function readDial(bytes) {
  const data = new Uint8Array(bytes.buffer ?? bytes, bytes.byteOffset ?? 0, bytes.byteLength);
  const { count, means, opacityLogits: logits, sigmaD: sigma, growthD: growth, settings } = await readGaussians(data);
  return checked({ count, means, logits, sigma, growth, settings });
}

/** `dial`, if it has a sigma_d. */
export function checked(dial) {
  if (!dial.sigma) throw new Error("the file has no sigma_d, so no dial; adapt it with clod-adapt");
  return { ...dial, growth: dial.growth ?? new Float32Array(dial.count) };
}

/** A Gaussian's columns as texels of an RGBA32F texture; of far ones, which the engine hides, the opacity as alpha. */
export function texels({ count, logits, sigma, growth, settings }, length) {
  const data = new Float32Array(length), both = settings.near_distance > 0;
  for (let i = 0; i < count; i++) {
    data.set([sigma[i], growth[i], 0, both && sigma[i] > 0 ? 1 / (1 + Math.exp(-logits[i])) : 0], 4 * i);
  }
  return data;
}

/** The equation's constants as arguments of the shaders, in a shader's own syntax. */
export function constants({ settings }) {
  const near = settings.near_distance / settings.scene_distance;
  return {
    distance: settings.scene_distance.toExponential(8), start: growthStart(settings).toExponential(8), near: near.toExponential(8),
  };
}

const attached = new WeakSet();

/** Marks the mesh or entity of a dial; refuses one that has a dial. */
export function claim(object) {
  if (attached.has(object)) throw new Error("it has a dial already; use what the first attach returned");
  attached.add(object);
}

/** Frees what `claim` marked, where attaching failed. */
export const release = (object) => attached.delete(object);

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
    const largest = this.file.settings.max_sv, keep = value?.keep;
    if (typeof value === "number" ? !(value >= 0 && value <= largest) : !(Number.isInteger(keep) && keep >= 0)) {
      const given = JSON.stringify(value) ?? value;
      throw new RangeError(`the dial is set to a number from 0 to ${largest} or to {keep: a number of Gaussians}, not to ${given}`);
    }
    this.#hold = null;
    this.#turn(typeof value === "number" ? value : dialForCount(this.#bands(), keep, largest));
  }

  get kept() {
    return countKept(this.#bands(), this.s);
  }

  hold(fps) {
    if (!(fps > 0 && fps < Infinity)) throw new RangeError(`a frame rate is a number above 0, not ${fps}`);
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
    if (s !== this.s) this.show((this.s = s));
  }

  #bands() {
    const { means, sigma, settings } = this.file;
    return bandsOf(means, sigma, this.eye(), settings);
  }
}

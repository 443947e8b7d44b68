/** What an adapted file says: [count, 3] means, columns [count], and the settings of the equation. */
export interface DialFile {
  count: number;
  means: Float32Array;
  /** Opacity logits; of far Gaussians their own, not the ones that hide them. */
  logits: Float32Array;
  sigma: Float32Array;
  growth: Float32Array;
  settings: { form: string; scene_distance: number; reference_distance: number; max_sv: number; near_distance: number };
}

/** Reads an adapted PLY (binary) or SPZ (versions 2 and 3). */
export function readDial(bytes: ArrayBuffer | Uint8Array): Promise<DialFile>;

export interface Dial {
  readonly file: DialFile;
  /** The dial value: 0 shows everything, 1 is full quality; trained up to `file.settings.max_sv`. */
  readonly s: number;
  /** The number of Gaussians that the dial keeps for the camera. */
  readonly kept: number;
  /** Turns the dial to a value from 0 to `file.settings.max_sv`, or to the smallest one from 1 on that keeps at most so
   *  many Gaussians from here. Throws a RangeError for anything else. */
  set(value: number | { keep: number }): void;
  /** Turns the dial with the time of whole frames, until `set` is called; so do all dials that hold a rate, together. */
  hold(fps: number): void;
  /** Calls `draw()` at once, and measures it while a frame rate is held; in Spark wrap your render call in it. */
  frame(draw: () => void): Promise<void>;
}

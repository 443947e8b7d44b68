// Reads what a browser gets: binary PLY and SPZ. Python converts every other format.
import { readSpz } from "./spz.js";

const DEFAULTS = { form: "ours", scene_distance: 1, reference_distance: 0, max_sv: 5, near_distance: 0 };
const EARLIER = ["tau", "eps", "cut", "normalizer", "hard_cut", "max"]; // of an earlier form of the dial
const TYPES = { // the other names are those of DataView, in lower case
  char: "Int8", uchar: "Uint8", short: "Int16", ushort: "Uint16", int: "Int32", uint: "Uint32", float: "Float32", double: "Float64",
};
const DEGREES = [0, 9, 24, 45, 72]; // f_rest columns by SH degree
const NEEDED = "x y z rot_0 rot_1 rot_2 rot_3 scale_0 scale_1 scale_2 f_dc_0 f_dc_1 f_dc_2 opacity".split(" ");
const NUMBER = String.raw`[-+]?(?:\d+\.?\d*|\.\d+)(?:e[-+]?\d+)?`; // of a vertical axis, as in viewer/page.py
const VERTICAL = new RegExp(String.raw`^\s*vertical axis:[\s\[]*([xyz]|${NUMBER}(?:[\s,]+${NUMBER}){2})[\s\]]*$`, "i");
const NAMED = { x: [1, 0, 0], y: [0, -1, 0], z: [0, 0, 1] }; // Brush's y points down
const VERTEX = /^element vertex (\d+)((?:\n(?:property|comment|obj_info) .*)*)/m;
const CONVERTED = /^property \w+ (packed_|masks_|filter_3D|f_anchor_feat)|^element \w+ [^]*^element vertex/m; // other layouts

/** The Gaussians of a file: values as in Inria's PLY, with shN [count, coefficients, 3]; sigmaD, growthD and settings or null. */
export async function readGaussians(bytes) {
  try {
    const magic = String.fromCharCode(...bytes.subarray(0, 3));
    if (magic === "ply") return revealed(readPly(bytes));
    if (magic.startsWith("\x1f\x8b")) {
      const { attenuation, about, ...read } = await readSpz(bytes);
      return revealed({ ...read, up: readUp(about), settings: attenuation && settingsOf(attenuation) });
    }
  } catch (error) {
    if (error.constructor === Error) throw error;
    throw new Error("it is damaged or too large for this browser; copy or export it again", { cause: error });
  }
  throw new Error(bytes.length ? "it is neither .ply nor .spz" : "it is empty");
}

/** With the opacities of far Gaussians, which the file hides from viewers without the dial. */
export function revealed({ opacityD, ...read }) {
  const { opacityLogits, sigmaD } = read;
  if (opacityD) sigmaD.forEach((sigma, i) => sigma > 0 && (opacityLogits[i] = opacityD[i]));
  return read;
}

/** By NAME the values of the columns clod_NAME, the same in all rows (io/ply_layout.py); `first(name)`: of the first row. */
export function constantsOf(names, first) {
  const ours = names.filter((name) => name.startsWith("clod_"));
  return Object.fromEntries(ours.map((name) => [name.slice(5), Math.fround(first(name))]));
}

/** The Gaussians of a binary PLY in Inria's layout, with columns of any order and type. */
function readPly(bytes) {
  const text = new TextDecoder("latin1").decode(bytes.subarray(0, 1 << 20)), end = /[\r\n]end_header(\r\n|\n|\r)/.exec(text);
  if (!end) throw new Error("the PLY header has no end_header line, so the file is truncated; copy or export it again");
  const header = text.slice(0, end.index).replaceAll(/\r\n?/g, "\n"), vertex = VERTEX.exec(header), start = end.index + end[0].length;
  if (!vertex || !/^format binary/m.test(header) || CONVERTED.test(header)) throw new Error("it is not a binary .ply in Inria's layout");
  const comments = [...header.matchAll(/^comment (.*)/gm)].map(([, comment]) => comment), count = Number(vertex[1]), columns = new Map();
  let size = 0; // of a row
  for (const [, word, name] of vertex[2].matchAll(/property (\w+) (\w+)/g)) {
    const type = TYPES[word] ?? word[0].toUpperCase() + word.slice(1);
    columns.set(name, { get: DataView.prototype[`get${type}`], offset: size });
    size += Number(/\d*$/.exec(type)) / 8 || NaN; // of a list, which has no size
  }
  const names = [...columns.keys()], missing = NEEDED.find((name) => !columns.has(name)), last = start + count * size;
  const degree = DEGREES.indexOf(names.filter((name) => name.startsWith("f_rest_")).length), terms = (degree + 1) ** 2 - 1;
  if (missing || degree < 0) throw new Error(missing ? `${missing} is missing` : "its f_rest columns are of no SH degree");
  if (!(bytes.length >= last)) throw new Error(`it is truncated: its header describes ${last} bytes and it has ${bytes.length}; copy or export it again`);
  const isLittle = header.includes("binary_little_endian"), view = new DataView(bytes.buffer, bytes.byteOffset + start);
  const read = (...picked) => {
    const values = new Float32Array(picked.length * count);
    for (const [k, { get, offset }] of picked.map((name) => columns.get(name)).entries()) {
      for (let i = 0; i < count; i++) values[picked.length * i + k] = get.call(view, i * size + offset, isLittle);
    }
    return values;
  };
  const numbered = (stem, length) => read(...Array.from({ length }, (_, k) => `${stem}_${k}`));
  const rest = Array.from({ length: 3 * terms }, (_, k) => `f_rest_${(k % 3) * terms + Math.floor(k / 3)}`); // stored by channel
  const hasDial = columns.has("sigma_d"), constants = hasDial ? constantsOf(names, (name) => read(name)[0]) : {};
  return {
    count, degree, means: read("x", "y", "z"), quats: numbered("rot", 4), logScales: numbered("scale", 3),
    opacityLogits: read("opacity"), sh0: numbered("f_dc", 3), shN: read(...rest), sigmaD: hasDial ? read("sigma_d") : null,
    opacityD: hasDial && columns.has("opacity_d") ? read("opacity_d") : null,
    growthD: hasDial && columns.has("growth_d") ? read("growth_d") : null, settings: hasDial ? readSettings(comments, constants) : null,
    up: readUp(comments), screenFilter: readScreenFilter(comments, constants, hasDial), ...readCalibration(comments, count),
  };
}

/** The dial's settings from the comments (io/ply_layout.py), else from `constants` (constantsOf), else defaults. */
export const readSettings = (comments, constants = {}) =>
  settingsOf({ ...constants, ...(constants.paper && { form: "paper" }), ...Object.fromEntries(entries(comments)) });

/** The dial's settings from those that are stored, numbers perhaps as text. */
function settingsOf(stored) {
  const isEarlier = EARLIER.some((name) => name in stored);
  if (isEarlier) throw new Error("its dial is of an earlier form; adapt its checkpoint again");
  const settings = { ...DEFAULTS };
  for (const [name, usual] of Object.entries(DEFAULTS)) {
    if (name in stored) settings[name] = typeof usual === "number" ? Number(stored[name]) : stored[name];
  }
  if (settings.form === "ours") return settings;
  throw new Error("its dial is of the paper's form, which viewers do not draw; adapt it without --form paper");
}

/** The vertical axis that the last comment of nerfstudio or Brush states, of length 1; null without one. */
function readUp(comments) {
  const stated = comments.map((comment) => VERTICAL.exec(comment)?.[1].toLowerCase()).filter(Boolean);
  const axes = stated.map((text) => NAMED[text] ?? text.split(/[\s,]+/).map(Number));
  const axis = axes.findLast((numbers) => Math.hypot(...numbers) > 0 && Math.hypot(...numbers) < Infinity);
  return axis ? axis.map((value) => value / Math.hypot(...axis)) : null;
}

/** The screen-space filter from comments, ours or another program's, or from columns; as in io/settings.py. */
function readScreenFilter(comments, { screen_variance: width, compensate: compensated }, hasDial) {
  const written = entries(comments).findLast(([name]) => name === "screen_filter")?.[1];
  if (written) {
    const [variance, compensate] = written.split(" ");
    return { variance: Number(variance), compensate: compensate === "True" };
  }
  if (width || compensated) return { variance: width ?? 0.3, compensate: Boolean(compensated) };
  // A dial was trained with the default filter, unless the file names another.
  const compensate = !hasDial && comments.some((comment) => /^\s*(splatrendermode:\s*mip|antialiased 1)\s*$/i.test(comment));
  return { variance: compensate && comments.includes("Exported from Brush") ? 0.1 : 0.3, compensate };
}

/** calibration: rows {virtual_scale, psnr}, none without a table, or if the number of Gaussians is not the table's;
 *  against: what the PSNR is against. */
function readCalibration(comments, total) {
  const words = (wanted) => entries(comments).filter(([name]) => name === wanted).map(([, value]) => value.split(" "));
  const [counted, , , , against = "photographs"] = words("calibrated_with")[0] ?? [];
  const rows = Number(counted) === total ? words("calibrated") : [];
  return { calibration: rows.map(([virtual_scale, , psnr]) => ({ virtual_scale: Number(virtual_scale), psnr: Number(psnr) })), against };
}

/** [name, value] of each of our comments. */
const entries = (comments) =>
  comments.map((comment) => /^clod_adapter +(\S+)\s+(.*\S)/.exec(comment)).filter(Boolean).map(([, name, value]) => [name, value]);

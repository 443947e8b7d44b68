// Reads what the page gets: PLY and SPZ, from its server or itself, or dropped on it. Python converts all else.
import { binaryColumns, constantsOf, readHeader } from "../../../../viewers/ply.js";
import { readCalibration, readScreenFilter, readSettings } from "../../../../viewers/settings.js";
import { inflate, layoutOf, readPositions, readRecord } from "../../../../viewers/spz.js";

const DIAL = { sigma_d: "sigmaD", growth_d: "growthD" }; // columns of a file, and the arrays with their values
const DEGREES = [0, 9, 24, 45, 72]; // f_rest columns by SH degree
const NEEDED = ["x", "y", "z", "opacity", ..."0123".split("").map((k) => `rot_${k}`), ..."012".split("").flatMap((k) => [`scale_${k}`, `f_dc_${k}`])];
const CONVERTED = /^(packed_|masks_|filter_3D|f_anchor_feat)/; // columns that mean another layout
const PART = 2 ** 30; // bytes
const SHORTEST = 1e-15, LONGEST = 1e15; // quaternion (clod_adapter/_kernels)
const COLOR = 0.15, ANTIALIASED = 1; // of SPZ: colours are 0.15 f_dc + 0.5; flag of compensated opacities

/** The bytes of a file, in parts: of 2 GB and more, Chromium gives a script none at once. */
async function bytesOf(blob) {
  if (blob.size <= PART) return new Uint8Array(await blob.arrayBuffer());
  const bytes = new Uint8Array(blob.size);
  for (let at = 0; at < blob.size; at += PART) bytes.set(new Uint8Array(await blob.slice(at, at + PART).arrayBuffer()), at);
  return bytes;
}

/** {gaussians, metadata} of a file, a Blob; the values are as in Inria's PLY, shN is [count, coefficients, 3]. */
export async function readFile(blob, name) {
  const unreadable = () => { throw new Error("the browser cannot read it: it is a folder or too large"); };
  const bytes = await bytesOf(blob).catch(unreadable), magic = String.fromCharCode(...bytes.subarray(0, 3));
  const refuse = (what) => { throw new Error(`${what}; clod-adapt view ${name} opens it if it is a splat`); };
  let read = null;
  try {
    if (magic === "ply") read = readPly(bytes, refuse);
    else if (magic.startsWith("\x1f\x8b")) read = readSpz(await inflate(bytes));
  } catch (error) {
    if (error.constructor === Error) throw error;
    throw new Error("it is damaged or too large for this browser; copy or export it again", { cause: error });
  }
  if (!read) refuse(bytes.length ? "this page reads .ply and .spz" : "it is empty");
  const [gaussians, notes] = usable(read), hasDial = gaussians.sigmaD !== null;
  const settings = hasDial ? gaussians.settings ?? readSettings(gaussians.comments, gaussians.constants) : null;
  return {
    gaussians,
    metadata: {
      name, notes, attenuation: settings, max_sv: settings?.max_sv ?? 1,
      screen_filter: gaussians.screenFilter ?? readScreenFilter(gaussians, hasDial),
      no_dial: hasDial ? null : `${name} has no sigma_d, so it has no dial; add one: clod-adapt ${name} --images SCENE`,
      calibration: gaussians.calibration ?? readCalibration(gaussians.comments, gaussians.count),
    },
  };
}

function allocate(count, degree) {
  const coefficients = (degree + 1) ** 2 - 1;
  return {
    count, degree, coefficients, sigmaD: null, growthD: null, comments: [],
    means: new Float32Array(3 * count), quats: new Float32Array(4 * count), logScales: new Float32Array(3 * count),
    opacityLogits: new Float32Array(count), sh0: new Float32Array(3 * count), shN: new Float32Array(3 * coefficients * count),
  };
}

function readPly(bytes, refuse) {
  const header = readHeader(bytes), vertex = header.elements.find(({ name }) => name === "vertex");
  const names = new Set(vertex?.properties.map(({ name }) => name)), missing = NEEDED.filter((name) => !names.has(name));
  const degree = DEGREES.indexOf([...names].filter((name) => /^f_rest_\d+$/.test(name)).length);
  if (header.format === "ascii" || [...names].some((name) => CONVERTED.test(name))) refuse("this page reads binary .ply in Inria's layout");
  if (missing.length || degree < 0) refuse(missing.length ? `${missing[0]} is missing` : "its f_rest columns are of no SH degree");
  const gaussians = { ...allocate(vertex.count, degree), comments: header.comments }, terms = gaussians.coefficients;
  const columns = binaryColumns(bytes, header, vertex);
  const read = (target, stride, offset, name) => columns(name, (i, value) => { target[stride * i + offset] = value; });
  ["x", "y", "z"].forEach((name, k) => read(gaussians.means, 3, k, name));
  for (let k = 0; k < 4; k++) read(gaussians.quats, 4, k, `rot_${k}`);
  for (let k = 0; k < 3; k++) read(gaussians.logScales, 3, k, `scale_${k}`);
  for (let k = 0; k < 3; k++) read(gaussians.sh0, 3, k, `f_dc_${k}`);
  read(gaussians.opacityLogits, 1, 0, "opacity");
  for (let k = 0; k < terms; k++) for (let c = 0; c < 3; c++) read(gaussians.shN, 3 * terms, 3 * k + c, `f_rest_${c * terms + k}`);
  if (!names.has("sigma_d")) return gaussians;
  for (const name of Object.keys(DIAL).filter((each) => names.has(each))) {
    gaussians[DIAL[name]] = new Float32Array(vertex.count);
    read(gaussians[DIAL[name]], 1, 0, name);
  }
  return { ...gaussians, constants: constantsOf(vertex, columns) };
}

/** Axes are not converted: converters keep those of the PLY. */
function readSpz(bytes) {
  const layout = layoutOf(bytes), { view, version, count, degree, starts } = layout, shSize = 3 * ((degree + 1) ** 2 - 1);
  const gaussians = { ...allocate(count, degree), screenFilter: { variance: 0.3, compensate: (bytes[14] & ANTIALIASED) > 0 }, calibration: [] };
  readPositions(bytes, layout, gaussians.means);
  for (let i = 0; i < count; i++) {
    for (let k = 0; k < 3; k++) {
      gaussians.sh0[3 * i + k] = (bytes[starts[2] + 3 * i + k] / 255 - 0.5) / COLOR;
      gaussians.logScales[3 * i + k] = bytes[starts[3] + 3 * i + k] / 16 - 10;
    }
    const opacity = bytes[starts[1] + i] / 255;
    gaussians.opacityLogits[i] = Math.min(Math.max(Math.log(opacity) - Math.log1p(-opacity), -40), 40);
    gaussians.quats.set(version === 3 ? quatOfBits(view.getUint32(starts[4] + 4 * i, true)) : quatOfBytes(bytes, starts[4] + 3 * i), 4 * i);
    for (let k = 0; k < shSize; k++) gaussians.shN[shSize * i + k] = (bytes[starts[5] + shSize * i + k] - 128) / 128;
  }
  const record = readRecord(bytes, layout);
  if (!record) return gaussians;
  const { attenuation: settings, screen_filter: screenFilter = gaussians.screenFilter, calibration } = record.metadata;
  for (const [name, values] of Object.entries(record.columns)) gaussians[DIAL[name]] = values;
  return { ...gaussians, settings, screenFilter, calibration: calibration?.total === count ? calibration.rows : [] };
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

/** Without the rows that cannot be drawn, with a value that is not finite or a rotation too short or long; and the notes. */
function usable(all) {
  const { count, quats, opacityLogits } = all, good = new Uint8Array(count).fill(1);
  const columns = Object.entries(all).filter(([, values]) => values instanceof Float32Array);
  for (const [, values] of columns.filter(([each]) => each !== "opacityLogits")) {
    const width = values.length / count;
    for (let i = 0, at = 0; i < count; i++) for (let k = 0; k < width; k++) if (!Number.isFinite(values[at++])) good[i] = 0;
  }
  for (let i = 0; i < count; i++) {
    const norm = Math.hypot(quats[4 * i], quats[4 * i + 1], quats[4 * i + 2], quats[4 * i + 3]);
    if (!(norm >= SHORTEST && norm <= LONGEST && opacityLogits[i] > -Infinity)) good[i] = 0;
  }
  const rows = [...good.keys()].filter((i) => good[i]);
  if (!rows.length) throw new Error("no Gaussian in it can be drawn: values are not finite or rotations are 0; export it again");
  if (rows.length === count) return [all, []];
  return [select(all, rows), [`${count - rows.length} of ${count} Gaussians cannot be drawn and were removed`]];
}

/** These rows of Gaussians. */
export function select(gaussians, rows) {
  const picked = Object.entries(gaussians).map(([name, values]) => {
    if (!(values instanceof Float32Array)) return [name, values];
    const width = values.length / gaussians.count, found = new Float32Array(width * rows.length);
    rows.forEach((row, i) => { for (let k = 0; k < width; k++) found[width * i + k] = values[width * row + k]; });
    return [name, found];
  });
  return { ...Object.fromEntries(picked), count: rows.length };
}

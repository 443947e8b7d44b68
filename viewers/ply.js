// Binary PLY in Inria's layout, with columns of any order and type.
import { readCalibration, readScreenFilter, readSettings } from "./settings.js";

const TYPES = {
  char: ["Int8", 1], uchar: ["Uint8", 1], short: ["Int16", 2], ushort: ["Uint16", 2], int: ["Int32", 4], uint: ["Uint32", 4],
  int8: ["Int8", 1], uint8: ["Uint8", 1], int16: ["Int16", 2], uint16: ["Uint16", 2], int32: ["Int32", 4], uint32: ["Uint32", 4],
  float: ["Float32", 4], float32: ["Float32", 4], double: ["Float64", 8], float64: ["Float64", 8],
};
const HEADER_LIMIT = 1 << 20;
const DEGREES = [0, 9, 24, 45, 72]; // f_rest columns by SH degree
const NEEDED = "x y z rot_0 rot_1 rot_2 rot_3 scale_0 scale_1 scale_2 f_dc_0 f_dc_1 f_dc_2 opacity".split(" ");
const CONVERTED = /^(packed_|masks_|filter_3D|f_anchor_feat)/; // columns that mean another layout

/** The header: {elements: [{name, count, properties: [{name, type, size, offset}], size}], format, comments, length}. */
function readHeader(bytes) {
  const text = new TextDecoder("latin1").decode(bytes.subarray(0, HEADER_LIMIT));
  const end = /[\r\n]end_header(\r\n|\n|\r)/.exec(text);
  if (!end) throw new Error("the PLY header has no end_header line, so the file is truncated; copy or export it again");
  const header = { elements: [], comments: [], format: "", length: end.index + end[0].length };
  for (const line of text.slice(0, end.index).split(/\r\n|\n|\r/).slice(1)) {
    const [kind, word, name] = line.trim().split(/\s+/), last = header.elements.at(-1);
    if (kind === "comment") header.comments.push(line.replace(/^\s*comment ?/, ""));
    else if (kind === "format") header.format = word;
    else if (kind === "element" && /^\d+$/.test(name)) header.elements.push({ name: word, count: Number(name), properties: [], size: 0 });
    else if (kind === "property" && last && (TYPES[word] || word === "list")) {
      const [type, size] = TYPES[word] ?? ["list", NaN];
      last.properties.push({ name, type, size, offset: last.size });
      last.size += size;
    } else if (kind !== "obj_info" && line.trim()) throw new Error(`the PLY header is damaged ("${line.slice(0, 40)}"); export the file again`);
  }
  return header;
}

/** The value of each clod_* column, which is the same in all rows (io/ply/constants.py). */
export function constantsOf({ properties }, columns) {
  const found = {};
  for (const { name } of properties.filter((property) => property.name.startsWith("clod_"))) {
    columns(name, (i, value) => {
      const rounded = Math.fround(value);
      if (i && rounded !== found[name]) throw new Error(`property ${name} must have the same value in all rows; export the file again`);
      found[name] = rounded;
    });
  }
  return found;
}

/** The function that calls `each(i, value)` for the rows of a column. */
function columnsOf(bytes, header, vertex) {
  const before = header.elements.slice(0, header.elements.indexOf(vertex));
  const start = before.reduce((at, { count, size }) => at + count * size, header.length), size = start + vertex.count * vertex.size;
  if (Number.isNaN(size)) throw new Error("it has a list property, which splats do not have; export the file again");
  if (bytes.length < size) throw new Error(`it is truncated: its header describes ${size} bytes and it has ${bytes.length}; copy or export it again`);
  const little = header.format === "binary_little_endian", view = new DataView(bytes.buffer, bytes.byteOffset + start);
  return (name, each) => {
    const { type, offset } = vertex.properties.find((property) => property.name === name);
    const get = DataView.prototype[`get${type}`];
    for (let i = 0, at = offset; i < vertex.count; i++, at += vertex.size) each(i, get.call(view, at, little));
  };
}

/** The Gaussians of a file, as in read.js. */
export function readPly(bytes) {
  const header = readHeader(bytes), vertex = header.elements.find(({ name }) => name === "vertex"), { count = 0, properties = [] } = vertex ?? {};
  const names = new Set(properties.map(({ name }) => name)), missing = NEEDED.find((name) => !names.has(name));
  const degree = DEGREES.indexOf([...names].filter((name) => /^f_rest_\d+$/.test(name)).length), terms = (degree + 1) ** 2 - 1;
  if (header.format === "ascii" || [...names].some((name) => CONVERTED.test(name))) throw new Error("it is not a binary .ply in Inria's layout");
  if (missing || degree < 0) throw new Error(missing ? `${missing} is missing` : "its f_rest columns are of no SH degree");
  const columns = columnsOf(bytes, header, vertex);
  const read = (columnNames) => {
    const stride = columnNames.length, values = new Float32Array(stride * count);
    columnNames.forEach((name, k) => columns(name, (i, value) => { values[stride * i + k] = value; }));
    return values;
  };
  const numbered = (stem, length) => Array.from({ length }, (_, k) => `${stem}_${k}`), optional = (name) => (names.has(name) ? read([name]) : null);
  const rest = Array.from({ length: 3 * terms }, (_, k) => `f_rest_${(k % 3) * terms + Math.floor(k / 3)}`); // stored by channel
  const sigmaD = optional("sigma_d"), constants = sigmaD ? constantsOf(vertex, columns) : {};
  return {
    count, degree, sigmaD, growthD: sigmaD && optional("growth_d"), means: read(["x", "y", "z"]), quats: read(numbered("rot", 4)),
    logScales: read(numbered("scale", 3)), opacityLogits: read(["opacity"]), sh0: read(numbered("f_dc", 3)), shN: read(rest),
    settings: sigmaD && readSettings(header.comments, constants), screenFilter: readScreenFilter(header.comments, constants, sigmaD !== null),
    calibration: readCalibration(header.comments, count),
  };
}

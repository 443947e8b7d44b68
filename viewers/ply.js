// PLY: the header, and the columns of a binary file.
const TYPES = {
  char: ["Int8", 1], int8: ["Int8", 1], uchar: ["Uint8", 1], uint8: ["Uint8", 1], short: ["Int16", 2], int16: ["Int16", 2],
  ushort: ["Uint16", 2], uint16: ["Uint16", 2], int: ["Int32", 4], int32: ["Int32", 4], uint: ["Uint32", 4],
  uint32: ["Uint32", 4], float: ["Float32", 4], float32: ["Float32", 4], double: ["Float64", 8], float64: ["Float64", 8],
};
const HEADER_LIMIT = 1 << 20;

/** The header: {elements: [{name, count, properties: [{name, type, size, offset}], size}], format, comments, length}. */
export function readHeader(bytes) {
  const text = new TextDecoder("latin1").decode(bytes.subarray(0, HEADER_LIMIT));
  const end = /[\r\n]end_header(\r\n|\n|\r)/.exec(text);
  if (!end) throw new Error("the PLY header has no end_header line, so the file is truncated; copy or export it again");
  const header = { elements: [], comments: [], format: "", length: end.index + end[0].length };
  for (const line of text.slice(0, end.index).split(/\r\n|\n|\r/).slice(1)) {
    const words = line.trim().split(/\s+/), last = header.elements.at(-1);
    if (words[0] === "comment") header.comments.push(line.replace(/^\s*comment ?/, ""));
    else if (words[0] === "format") header.format = words[1];
    else if (words[0] === "element" && /^\d+$/.test(words[2])) {
      header.elements.push({ name: words[1], count: Number(words[2]), properties: [], size: 0 });
    } else if (words[0] === "property" && last && words[1] === "list") {
      last.properties.push({ name: words.at(-1), type: "list" });
      last.size = NaN;
    } else if (words[0] === "property" && last && TYPES[words[1]]) {
      const [type, size] = TYPES[words[1]];
      last.properties.push({ name: words[2], type, size, offset: last.size });
      last.size += size;
    } else if (words[0] !== "obj_info" && line.trim()) {
      throw new Error(`the PLY header is damaged ("${line.slice(0, 40)}"); export the file again`);
    }
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
export function binaryColumns(bytes, header, vertex) {
  let start = header.length;
  for (const element of header.elements) {
    if (element === vertex) break;
    start += element.count * element.size;
  }
  if (Number.isNaN(start + vertex.size)) throw new Error("it has a list property, which splats do not have; export the file again");
  const size = start + vertex.count * vertex.size;
  if (bytes.length < size) {
    throw new Error(`it is truncated: its header describes ${size} bytes and it has ${bytes.length}; copy or export it again`);
  }
  const little = header.format === "binary_little_endian", view = new DataView(bytes.buffer, bytes.byteOffset + start);
  return (name, each) => {
    const { type, offset } = vertex.properties.find((property) => property.name === name);
    const get = DataView.prototype[`get${type}`];
    for (let i = 0, at = offset; i < vertex.count; i++, at += vertex.size) each(i, get.call(view, at, little));
  };
}

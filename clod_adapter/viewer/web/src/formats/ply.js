// PLY: plain Gaussians with columns of any order and type, ascii or binary (io/ply).
import { binaryColumns, constantsOf } from "../../../../../viewers/ply.js";
import { DIAL, allocate } from "./gaussians.js";

const UNSUPPORTED = [
  [/^f_(offset|anchor_feat)_\d+$/, "this is a Scaffold-GS or Octree-GS file, which stores anchors, not Gaussians; export Gaussians from that program"],
];
/** Gaussians with or without a dial. */
export function readPly(bytes, header) {
  const vertex = header.elements.find((element) => element.name === "vertex");
  if (!vertex) throw new Error("it has no vertex element; open a splat in Inria's 3DGS layout");
  const degree = degreeOf(vertex);
  const columns = header.format === "ascii" ? asciiColumns(bytes, header, vertex) : binaryColumns(bytes, header, vertex);
  const gaussians = { ...allocate(vertex.count, degree), comments: header.comments };
  const read = (target, stride, offset, name) => columns(name, (i, value) => { target[stride * i + offset] = value; });
  ["x", "y", "z"].forEach((name, k) => read(gaussians.means, 3, k, name));
  for (let k = 0; k < 4; k++) read(gaussians.quats, 4, k, `rot_${k}`);
  for (let k = 0; k < 3; k++) read(gaussians.logScales, 3, k, `scale_${k}`);
  for (let k = 0; k < 3; k++) read(gaussians.sh0, 3, k, `f_dc_${k}`);
  read(gaussians.opacityLogits, 1, 0, "opacity");
  const terms = gaussians.coefficients; // of a channel
  for (let k = 0; k < terms; k++) for (let c = 0; c < 3; c++) read(gaussians.shN, 3 * terms, 3 * k + c, `f_rest_${c * terms + k}`);
  const has = (name) => vertex.properties.some((property) => property.name === name);
  if (has("sigma_d")) {
    for (const name of Object.keys(DIAL).filter(has)) {
      gaussians[DIAL[name]] = new Float32Array(vertex.count);
      read(gaussians[DIAL[name]], 1, 0, name);
    }
    gaussians.constants = constantsOf(vertex, columns);
  }
  if (has("masks_0") && has("masks_1")) readMasks(gaussians, read);
  return has("filter_3D") ? fuseFilter(gaussians, read) : gaussians;
}

/** Marks the rows that MaskGaussian leaves out, existence probability sigmoid(masks_0 - masks_1) < 0.5 (io/ply/rows.py). */
function readMasks(gaussians, read) {
  const masks = new Float32Array(2 * gaussians.count);
  for (let k = 0; k < 2; k++) read(masks, 2, k, `masks_${k}`);
  // 0: left out; NaN: a mask is not finite
  gaussians.exists = Float32Array.from({ length: gaussians.count }, (_, i) => {
    const [there, absent] = [masks[2 * i], masks[2 * i + 1]];
    return there < absent ? 0 : Number.isFinite(there) && Number.isFinite(absent) ? 1 : NaN;
  });
}

/** Applies Mip-Splatting's filter f: scales sqrt(s^2 + f^2), opacity a sqrt(det(s^2) / det(s^2 + f^2)) (io/ply/values.py). */
function fuseFilter(gaussians, read) {
  const { count, logScales, opacityLogits } = gaussians, filter = new Float32Array(count);
  read(filter, 1, 0, "filter_3D");
  for (let i = 0; i < count; i++) {
    const size = 2 * Math.log(Math.abs(filter[i]));
    let shrink = 0;
    for (let k = 3 * i; k < 3 * i + 3; k++) {
      const scale = 2 * logScales[k], high = Math.max(scale, size);
      const wider = high === -Infinity || Number.isNaN(high) ? high : 0.5 * (high + Math.log1p(Math.exp(Math.min(scale, size) - high)));
      shrink += logScales[k] - wider;
      logScales[k] = wider;
    }
    if (shrink === 0) continue; // unfiltered
    const logit = opacityLogits[i], logOpacity = shrink - Math.max(-logit, 0) - Math.log1p(Math.exp(-Math.abs(logit)));
    opacityLogits[i] = logOpacity < 0 ? logOpacity - Math.log(-Math.expm1(logOpacity)) : Infinity;
  }
  return {
    ...gaussians, impliedFilter: { variance: 0.1, compensate: true },
    notes: [...gaussians.notes, "Mip-Splatting's filter_3D is fused into scale and opacity"],
  };
}

function degreeOf({ properties }) {
  const names = new Set(properties.map((property) => property.name));
  for (const [pattern, what] of UNSUPPORTED) if ([...names].some((name) => pattern.test(name))) throw new Error(what);
  if (!names.has("f_dc_0") && !names.has("scale_0")) {
    throw new Error("f_dc_0 and scale_0 are missing, so this is a mesh or a point cloud; open a trained splat");
  }
  if (names.has("scale_0") && !names.has("scale_2")) throw new Error("scale_2 is missing, so this is a 2DGS file of flat disks; open a 3DGS file");
  const rest = [...names].filter((name) => /^f_rest_\d+$/.test(name)).length;
  const degree = [0, 9, 24, 45, 72].indexOf(rest);
  if (degree < 0) throw new Error(`${rest} f_rest_* properties match no SH degree; export the file again`);
  for (const name of ["x", "y", "z", "opacity", "rot_0", "rot_1", "rot_2", "rot_3", "scale_1", "f_dc_1", "f_dc_2"]) {
    if (!names.has(name)) throw new Error(`property ${name} is missing; export the file again in Inria's 3DGS layout`);
  }
  return degree;
}

function asciiColumns(bytes, header, vertex) {
  const lines = new TextDecoder("latin1").decode(bytes.subarray(header.length)).split(/\r\n|\n|\r/);
  let first = 0;
  for (const element of header.elements) {
    if (element === vertex) break;
    first += element.count;
  }
  const rows = lines.slice(first, first + vertex.count).map((line) => line.trim().split(/\s+/).map(Number));
  if (rows.length < vertex.count || rows.some((row) => row.length !== vertex.properties.length)) {
    throw new Error("it is truncated or damaged; copy or export it again");
  }
  return (name, each) => {
    const k = vertex.properties.findIndex((property) => property.name === name);
    rows.forEach((row, i) => each(i, row[k]));
  };
}

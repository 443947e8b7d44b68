// glTF binary files with KHR_gaussian_splatting, and _SIGMA_D and _GROWTH_D where there is a dial (io/formats/glb_reader.py).
import { DIAL, allocate, described } from "./gaussians.js";

const EXTENSION = "KHR_gaussian_splatting", JSON_CHUNK = 0x4e4f534a, BINARY_CHUNK = 0x004e4942;
const KINDS = { 5120: ["Int8", 1, 127], 5121: ["Uint8", 1, 255], 5122: ["Int16", 2, 32767], 5123: ["Uint16", 2, 65535], 5126: ["Float32", 4, 1] };
const WIDTHS = { SCALAR: 1, VEC3: 3, VEC4: 4 };
const FAINTEST = -100; // logit of an opacity that float32 has rounded to 0
const coefficient = (degree, index) => `${EXTENSION}:SH_DEGREE_${degree}_COEF_${index}`;

export function readGlb(bytes) {
  const { gltf, binary } = chunks(bytes), primitive = find(gltf), { attributes } = primitive;
  const read = (name, target, stride, offset) => readAccessor(gltf, binary, attributes[name], target, stride, offset);
  let degree = 0;
  while (degree < 3 && coefficient(degree + 1, 0) in attributes) degree++;
  const gaussians = allocate(gltf.accessors[attributes.POSITION].count, degree), { count, quats, opacityLogits, logScales } = gaussians;
  read("POSITION", gaussians.means, 3, 0);
  read(`${EXTENSION}:ROTATION`, quats, 4, 0);
  for (let i = 0; i < count; i++) quats.set([quats[4 * i + 3], ...quats.subarray(4 * i, 4 * i + 3)], 4 * i); // xyzw to wxyz
  read(`${EXTENSION}:SCALE`, logScales, 3, 0);
  logScales.forEach((scale, k) => { logScales[k] = Math.log(Math.max(scale, 2 ** -126)); });
  read(`${EXTENSION}:OPACITY`, opacityLogits, 1, 0);
  opacityLogits.forEach((opacity, i) => { opacityLogits[i] = opacity >= 1 ? Infinity : opacity > 0 ? Math.max(Math.log(opacity) - Math.log1p(-opacity), FAINTEST) : FAINTEST; });
  read(coefficient(0, 0), gaussians.sh0, 3, 0);
  for (let l = 1; l <= degree; l++) {
    for (let m = 0; m < 2 * l + 1; m++) read(coefficient(l, m), gaussians.shN, 3 * gaussians.coefficients, 3 * (l * l - 1 + m));
  }
  for (const [name, attribute] of [["sigma_d", "_SIGMA_D"], ["growth_d", "_GROWTH_D"]]) {
    if (!(attribute in attributes) || !("_SIGMA_D" in attributes)) continue;
    gaussians[DIAL[name]] = new Float32Array(count);
    read(attribute, gaussians[DIAL[name]], 1, 0);
  }
  return { ...gaussians, up: upOf(gltf), ...described(gltf.asset?.extras?.clod_adapter, count) };
}

function chunks(bytes) {
  const view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength), length = view.getUint32(8, true), found = {};
  if (view.getUint32(4, true) !== 2) throw new Error("it is not glTF 2.0; export it again");
  for (let at = 12; at + 8 <= length;) {
    const size = view.getUint32(at, true), end = at + 8 + size;
    if (end > bytes.length) throw new Error("it is truncated; copy or export it again");
    found[view.getUint32(at + 4, true)] ??= bytes.subarray(at + 8, end);
    at = end;
  }
  if (!found[JSON_CHUNK]) throw new Error("it has no JSON chunk; export it again");
  return { gltf: JSON.parse(new TextDecoder().decode(found[JSON_CHUNK])), binary: found[BINARY_CHUNK] ?? new Uint8Array() };
}

function find({ meshes = [] }) {
  const primitive = meshes.flatMap((mesh) => mesh.primitives).find(({ extensions }) => extensions?.[EXTENSION]);
  if (!primitive) throw new Error(`it has no Gaussians (${EXTENSION}), so it is a mesh; open a trained splat`);
  const needed = ["POSITION", ...["ROTATION", "SCALE", "OPACITY"].map((name) => `${EXTENSION}:${name}`), coefficient(0, 0)];
  if (primitive.extensions[EXTENSION].extensions || needed.some((name) => !(name in primitive.attributes))) {
    throw new Error("its Gaussians are compressed or have no spherical harmonics; export it as .ply");
  }
  return primitive;
}

/** Writes an accessor's vectors to target[stride i + offset ..]. */
function readAccessor(gltf, binary, number, target, stride, offset) {
  const accessor = gltf.accessors[number], view = gltf.bufferViews[accessor.bufferView], [kind, size, largest] = KINDS[accessor.componentType];
  const width = WIDTHS[accessor.type], step = view.byteStride ?? size * width, start = (view.byteOffset ?? 0) + (accessor.byteOffset ?? 0);
  if (gltf.buffers[0].uri || accessor.sparse || view.extensions) throw new Error("its data are compressed or in another file; export it as .ply");
  if (start + (accessor.count - 1) * step + size * width > binary.length) throw new Error("it is truncated; copy or export it again");
  const data = new DataView(binary.buffer, binary.byteOffset), get = DataView.prototype[`get${kind}`], unit = accessor.normalized ? 1 / largest : 1;
  for (let i = 0; i < accessor.count; i++) for (let k = 0; k < width; k++) {
    target[stride * i + offset + k] = Math.max(unit * get.call(data, start + i * step + k * size, true), accessor.normalized ? -1 : -Infinity);
  }
}

/** glTF's y axis is up; a half turn about z in the node, as in our files, puts the values' y axis down. */
function upOf({ nodes = [] }) {
  const [, , z = 0] = nodes.find((node) => node.mesh !== undefined)?.rotation ?? [];
  return [0, Math.abs(z) > 0.5 ? -1 : 1, 0];
}

// Culling and depth sort of a model (sorter.js). `cull` writes a key for each Gaussian; four passes of a stable radix
// sort, 8 bits each, follow, of the kernels histogram, scan and scatter. The first pass leaves out the Gaussians with key 0.
const LANES = 256u;  // invocations of a workgroup, and values of a digit
const ROUNDS = 16u;  // keys of an invocation
const KEPT = 20u;    // place of the count of kept Gaussians in `tally`

struct Frame {
  right: vec3f, dial: f32, down: vec3f, eps: f32, forward: vec3f, near: f32,  // world to camera, OpenCV axes
  eye: vec3f, distance_unit: f32,
  focal: vec2f, shift: vec2f, border: vec2f, extent: vec2f,  // of frustum.js
  tau: f32, reach: f32, count: u32, attenuated: u32,
  marks: u32, frustum: u32,  // marks: culled Gaussians are sorted too; frustum: without those outside the picture
}

@group(0) @binding(0) var<uniform> frame: Frame;
@group(0) @binding(1) var<storage, read> gaussians: array<vec4f>;  // mean, opacity; largest scale, sigma_d, growth_d, 0
@group(0) @binding(2) var<storage, read_write> keys: array<u32>;
// Four words for each pass and for the result: workgroups in x, y, z; number of keys. Then the count of kept Gaussians.
@group(0) @binding(3) var<storage, read_write> tally: array<atomic<u32>>;

var<workgroup> kept: atomic<u32>;

@compute @workgroup_size(LANES)
fn cull(@builtin(global_invocation_id) id: vec3u, @builtin(local_invocation_index) lane: u32) {
  if (id.x < frame.count) { keys[id.x] = keyOf(id.x); }
  workgroupBarrier();
  if (lane == 0u) { atomicAdd(&tally[KEPT], atomicLoad(&kept)); }
}

/// Ascending keys have descending depths, since positive floats have the order of their bits; 0 is not drawn.
fn keyOf(row: u32) -> u32 {
  let mean = gaussians[2u * row];
  let shape = gaussians[2u * row + 1u];
  let ray = mean.xyz - frame.eye;
  var scale = shape.x;
  var culled = false;
  if (frame.attenuated != 0u) {
    let distance = length(ray) / frame.distance_unit;
    culled = clodOpacity(mean.w, shape.y, distance, frame.dial, frame.eps, frame.tau, false) == 0.0;
    if (!culled) { scale *= clodScale(shape.z, distance, frame.dial, frame.reach); }
  }
  if (!culled) { atomicAdd(&kept, 1u); }
  else if (frame.marks == 0u) { return 0u; }
  let point = vec3f(dot(frame.right, ray), dot(frame.down, ray), dot(frame.forward, ray));
  if (!(point.z >= frame.near) || (frame.frustum != 0u && outside(point, scale))) { return 0u; }
  return ~bitcast<u32>(point.z);
}

/// Whether a Gaussian of at most this scale has no pixel in the picture and its margin (frustum.js).
fn outside(point: vec3f, scale: f32) -> bool {
  return any(abs(frame.focal * point.xy + frame.shift * point.z) > frame.border * point.z + frame.extent * scale);
}

@group(0) @binding(3) var<storage, read> sizes: array<u32>;  // `tally`
@group(0) @binding(4) var<uniform> pass_index: u32;
@group(0) @binding(5) var<storage, read> fromKeys: array<u32>;
@group(0) @binding(6) var<storage, read> fromRows: array<u32>;
@group(0) @binding(7) var<storage, read_write> toKeys: array<u32>;
@group(0) @binding(8) var<storage, read_write> toRows: array<u32>;
// By workgroup and digit: the number of keys, then the place of the first one.
@group(0) @binding(9) var<storage, read_write> places: array<u32>;

fn digitOf(key: u32) -> u32 { return (key >> (8u * pass_index)) & 255u; }

var<workgroup> bins: array<atomic<u32>, LANES>;

@compute @workgroup_size(LANES)
fn histogram(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) lane: u32) {
  let count = sizes[4u * pass_index + 3u];
  for (var round = 0u; round < ROUNDS; round++) {
    let at = (group.x * ROUNDS + round) * LANES + lane;
    if (at < count && fromKeys[at] != 0u) { atomicAdd(&bins[digitOf(fromKeys[at])], 1u); }
  }
  workgroupBarrier();
  places[group.x * LANES + lane] = atomicLoad(&bins[lane]);
}

var<workgroup> sums: array<u32, LANES>;

/// One workgroup, an invocation for each digit. Writes the size of the next pass too.
@compute @workgroup_size(LANES)
fn scan(@builtin(local_invocation_index) lane: u32) {
  let end = atomicLoad(&tally[4u * pass_index]) * LANES;
  var sum = 0u;
  for (var at = lane; at < end; at += LANES) { sum += places[at]; }
  sums[lane] = sum;
  for (var step = 1u; step < LANES; step *= 2u) {
    workgroupBarrier();
    var before = 0u;
    if (lane >= step) { before = sums[lane - step]; }
    workgroupBarrier();
    sums[lane] += before;
  }
  var place = sums[lane] - sum;
  for (var at = lane; at < end; at += LANES) {
    let count = places[at];
    places[at] = place;
    place += count;
  }
  if (lane == LANES - 1u) {
    let next = 4u * (pass_index + 1u);
    atomicStore(&tally[next], (place + ROUNDS * LANES - 1u) / (ROUNDS * LANES));
    atomicStore(&tally[next + 3u], place);
  }
}

var<workgroup> starts: array<u32, LANES>;
var<workgroup> owners: array<atomic<u32>, 8 * LANES>;  // a bit for each invocation, eight words for each digit

@compute @workgroup_size(LANES)
fn scatter(@builtin(workgroup_id) group: vec3u, @builtin(local_invocation_index) lane: u32) {
  let count = sizes[4u * pass_index + 3u];
  starts[lane] = places[group.x * LANES + lane];
  for (var round = 0u; round < ROUNDS; round++) {
    workgroupBarrier();
    let at = (group.x * ROUNDS + round) * LANES + lane;
    var key = 0u;
    if (at < count) { key = fromKeys[at]; }
    let digit = digitOf(key);
    let word = lane / 32u;
    let bit = 1u << (lane % 32u);
    if (key != 0u) { atomicOr(&owners[word * LANES + digit], bit); }
    workgroupBarrier();
    if (key != 0u) {
      var place = starts[digit] + countOneBits(atomicLoad(&owners[word * LANES + digit]) & (bit - 1u));
      for (var w = 0u; w < word; w++) { place += countOneBits(atomicLoad(&owners[w * LANES + digit])); }
      toKeys[place] = key;
      if (pass_index == 0u) { toRows[place] = at; } else { toRows[place] = fromRows[at]; }
    }
    workgroupBarrier();
    for (var w = 0u; w < 8u; w++) { starts[lane] += countOneBits(atomicExchange(&owners[w * LANES + lane], 0u)); }
  }
}

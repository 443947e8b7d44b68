// The dial's settings and the calibration table in a PLY's header comments (io/ply_header.py), and settings in columns of
// one value (io/ply_constants.py).

const PREFIX = "clod_adapter ";
const DEFAULTS = {
  tau: 0.02, cut: "soft", eps: 1e-8, normalizer: "scene", quantile: 0.95, scene_distance: 1, reference_distance: 0, max_sv: 5,
};
const BEFORE = { tau: 1 / 255, cut: "hard" }; // what was the default when comments could leave a setting out (io/silence.py)
const CHECKS = {
  tau: (v) => v > 0 && v < 1, cut: (v) => v === "hard" || v === "soft", eps: (v) => v >= 0 && v < 1,
  normalizer: (v) => ["scene", "quantile", "max"].includes(v), quantile: (v) => v > 0 && v <= 1,
  scene_distance: (v) => v > 0 && v < Infinity, reference_distance: (v) => v >= 0 && v < Infinity, max_sv: (v) => v >= 1 && v < Infinity,
};

/** The settings in the comments, else in `constants` (a file's clod_* columns), else defaults; checked as AttenuationConfig does. */
export function readSettings(comments, constants = {}) {
  const said = entries(comments), stored = ofColumns(constants);
  for (const [name, value] of said) {
    if (name in DEFAULTS) stored[name] = typeof DEFAULTS[name] === "number" ? Number(value) : value;
  }
  for (const [name, value] of Object.entries(stored)) {
    if (!CHECKS[name](value)) throw new Error(`a clod_adapter header comment or column is unusable (${name} ${value})`);
  }
  return { ...DEFAULTS, ...(said.length ? BEFORE : {}), ...stored };
}

function ofColumns({ clod_tau, clod_eps, clod_hard_cut, clod_quantile, clod_max }) {
  const found = {};
  if (clod_tau !== undefined) found.tau = simplest(clod_tau);
  if (clod_eps !== undefined) found.eps = simplest(clod_eps);
  if (clod_hard_cut) found.cut = "hard";
  if (clod_quantile !== undefined) Object.assign(found, { normalizer: "quantile", quantile: simplest(clod_quantile) });
  if (clod_max) found.normalizer = "max";
  return found;
}

/** The shortest decimal that float32 rounds to `value`; where that has more than six digits, 1/n if that is one. */
function simplest(value) {
  for (let digits = 1; digits <= 9; digits++) {
    const decimal = Number(value.toPrecision(digits));
    if (Math.fround(decimal) !== value) continue;
    const fraction = 1 / Math.round(1 / decimal);
    return digits > 6 && Math.fround(fraction) === value ? fraction : decimal;
  }
  return value;
}

/** The screen-space filter of the comments, ours or other programs', as io/screen_filter.py has it. */
export function readScreenFilter(comments, dialled, { clod_screen_variance, clod_compensate } = {}) {
  const said = entries(comments).findLast(([name]) => name === "screen_filter")?.[1];
  if (said) {
    const [, variance, compensate] = /^(\S+) (True|False)$/.exec(said) ?? [];
    if (!(variance >= 1e-3 && variance <= 100)) throw new Error(`a clod_adapter header comment is unusable (screen_filter ${said})`);
    return { variance: Number(variance), compensate: compensate === "True" };
  }
  if (clod_screen_variance !== undefined || clod_compensate) {
    return { variance: clod_screen_variance === undefined ? 0.3 : simplest(clod_screen_variance), compensate: Boolean(clod_compensate) };
  }
  // What a dial was tuned with, where nothing says, is the usual one.
  const compensate = !dialled && comments.some((comment) => /^\s*(splatrendermode:\s*mip|antialiased 1)\s*$/i.test(comment));
  return { variance: compensate && comments.includes("Exported from Brush") ? 0.1 : 0.3, compensate };
}

/** Rows {virtual_scale, count, psnr}; empty where there are none or they are of other Gaussians. */
export function readCalibration(comments, total) {
  const found = entries(comments);
  const extent = found.find(([name]) => name === "calibrated_with");
  if (!extent || Number(extent[1].split(" ")[0]) !== total) return [];
  return found
    .filter(([name]) => name === "calibrated")
    .map(([, value]) => value.split(/\s+/).map(Number))
    .map(([virtual_scale, count, psnr]) => ({ virtual_scale, count, psnr }));
}

function entries(comments) {
  const ours = comments.filter((comment) => comment.startsWith(PREFIX)).map((comment) => comment.slice(PREFIX.length));
  return ours.map((text) => /^(\S+)\s+(.*)$/.exec(text.trim())).filter(Boolean).map((match) => [match[1], match[2].trim()]);
}

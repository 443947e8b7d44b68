// The dial's settings and the calibration table, from a PLY's header comments (io/ply/header.py) or, for the settings, from
// constant columns (io/ply/constants.py).

const PREFIX = "clod_adapter ";
const DEFAULTS = {
  tau: 0.02, cut: "soft", eps: 1e-8, normalizer: "scene", quantile: 0.95, scene_distance: 1, reference_distance: 0, max_sv: 5,
};
const FORMER = { tau: 1 / 255, cut: "hard" }; // defaults when comments could omit a setting (io/settings.py)
const CHECKS = {
  tau: (v) => v > 0 && v < 1, cut: (v) => v === "hard" || v === "soft", eps: (v) => v >= 0 && v < 1,
  normalizer: (v) => ["scene", "quantile", "max"].includes(v), quantile: (v) => v > 0 && v <= 1,
  scene_distance: (v) => v > 0 && v < Infinity, reference_distance: (v) => v >= 0 && v < Infinity, max_sv: (v) => v >= 1 && v < Infinity,
};

/** Settings from the comments, else from `constants` (clod_* columns), else defaults; with AttenuationConfig's checks. */
export function readSettings(comments, constants = {}) {
  const written = entries(comments), stored = ofColumns(constants);
  for (const [name, value] of written) {
    if (name in DEFAULTS) stored[name] = typeof DEFAULTS[name] === "number" ? Number(value) : value;
  }
  for (const [name, value] of Object.entries(stored)) {
    if (!CHECKS[name](value)) throw new Error(`a clod_adapter header comment or column is invalid (${name} ${value}); export the file again`);
  }
  return { ...DEFAULTS, ...(written.length ? FORMER : {}), ...stored };
}

/** Of the columns, whose names have the prefix clod_. */
function ofColumns(constants) {
  const found = {};
  for (const name of ["tau", "eps", "quantile", "reference_distance"]) if (`clod_${name}` in constants) found[name] = constants[`clod_${name}`];
  if (constants.clod_hard_cut) found.cut = "hard";
  if (constants.clod_max || "quantile" in found) found.normalizer = constants.clod_max ? "max" : "quantile";
  return found;
}

/** The screen-space filter from comments, ours or another program's, or from columns; as in io/screen_filter.py. */
export function readScreenFilter(comments, { clod_screen_variance, clod_compensate }, hasDial) {
  const written = entries(comments).findLast(([name]) => name === "screen_filter")?.[1];
  if (written) {
    const [, variance, compensate] = /^(\S+) (True|False)$/.exec(written) ?? [];
    if (!(variance >= 1e-3 && variance <= 100)) throw new Error(`a clod_adapter header comment is invalid (screen_filter ${written}); export the file again`);
    return { variance: Number(variance), compensate: compensate === "True" };
  }
  if (clod_screen_variance !== undefined || clod_compensate) {
    return { variance: clod_screen_variance ?? 0.3, compensate: Boolean(clod_compensate) };
  }
  // A dial was trained with the default filter, unless the file names another.
  const compensate = !hasDial && comments.some((comment) => /^\s*(splatrendermode:\s*mip|antialiased 1)\s*$/i.test(comment));
  return { variance: compensate && comments.includes("Exported from Brush") ? 0.1 : 0.3, compensate };
}

/** Rows {virtual_scale, psnr}; none without a table, or if the number of Gaussians is not the table's. */
export function readCalibration(comments, total) {
  const found = entries(comments), extent = found.find(([name]) => name === "calibrated_with");
  if (!extent || Number(extent[1].split(" ")[0]) !== total) return [];
  const rows = found.filter(([name]) => name === "calibrated").map(([, value]) => value.split(/\s+/).map(Number));
  return rows.map(([virtual_scale, , psnr]) => ({ virtual_scale, psnr }));
}

function entries(comments) {
  const texts = comments.filter((comment) => comment.startsWith(PREFIX)).map((comment) => comment.slice(PREFIX.length));
  return texts.map((text) => /^(\S+)\s+(.*)$/.exec(text.trim())).filter(Boolean).map((match) => [match[1], match[2].trim()]);
}

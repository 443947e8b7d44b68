// The dial's settings and the calibration table in a PLY's header comments (io/ply_header.py).

const PREFIX = "clod_adapter ";
const DEFAULTS = {
  tau: 1 / 255, cut: "hard", eps: 1e-8, normalizer: "scene", quantile: 0.95, scene_distance: 1, max_sv: 5,
};
const CHECKS = {
  tau: (v) => v > 0 && v < 1, cut: (v) => v === "hard" || v === "soft", eps: (v) => v >= 0 && v < 1,
  normalizer: (v) => ["scene", "quantile", "max"].includes(v), quantile: (v) => v > 0 && v <= 1,
  scene_distance: (v) => v > 0 && v < Infinity, max_sv: (v) => v >= 1 && v < Infinity,
};

/** The settings, defaults where the comments are silent, as AttenuationConfig checks them. */
export function readSettings(comments) {
  const settings = { ...DEFAULTS };
  for (const [name, value] of entries(comments)) {
    if (!(name in DEFAULTS)) continue;
    settings[name] = typeof DEFAULTS[name] === "number" ? Number(value) : value;
    if (!CHECKS[name](settings[name])) throw new Error(`a clod_adapter header comment is unusable (${name} ${value})`);
  }
  return settings;
}

/** The screen-space filter of the comments, ours or other programs', as io/screen_filter.py has it. */
export function readScreenFilter(comments, dialled) {
  const said = entries(comments).findLast(([name]) => name === "screen_filter")?.[1];
  if (said) {
    const [, variance, compensate] = /^(\S+) (True|False)$/.exec(said) ?? [];
    if (!(variance >= 1e-3 && variance <= 100)) throw new Error(`a clod_adapter header comment is unusable (screen_filter ${said})`);
    return { variance: Number(variance), compensate: compensate === "True" };
  }
  // What a dial was tuned with, where the file does not say, is the usual one.
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

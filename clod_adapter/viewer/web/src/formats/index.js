// Which reader a file needs, by its first bytes, and what the page is told about it.
import { usable } from "./gaussians.js";
import { readHeader, readPly } from "./ply.js";
import { readCalibration, readSettings } from "./settings.js";

const NO_SIGMA = "This file has no sigma_d, so the dial has nothing to work with. Adapt it first: clod-adapt";

/** {gaussians, about}: what a dropped file holds, and its settings as the page's configuration would give them. */
export async function readFile(buffer, name) {
  const gaussians = usable(await readGaussians(new Uint8Array(buffer), name));
  const dialled = gaussians.sigma !== null;
  const settings = dialled ? readSettings(gaussians.comments) : null;
  return {
    gaussians,
    about: {
      name, attenuation: settings, max_sv: settings?.max_sv ?? 1, notes: gaussians.notes,
      no_dial: dialled ? null : `${NO_SIGMA} ${name}`,
      calibration: readCalibration(gaussians.comments, gaussians.count),
    },
  };
}

async function readGaussians(bytes, name) {
  const magic = String.fromCharCode(...bytes.subarray(0, 4));
  if (/^ply[\r\n]/.test(magic)) {
    const header = readHeader(bytes);
    return readPly(bytes, header);
  }
  throw new Error(bytes.length ? "it is no splat that this page reads (.ply)" : "it is empty");
}

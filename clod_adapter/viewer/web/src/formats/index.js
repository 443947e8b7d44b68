// Which reader a file needs, by its first bytes, and what the page is told about it.
import { isCompressed, readCompressed } from "./compressed.js";
import { usable } from "./gaussians.js";
import { readHeader, readPly } from "./ply.js";
import { readCalibration, readScreenFilter, readSettings } from "./settings.js";
import { readSog } from "./sog.js";
import { readSplat } from "./splat.js";
import { readSpz } from "./spz.js";
import { unpacked } from "./zip.js";

const noDial = (name) => `${name} has no sigma_d, so there is no dial to turn; give it one: clod-adapt ${name} --images SCENE`;

/** {gaussians, about}: what a dropped file holds, and its settings as the page's configuration would give them. */
export async function readFile(buffer, name) {
  const gaussians = usable(await readGaussians(new Uint8Array(buffer), name).catch(said));
  const dialled = gaussians.sigma !== null;
  const settings = dialled ? gaussians.settings ?? readSettings(gaussians.comments, gaussians.constants) : null;
  return {
    gaussians,
    about: {
      name, attenuation: settings, screen_filter: gaussians.screenFilter ?? readScreenFilter(gaussians.comments, dialled, gaussians.constants),
      max_sv: settings?.max_sv ?? 1, notes: gaussians.notes,
      no_dial: dialled ? null : noDial(name),
      calibration: readCalibration(gaussians.comments, gaussians.count),
    },
  };
}

/** The readers' own words; what the browser says of bytes that lead nowhere is of no use. */
function said(error) {
  if (error.constructor === Error) throw error;
  throw new Error("it is damaged, or too large for this browser; copy or export it again", { cause: error });
}

async function readGaussians(bytes, name) {
  if (!bytes.length) throw new Error("it is empty; copy or export it again");
  const magic = String.fromCharCode(...bytes.subarray(0, 4));
  if (/^ply[\r\n]/.test(magic)) {
    const header = readHeader(bytes);
    return isCompressed(header) ? readCompressed(bytes, header) : readPly(bytes, header);
  }
  if (magic.startsWith("\x1f\x8b")) return readSpz(await unpacked(bytes, "gzip"));
  if (magic === "NGSP") throw new Error("it is .spz of version 4, which this page does not read; write version 3, or a .ply");
  if (magic.startsWith("PK")) return readSog(bytes);
  if (/\.splat$/i.test(name) && bytes.length % 32 === 0) return readSplat(bytes); // which has no mark of its own
  throw new Error("it is no splat that this page reads (.ply, .compressed.ply, .sog, .spz, .splat)");
}

// Selects the reader of a file by its first bytes, and collects its metadata.
import { isCompressed, readCompressed } from "./compressed.js";
import { removeInvalid } from "./gaussians.js";
import { readGlb } from "./glb.js";
import { readHeader } from "../../../../../viewers/ply.js";
import { readPly } from "./ply.js";
import { readCalibration, readScreenFilter, readSettings } from "../../../../../viewers/settings.js";
import { readSog } from "./sog.js";
import { readSplat } from "./splat.js";
import { readSpz } from "./spz.js";
import { inflate } from "./zip.js";

const noDial = (name) => `${name} has no sigma_d, so it has no dial; add one: clod-adapt ${name} --images SCENE`;

/** {gaussians, metadata} of a file, an ArrayBuffer or bytes. `prefix`: these are the first bytes of a PLY; the Gaussians
 *  are those of its complete rows. */
export async function readFile(data, name, prefix = false) {
  const bytes = data instanceof Uint8Array ? data : new Uint8Array(data);
  const gaussians = removeInvalid(await readGaussians(bytes, name, prefix).catch(rethrow));
  const hasDial = gaussians.sigmaD !== null;
  const settings = hasDial ? gaussians.settings ?? readSettings(gaussians.comments, gaussians.constants) : null;
  return {
    gaussians,
    metadata: {
      name, attenuation: settings, screen_filter: gaussians.screenFilter ?? readScreenFilter(gaussians, hasDial),
      max_sv: settings?.max_sv ?? 1, notes: gaussians.notes,
      no_dial: hasDial ? null : noDial(name),
      calibration: gaussians.calibration ?? readCalibration(gaussians.comments, gaussians.count),
    },
  };
}

/** Keeps the readers' errors, and replaces the browser's, such as a RangeError for damaged bytes. */
function rethrow(error) {
  if (error.constructor === Error) throw error;
  throw new Error("it is damaged or too large for this browser; copy or export it again", { cause: error });
}

async function readGaussians(bytes, name, prefix) {
  if (!bytes.length) throw new Error("it is empty; copy or export it again");
  const magic = String.fromCharCode(...bytes.subarray(0, 4));
  if (/^ply[\r\n]/.test(magic)) {
    const header = readHeader(bytes, prefix);
    return isCompressed(header) ? readCompressed(bytes, header) : readPly(bytes, header);
  }
  if (magic.startsWith("\x1f\x8b")) return readSpz(await inflate(bytes, "gzip"));
  if (magic === "NGSP") throw new Error("it is .spz of version 4, which this page does not read; export it as version 3 or as .ply");
  if (magic === "glTF") return readGlb(bytes);
  if (magic.startsWith("PK")) return readSog(bytes);
  if (/\.splat$/i.test(name) && bytes.length % 32 === 0) return readSplat(bytes); // .splat has no magic number
  throw new Error("it is not a splat in a format that this page reads; open a .ply, .compressed.ply, .sog, .spz, .glb or .splat file");
}

// Reads what a browser gets: binary PLY and SPZ. Python converts every other format.
import { readPly } from "./ply.js";
import { readSpz } from "./spz.js";

/** The Gaussians of a file's bytes: values as in Inria's PLY, with shN [count, coefficients, 3]; sigmaD and growthD, null where
 *  absent; settings of the dial, screenFilter and calibration. */
export async function readGaussians(bytes) {
  try {
    const magic = String.fromCharCode(...bytes.subarray(0, 3));
    if (magic === "ply") return readPly(bytes);
    if (magic.startsWith("\x1f\x8b")) return await readSpz(bytes);
  } catch (error) {
    if (error.constructor === Error) throw error;
    throw new Error("it is damaged or too large for this browser; copy or export it again", { cause: error });
  }
  throw new Error(bytes.length ? "it is neither .ply nor .spz" : "it is empty");
}

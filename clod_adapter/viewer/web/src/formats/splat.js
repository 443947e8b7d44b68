// .splat, of antimatter15's viewer: 32 bytes per Gaussian, SH degree 0.
import { SH_C0, allocate, logit } from "./gaussians.js";

const ROW = 32;

export function readSplat(bytes) {
  const count = bytes.length / ROW, gaussians = allocate(count, 0);
  const view = new DataView(bytes.buffer, bytes.byteOffset);
  for (let i = 0, at = 0; i < count; i++, at += ROW) {
    for (let k = 0; k < 3; k++) {
      gaussians.means[3 * i + k] = view.getFloat32(at + 4 * k, true);
      gaussians.logScales[3 * i + k] = Math.log(Math.max(view.getFloat32(at + 12 + 4 * k, true), 2 ** -126));
      gaussians.sh0[3 * i + k] = (bytes[at + 24 + k] / 255 - 0.5) / SH_C0;
    }
    gaussians.opacityLogits[i] = logit(bytes[at + 27] / 255);
    for (let k = 0; k < 4; k++) gaussians.quats[4 * i + k] = (bytes[at + 28 + k] - 128) / 128;
  }
  return gaussians;
}

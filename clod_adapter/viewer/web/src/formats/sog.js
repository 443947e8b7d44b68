// PlayCanvas's .sog: a ZIP of WebP images, one pixel per Gaussian, and meta.json. Reading keeps the order of rows, so
// that the dial's columns can be stored separately.
import { allocate, logit, smallestThree } from "./gaussians.js";
import { unzip } from "./zip.js";

export async function readSog(bytes) {
  const files = await unzip(bytes), text = files.get("meta.json");
  if (!text) throw new Error("it is a ZIP archive without meta.json, so it is not a .sog; open a .sog of version 2");
  const meta = JSON.parse(new TextDecoder().decode(text));
  if (meta.version !== 2) throw new Error("it is a .sog of version 1; this page reads version 2; convert it with splat-transform");
  const read = imageReader(files);
  const [low, high] = [await read(meta.means.files[0]), await read(meta.means.files[1])];
  const [scales, quats, colors] = [await read(meta.scales.files[0]), await read(meta.quats.files[0]), await read(meta.sh0.files[0])];
  const degree = meta.shN?.bands ?? 0, gaussians = allocate(meta.count, degree);
  if (low.data.length < 4 * meta.count) throw new Error("its images have fewer pixels than meta.json has Gaussians; export it again");
  for (let i = 0; i < meta.count; i++) {
    for (let k = 0; k < 3; k++) {
      const fraction = (low.data[4 * i + k] + 256 * high.data[4 * i + k]) / 65535;
      const value = meta.means.mins[k] * (1 - fraction) + meta.means.maxs[k] * fraction;
      gaussians.means[3 * i + k] = Math.sign(value) * Math.expm1(Math.abs(value));
      gaussians.logScales[3 * i + k] = meta.scales.codebook[scales.data[4 * i + k]];
      gaussians.sh0[3 * i + k] = meta.sh0.codebook[colors.data[4 * i + k]];
    }
    gaussians.opacityLogits[i] = logit(colors.data[4 * i + 3] / 255);
    const three = [0, 1, 2].map((k) => (quats.data[4 * i + k] / 255 - 0.5) * Math.SQRT2);
    gaussians.quats.set(smallestThree(quats.data[4 * i + 3] - 252, three), 4 * i);
  }
  if (degree) readSh(gaussians, meta.shN, await read(meta.shN.files[0]), await read(meta.shN.files[1]));
  read.close();
  return gaussians;
}

/** SH of degrees 1 and up, from a palette of 64 entries per image row. */
function readSh({ count, coefficients, shN }, { codebook }, palette, labels) {
  for (let i = 0; i < count; i++) {
    const label = labels.data[4 * i] + 256 * labels.data[4 * i + 1];
    const start = 4 * ((label >> 6) * palette.width + (label & 63) * coefficients);
    for (let k = 0; k < coefficients; k++) for (let c = 0; c < 3; c++) {
      shN[3 * (coefficients * i + k) + c] = codebook[palette.data[start + 4 * k + c]];
    }
  }
}

/** Reads pixels as stored, by WebGL: a 2D canvas would multiply the colours by alpha and round them. */
function imageReader(files) {
  const gl = document.createElement("canvas").getContext("webgl2");
  gl.bindFramebuffer(gl.FRAMEBUFFER, gl.createFramebuffer());
  const read = async (name) => {
    if (!files.has(name)) throw new Error(`${name} is missing from it; copy or export it again`);
    const image = await createImageBitmap(new Blob([files.get(name)], { type: "image/webp" }), {
      premultiplyAlpha: "none", colorSpaceConversion: "none",
    });
    const { width, height } = image, data = new Uint8Array(4 * width * height), texture = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, texture);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, gl.RGBA, gl.UNSIGNED_BYTE, image);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, texture, 0);
    gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, data);
    gl.deleteTexture(texture);
    image.close();
    return { width, data };
  };
  read.close = () => gl.getExtension("WEBGL_lose_context")?.loseContext();
  return read;
}

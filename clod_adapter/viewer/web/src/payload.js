// The page's configuration and the files in it or beside it.
import { readFile } from "./formats/index.js";
import { unpacked } from "./formats/zip.js";

/** The configuration that the page was written with; an empty page (a viewer for dropped files) has none. */
export function readConfig() {
  const element = document.getElementById("clod-config");
  return { title: "", model: null, base: null, cameras: [], virtual_scale: 1, ...(element ? JSON.parse(element.textContent) : {}) };
}

/** {gaussians, about} of the configuration's `model` or `base`. */
export async function fetchModel(entry) {
  const { gaussians, about } = await readFile(await bytesOf(entry), entry.name);
  if (entry.sigma) gaussians.sigma = new Float32Array(await bytesOf(entry.sigma));
  if (gaussians.sigma && gaussians.sigma.length !== gaussians.count) {
    throw new Error(`it has ${gaussians.count} Gaussians and ${gaussians.sigma.length} values of sigma_d`);
  }
  const attenuation = gaussians.sigma ? entry.attenuation ?? null : null;
  return {
    gaussians,
    about: {
      ...about, name: entry.name, attenuation, max_sv: entry.max_sv ?? about.max_sv,
      no_dial: attenuation ? null : entry.no_dial ?? about.no_dial, calibration: entry.calibration ?? [],
    },
  };
}

/** Bytes from the same origin (`href`), or base64 out of an `element` of the page, which it then leaves. */
async function bytesOf({ href, element, gzip }) {
  if (href) {
    const response = await fetch(href);
    if (!response.ok) throw new Error(`the server answered ${response.status} ${response.statusText}`);
    return response.arrayBuffer();
  }
  const holder = document.getElementById(element);
  if (!holder) throw new Error("the page does not hold it; write the page again");
  const letters = atob(holder.textContent.trim()), bytes = new Uint8Array(letters.length);
  holder.remove();
  for (let i = 0; i < bytes.length; i++) bytes[i] = letters.charCodeAt(i);
  return gzip ? (await unpacked(bytes, "gzip")).buffer : bytes.buffer;
}

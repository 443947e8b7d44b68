// The page's configuration, and the splats that it names: in the page or on its server.
import { DIAL } from "./formats/gaussians.js";
import { readFile } from "./formats/index.js";
import { inflate } from "./formats/zip.js";

/** The page's configuration; a page without one starts empty, as a viewer for dropped files. */
export function readConfig() {
  const element = document.getElementById("clod-config");
  return { title: "", model: null, base: null, others: [], cameras: [], virtual_scale: 1, ...(element ? JSON.parse(element.textContent) : {}) };
}

/** {gaussians, metadata} of the configuration's `model` or `base`; calls `onProgress(fraction)` during the transfer. */
export async function fetchModel(entry, onProgress) {
  const { gaussians, metadata } = await readFile(await bytesOf(entry, onProgress), entry.name);
  for (const [name, place] of Object.entries(entry.columns)) {
    const values = gaussians[DIAL[name]] = new Float32Array(await bytesOf(place));
    if (values.length !== gaussians.count) {
      throw new Error(`it has ${gaussians.count} Gaussians and ${values.length} values of ${name}; export the page again`);
    }
  }
  const attenuation = gaussians.sigmaD ? entry.attenuation ?? null : null;
  return {
    gaussians,
    metadata: {
      ...metadata, name: entry.name, attenuation, screen_filter: entry.screen_filter, max_sv: entry.max_sv ?? metadata.max_sv,
      no_dial: attenuation ? null : entry.no_dial ?? metadata.no_dial, calibration: entry.calibration ?? [],
    },
  };
}

/** Bytes from the same origin (`href`), or from base64 in the elements with the id `element`, which are then removed. */
async function bytesOf({ href, element, gzip }, onProgress) {
  if (href) return download(href, onProgress);
  const elements = [...document.querySelectorAll(`[id="${element}"]`)];
  if (!elements.length) throw new Error("the page does not contain its data; export the page again");
  const data = new Blob(elements.map(takeBytes));
  return gzip ? (await inflate(data, "gzip")).buffer : data.arrayBuffer();
}

/** By XMLHttpRequest: where a script reads the body of a fetch as a stream, for its progress, Chromium reports some of the
 *  complete requests as aborted. */
function download(href, onProgress = () => {}) {
  return new Promise((resolve, reject) => {
    const request = new XMLHttpRequest();
    request.open("GET", href);
    request.responseType = "arraybuffer";
    request.onprogress = ({ lengthComputable, loaded, total }) => lengthComputable && onProgress(loaded / total);
    request.onerror = () => reject(new Error("the server does not answer; start clod-adapt view again"));
    request.onload = () => {
      if (request.status === 200) resolve(request.response);
      else reject(new Error(`the server answered ${request.status} ${request.statusText}`));
    };
    request.send();
  });
}

/** Removes the element, for its memory, and decodes its text. */
function takeBytes(element) {
  const characters = atob(element.textContent.trim()), bytes = new Uint8Array(characters.length);
  element.remove();
  for (let i = 0; i < bytes.length; i++) bytes[i] = characters.charCodeAt(i);
  return bytes;
}

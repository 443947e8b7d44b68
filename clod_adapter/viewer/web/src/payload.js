// The page's configuration, and the splats that it names: in the page or on its server.
import { readFile } from "./formats/index.js";

const PARTS = [0.05, 0.1, 0.2, 0.4, 0.8, 1]; // of a file: ends of its requests, at which the rows so far are shown
const LEAST = 1 << 16, MOST = 2 ** 30; // bytes of a request; of 2 GB and more, Chromium gives a script none
const SOON = 2000; // ms: a rest that takes no longer is requested at once, and nothing is shown before it
const PAUSE = 1000; // ms between two of the pictures before the whole

/** The page's configuration; a page without one starts empty, as a viewer for dropped files. */
export function readConfig() {
  const element = document.getElementById("clod-config");
  return { title: "", model: null, base: null, others: [], cameras: [], virtual_scale: null, devices: {}, ...(element ? JSON.parse(element.textContent) : {}) };
}

/** {gaussians, metadata} of the configuration's `model` or `base`; calls `onProgress(fraction)` during the transfer and,
 *  where it is slow, `onPart(read)` with the first rows. `signal` aborts it. */
export async function fetchModel(entry, { signal, onProgress, onPart }) {
  const readPart = async (bytes) => onPart(await readFile(bytes, entry.name, true));
  return readFile(await bytesOf(entry, { signal, onProgress, onPart: onPart && readPart }), entry.name);
}

/** Bytes from the same origin (`href`), or from base64 in the elements with the id `element`, which are then removed. */
async function bytesOf({ href, size, element }, transfer) {
  if (href) return download(href, size, transfer);
  const elements = [...document.querySelectorAll(`[id="${element}"]`)];
  if (!elements.length) throw new Error("the page does not contain its data; export the page again");
  return new Blob(elements.map(takeBytes)).arrayBuffer();
}

/** In parts, where `onPart` shows them: it is called with the bytes so far. */
async function download(href, size, { signal, onProgress, onPart }) {
  let bytes = null, loaded = 0, ms = 0, soon = !onPart, shown = -Infinity;
  while (loaded < size) {
    const from = loaded, began = performance.now(), next = PARTS.find((share) => share * size > from) * size;
    loaded = Math.min(soon ? size : Math.ceil(Math.max(next, from + LEAST)), from + MOST, size);
    const onCount = (count) => onProgress((from + count) / size);
    const { status, response } = await request(href, { from, to: loaded, size, signal, onCount });
    if (status === 200) return response;
    if (response.byteLength !== loaded - from) throw new Error("the server has sent another number of bytes; start clod-adapt view again");
    bytes ??= new Uint8Array(size); // a whole file in one response needs no second copy
    bytes.set(new Uint8Array(response), from);
    ms += performance.now() - began;
    soon ||= ms * (size / loaded - 1) < SOON;
    if (soon || performance.now() - shown < PAUSE) continue;
    const part = bytes.subarray(0, loaded);
    shown = performance.now();
    setTimeout(() => onPart(part).catch(() => {})); // after the next request; errors come with the whole file
  }
  return bytes;
}

/** By XMLHttpRequest: where a script reads the body of a fetch as a stream, for its progress, Chromium reports some of the
 *  complete requests as aborted. */
function request(href, { from, to, size, signal, onCount }) {
  return new Promise((resolve, reject) => {
    signal.throwIfAborted();
    const request = new XMLHttpRequest();
    request.open("GET", href);
    request.responseType = "arraybuffer";
    if (to - from < size) request.setRequestHeader("Range", `bytes=${from}-${to - 1}`);
    request.onprogress = ({ loaded }) => onCount(loaded);
    request.onabort = () => reject(signal.reason);
    signal.addEventListener("abort", () => request.abort(), { once: true });
    request.onerror = () => reject(new Error("the server does not answer; start clod-adapt view again"));
    request.onload = () => {
      if (request.status === 200 || request.status === 206) resolve(request);
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

// The page's configuration, and the splats that it names: in the page or on its server.
import { readFile } from "./read.js";

/** The page's configuration; a page without one starts empty, as a viewer for dropped files. */
export function readConfig() {
  const element = document.getElementById("clod-config");
  return { title: "", model: null, base: null, others: [], cameras: [], virtual_scale: null, ...(element ? JSON.parse(element.textContent) : {}) };
}

/** {gaussians, metadata} of an entry of the configuration; calls `onProgress(share)` during the transfer. */
export const fetchModel = async ({ name, href, element }, onProgress) => readFile(href ? await download(href, onProgress) : included(element), name);

/** The bytes that the elements with this id have in base64; removes these elements, for their memory. */
function included(id) {
  const elements = [...document.querySelectorAll(`[id="${id}"]`)];
  if (!elements.length) throw new Error("the page does not contain its data; export the page again");
  const parts = elements.map((element) => {
    const characters = atob(element.textContent.trim()), bytes = new Uint8Array(characters.length);
    element.remove();
    for (let i = 0; i < bytes.length; i++) bytes[i] = characters.charCodeAt(i);
    return bytes;
  });
  return new Blob(parts);
}

/** By XMLHttpRequest: where a script reads the body of a fetch as a stream, for its progress, Chromium reports some of the
 *  complete requests as aborted. */
function download(href, onProgress) {
  return new Promise((resolve, reject) => {
    const request = new XMLHttpRequest();
    request.open("GET", href);
    request.responseType = "blob";
    request.onprogress = ({ loaded, total }) => onProgress(loaded / total);
    request.onerror = () => reject(new Error("the server does not answer; start clod-adapt view again"));
    request.onload = () => {
      if (request.status === 200) resolve(request.response);
      else reject(new Error(`the server answered ${request.status} ${request.statusText}`));
    };
    request.send();
  });
}

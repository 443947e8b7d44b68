// The page's configuration and the files in it or beside it.
import { readFile } from "./formats/index.js";
import { unpacked } from "./formats/zip.js";

/** The configuration that the page was written with; an empty page (a viewer for dropped files) has none. */
export function readConfig() {
  const element = document.getElementById("clod-config");
  return { title: "", model: null, base: null, cameras: [], virtual_scale: 1, ...(element ? JSON.parse(element.textContent) : {}) };
}

/** {gaussians, about} of the configuration's `model` or `base`; `arrived(part)` is told how much of it is here. */
export async function fetchModel(entry, arrived) {
  const { gaussians, about } = await readFile(await bytesOf(entry, arrived), entry.name);
  if (entry.sigma) gaussians.sigma = new Float32Array(await bytesOf(entry.sigma));
  if (gaussians.sigma && gaussians.sigma.length !== gaussians.count) {
    throw new Error(`it has ${gaussians.count} Gaussians and ${gaussians.sigma.length} values of sigma_d`);
  }
  const attenuation = gaussians.sigma ? entry.attenuation ?? null : null;
  return {
    gaussians,
    about: {
      ...about, name: entry.name, attenuation, screen_filter: entry.screen_filter, max_sv: entry.max_sv ?? about.max_sv,
      no_dial: attenuation ? null : entry.no_dial ?? about.no_dial, calibration: entry.calibration ?? [],
    },
  };
}

/** Bytes from the same origin (`href`), or base64 out of the page's elements of an id, which it then leaves. */
async function bytesOf({ href, element, gzip }, arrived) {
  if (href) {
    const response = await fetch(href);
    if (!response.ok) throw new Error(`the server answered ${response.status} ${response.statusText}`);
    return received(response, arrived);
  }
  const holders = [...document.querySelectorAll(`[id="${element}"]`)];
  if (!holders.length) throw new Error("the page does not hold it; write the page again");
  const held = new Blob(holders.map(decoded));
  return gzip ? (await unpacked(held, "gzip")).buffer : held.arrayBuffer();
}

async function received(response, arrived) {
  const size = Number(response.headers.get("Content-Length"));
  if (!size || response.headers.has("Content-Encoding")) return response.arrayBuffer();
  const bytes = new Uint8Array(size), reader = response.body.getReader();
  let at = 0;
  for (let { done, value } = await reader.read(); !done; { done, value } = await reader.read()) {
    bytes.set(value, at);
    at += value.length;
    arrived(at / size);
  }
  return bytes.buffer;
}

function decoded(holder) {
  const letters = atob(holder.textContent.trim()), bytes = new Uint8Array(letters.length);
  holder.remove();
  for (let i = 0; i < bytes.length; i++) bytes[i] = letters.charCodeAt(i);
  return bytes;
}

// Makes ../static out of src: one minified script, the style, the page's template, and the sources' fingerprint.
import { createHash } from "node:crypto";
import { readFileSync, readdirSync, writeFileSync } from "node:fs";
import { build } from "esbuild";

const SHARED = ["equation.js", "frame_rate.js", "read.js", "shaders.js", "spz.js"]; // with the drop-ins
const SHADERS = ["glsl", "wgsl"].map((kind) => `../../integrations/shaders/attenuation.${kind}`);
const at = (name) => new URL(name, import.meta.url);

async function bundle(name, define = {}) {
  const options = { bundle: true, minify: true, format: "iife", target: "es2022", write: false, loader: { ".glsl": "text" }, define };
  const { outputFiles } = await build({ ...options, entryPoints: [at(`src/${name}`).pathname] });
  return outputFiles[0].text;
}

const worker = await bundle("worker.js");
writeFileSync(at("../static/viewer.js"), await bundle("main.js", { WORKER: JSON.stringify(worker) }));
writeFileSync(at("../static/viewer.css"), await bundle("style.css"));
writeFileSync(at("../static/page.html"), readFileSync(at("src/page.html")));

const [glsl, wgsl] = SHADERS.map((name) => JSON.stringify(readFileSync(at(name), "utf8")));
const texts = `// Made by clod_adapter/viewer/web/build.mjs.\nexport const glsl = ${glsl};\nexport const wgsl = ${wgsl};\n`;
writeFileSync(at("../../../viewers/shaders.js"), texts);

const sources = [...SHADERS, ...SHARED.map((name) => `../../../viewers/${name}`), ...readdirSync(at("src")).map((name) => `src/${name}`)];
const digest = (name) => createHash("sha256").update(readFileSync(at(name))).digest("hex");
const lines = [...sources, "build.mjs", "package-lock.json", "package.json"].map((name) => `${digest(name)}  ${name}\n`);
writeFileSync(at("../static/SOURCES.sha256"), lines.join(""));

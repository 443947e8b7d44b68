// Makes ../static out of src: one minified script, the style, the page's template, and the sources' fingerprint.
import { createHash } from "node:crypto";
import { readFileSync, readdirSync, writeFileSync } from "node:fs";
import { build } from "esbuild";

const SHARED = ["equation.js", "frame_rate.js", "ply.js", "read.js", "settings.js", "shaders.js", "spz.js", "timer.js"]; // with the drop-ins
const here = new URL(".", import.meta.url), dropIns = new URL("../../../viewers/", here), out = new URL("../static/", here);
const shared = { bundle: true, minify: true, format: "iife", target: "es2022", write: false, loader: { ".glsl": "text" } };

/** `worker:./x.js` is the text of x.js with what it imports, for a Worker out of a Blob. */
const worker = {
  name: "worker",
  setup({ onResolve, onLoad }) {
    onResolve({ filter: /^worker:/ }, ({ path, resolveDir }) => ({ path: `${resolveDir}/${path.slice(9)}`, namespace: "worker" }));
    onLoad({ filter: /.*/, namespace: "worker" }, async ({ path }) => {
      const { outputFiles } = await build({ ...shared, entryPoints: [path] });
      return { contents: outputFiles[0].text, loader: "text" };
    });
  },
};

const { outputFiles } = await build({ ...shared, entryPoints: [new URL("src/main.js", here).pathname], plugins: [worker] });
writeFileSync(new URL("viewer.js", out), outputFiles[0].text);
const css = await build({ ...shared, entryPoints: [new URL("src/style.css", here).pathname] });
writeFileSync(new URL("viewer.css", out), css.outputFiles[0].text);
writeFileSync(new URL("page.html", out), readFileSync(new URL("src/page.html", here)));

const shaders = ["glsl", "wgsl"].map((kind) => `../../integrations/shaders/attenuation.${kind}`);
const texts = ["glsl", "wgsl"].map((kind, k) => `export const ${kind} = \`${readFileSync(new URL(shaders[k], here))}\`;\n`);
const origin = "// Made by clod_adapter/viewer/web/build.mjs from clod_adapter/integrations/shaders/.\n";
writeFileSync(new URL("shaders.js", dropIns), origin + texts.join(""));
const sources = [...shaders, ...SHARED.map((name) => `../../../viewers/${name}`), "build.mjs", "package-lock.json", "package.json"];
sources.push(...readdirSync(new URL("src", here), { recursive: true }).filter((name) => /\.\w+$/.test(name)).map((name) => `src/${name}`));
const lines = sources.sort().map((name) => `${createHash("sha256").update(readFileSync(new URL(name, here))).digest("hex")}  ${name}`);
writeFileSync(new URL("SOURCES.sha256", out), `${lines.join("\n")}\n`);
console.log(`viewer.js ${outputFiles[0].contents.length} bytes`);

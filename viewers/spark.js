// The dial in Spark (three.js): mesh.objectModifiers, with the library's GLSL.
import { dyno } from "@sparkjsdev/spark";
import { DataTexture, FloatType, RGBAFormat } from "three";
import { Dial, claim, constants, readDial, release, texels } from "./dial.js";
import { glsl } from "./shaders.js";
import { timed } from "./frame_rate.js";

const WIDTH = 2048; // of the texture

/** Attaches the dial of an adapted PLY or SPZ, whose `bytes` the SplatMesh was made from (without `lod`). */
export async function attach(mesh, bytes, renderer) {
  claim(mesh);
  return dialOf(mesh, bytes, renderer).catch((error) => {
    release(mesh);
    throw error;
  });
}

async function dialOf(mesh, bytes, renderer) {
  const file = await read(mesh, bytes);
  const height = Math.ceil(file.count / WIDTH);
  const texture = new DataTexture(texels(file, 4 * WIDTH * height), WIDTH, height, RGBAFormat, FloatType);
  texture.needsUpdate = true;
  const columns = new dyno.DynoSampler2D({ key: "clodColumns", value: texture }), s = dyno.dynoFloat(1, "clodScale");
  const eye = mesh.context.viewToObject.translate;
  mesh.enableViewToObject = true;
  mesh.objectModifiers = [
    ...(mesh.objectModifiers ?? []),
    dyno.dynoBlock({ gsplat: dyno.Gsplat }, { gsplat: dyno.Gsplat }, ({ gsplat }) => attenuated(file).apply({ gsplat, columns, s, eye })),
  ];
  mesh.updateGenerator();
  const show = (value) => {
    s.value = value;
    mesh.updateVersion();
  };
  return new Dial(file, { eye: () => eye.value.toArray(), show, time: (draw) => timed(renderer.getContext(), draw) });
}

async function read(mesh, bytes) {
  const [file] = await Promise.all([readDial(bytes), mesh.initialized]);
  if (mesh.splats.getNumSplats() === file.count) return file;
  throw new Error(`the mesh has not the ${file.count} splats of the file; load it without lod`);
}

function attenuated(file) {
  const { distance, start, near } = constants(file);
  return new dyno.Dyno({
    inTypes: { gsplat: dyno.Gsplat, columns: "sampler2D", s: "float", eye: "vec3" },
    outTypes: { gsplat: dyno.Gsplat },
    globals: () => [dyno.defineGsplat, glsl],
    statements: ({ inputs, outputs }) => dyno.unindentLines(`
      ${outputs.gsplat} = ${inputs.gsplat};
      if (isGsplatActive(${outputs.gsplat}.flags)) {
        vec4 column = texelFetch(${inputs.columns}, ivec2(${outputs.gsplat}.index % ${WIDTH}, ${outputs.gsplat}.index / ${WIDTH}), 0);
        float d = length(${outputs.gsplat}.center - ${inputs.eye}) / ${distance};
        ${outputs.gsplat}.rgba.a = clodOpacity(column.a > 0.0 ? column.a : ${outputs.gsplat}.rgba.a, column.r, d, ${inputs.s}, ${near});
        ${outputs.gsplat}.scales *= clodScale(column.g, d, ${inputs.s}, ${start});
        if (${outputs.gsplat}.rgba.a == 0.0) ${outputs.gsplat}.flags = 0u;
      }
    `),
  });
}

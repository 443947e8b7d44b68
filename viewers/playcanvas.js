// The dial in PlayCanvas, and so in SuperSplat's engine: a work buffer modifier with the library's GLSL or WGSL.
import { PIXELFORMAT_RGBA32F, Vec3, WORKBUFFER_UPDATE_ONCE } from "playcanvas";
import { Dial, checked, claim, constants, release, texels } from "./dial.js";
import { timed } from "./frame_rate.js";
import { constantsOf, readSettings, revealed } from "./read.js";
import { glsl, wgsl } from "./shaders.js";

/** Attaches the dial of an adapted PLY to an entity with its gsplat; distances are from `camera`, an entity. */
export function attach(app, entity, camera) {
  claim(entity);
  try {
    return dialOf(app, entity, camera);
  } catch (error) {
    release(entity);
    throw error;
  }
}

function dialOf(app, entity, camera) {
  const { gsplat } = entity, { resource } = gsplat, file = fileOf(resource.gsplatData);
  const world = camera.getPosition.bind(camera), place = new Vec3();
  resource.format.addExtraStreams([{ name: "clod", format: PIXELFORMAT_RGBA32F }]);
  const texture = resource.getTexture("clod");
  texture.lock().set(texels(file, 4 * texture.width * texture.height));
  texture.unlock();
  gsplat.setWorkBufferModifier(modifier(file));
  const eye = () => {
    entity.getWorldTransform().clone().invert().transformPoint(world(), place);
    return [place.x, place.y, place.z];
  };
  let scale = 1, last = "", isStale = false;
  const update = () => {
    const { x, y, z } = world(), transform = entity.getWorldTransform(), state = `${scale} ${x} ${y} ${z} ${transform.data}`;
    if (state === last) return; // what the work buffer has is right
    [last, isStale] = [state, true];
    gsplat.setParameter("uClodEye", [x, y, z]);
    gsplat.setParameter("uClodScale", [scale, 1 / transform.getScale().x]);
    gsplat.workBufferUpdate = WORKBUFFER_UPDATE_ONCE;
  };
  app.on("prerender", update);
  // The engine forgets a sort that becomes due while it sorts: after a change it sorts once more, from the frame on that
  // follows the one which takes the order.
  app.scene.on("gsplat:sorted", () => {
    if (isStale) app.once("postrender", () => (gsplat.workBufferUpdate = WORKBUFFER_UPDATE_ONCE));
    isStale = false;
  });
  const { gl, wgpu } = app.graphicsDevice, time = (draw) => timed(gl ?? wgpu, draw);
  const dial = new Dial(file, { eye, show: (value) => (scale = value), time });
  const render = app.render.bind(app);
  app.render = () => void dial.frame(render);
  return dial;
}

function fileOf(data) {
  const column = (name) => data.getProp(name), [x, y, z] = ["x", "y", "z"].map(column), count = data.numSplats;
  const means = new Float32Array(3 * count);
  for (let i = 0; i < count; i++) means.set([x[i], y[i], z[i]], 3 * i);
  const names = data.getElement("vertex").properties.map(({ name }) => name);
  const settings = readSettings(data.comments ?? [], constantsOf(names, (name) => column(name)[0]));
  const given = { opacityLogits: Float32Array.from(column("opacity")), sigmaD: column("sigma_d"), opacityD: column("opacity_d") };
  const { opacityLogits: logits, sigmaD: sigma } = revealed(given);
  return checked({ count, means, logits, sigma, growth: column("growth_d"), settings });
}

/** The modifier for `gsplat.setWorkBufferModifier`. */
export function modifier(file) {
  const { distance, start, near } = constants(file);
  return {
    glsl: `${glsl}
      uniform vec3 uClodEye;
      uniform vec2 uClodScale;
      float clodDistance(vec3 center) { return length(center - uClodEye) * uClodScale.y / ${distance}; }
      void modifySplatCenter(inout vec3 center) {}
      void modifySplatRotationScale(vec3 original, vec3 center, inout vec4 rotation, inout vec3 scale) {
        scale *= clodScale(loadClod().g, clodDistance(center), uClodScale.x, ${start});
      }
      void modifySplatColor(vec3 center, inout vec4 color) {
        vec4 column = loadClod();
        color.a = clodOpacity(column.a > 0.0 ? column.a : color.a, column.r, clodDistance(center), uClodScale.x, ${near});
      }`,
    wgsl: `${wgsl}
      uniform uClodEye: vec3f;
      uniform uClodScale: vec2f;
      fn clodDistance(center: vec3f) -> f32 { return length(center - uniform.uClodEye) * uniform.uClodScale.y / ${distance}; }
      fn modifySplatCenter(center: ptr<function, vec3f>) {}
      fn modifySplatRotationScale(original: vec3f, center: vec3f, rotation: ptr<function, vec4f>, scale: ptr<function, vec3f>) {
        *scale = *scale * clodScale(loadClod().g, clodDistance(center), uniform.uClodScale.x, ${start});
      }
      fn modifySplatColor(center: vec3f, color: ptr<function, vec4f>) {
        let column = loadClod();
        (*color).a = clodOpacity(select((*color).a, column.a, column.a > 0.0), column.r, clodDistance(center), uniform.uClodScale.x, ${near});
      }`,
  };
}


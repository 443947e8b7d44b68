// Draws models: a pass projects each Gaussian to a texel, another draws a quad each, farthest first, into half floats.
import { growthStart } from "../../../../viewers/equation.js";
import { timed } from "../../../../viewers/frame_rate.js";
import { WIDTH, heightOf, program, set, target, texture } from "./gpu.js";
import { copyVertex, copyFragment, projectFragment, splatFragment, splatVertex } from "./shaders.js";

export function createRenderer(canvas) {
  const gl = canvas.getContext("webgl2", { alpha: false, antialias: false, depth: false, powerPreference: "high-performance" });
  if (!gl) throw new Error("this browser has no WebGL2; try a current Chrome, Edge, Firefox or Safari");
  gl.getExtension("EXT_color_buffer_float") ?? gl.getExtension("EXT_color_buffer_half_float"); // without these, target() throws
  const projectors = [], splat = program(gl, splatVertex, splatFragment), copy = program(gl, copyVertex, copyFragment);
  const projected = target(gl, 3, gl.RGBA32UI, gl.RGBA_INTEGER, gl.UNSIGNED_INT);
  const image = target(gl, 1, gl.RGBA16F, gl.RGBA, gl.HALF_FLOAT);

  function project({ side, model, dial, attenuated }, { rotation, eye, fx, fy, cx, cy, width, height, near }) {
    const { records, sh, screenFilter, degree, count } = model, attenuation = model.attenuation ?? { scene_distance: 1 };
    const { handle, uniforms } = (projectors[degree] ??= program(gl, copyVertex, projectFragment(degree)));
    projected.resize(WIDTH, Math.max(heightOf(count), projected.height));
    gl.bindFramebuffer(gl.FRAMEBUFFER, projected.handle);
    gl.viewport(0, 0, WIDTH, heightOf(side.drawn));
    gl.useProgram(handle);
    gl.uniform1i(uniforms.drawn, side.drawn);
    gl.uniformMatrix3fv(uniforms.view, true, rotation);
    set(gl, uniforms, {
      eye, pinhole: [fx, fy, cx, cy], size: [width, height, near], blur: screenFilter.variance, compensate: screenFilter.compensate,
      attenuated, dial, distance_unit: attenuation.scene_distance, start: growthStart(attenuation),
      near_distance: (attenuation.near_distance ?? 0) / attenuation.scene_distance,
    }, { order: side.order, records, sh });
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  function blend({ side, from, to }, { width, height }) {
    const [footprint, conic, color] = projected.textures, [left, right] = [from, to].map((share) => Math.round(share * width));
    gl.bindFramebuffer(gl.FRAMEBUFFER, image.handle);
    gl.viewport(0, 0, width, height);
    gl.useProgram(splat.handle);
    set(gl, splat.uniforms, { size: [width, height] }, { footprint, conic, color });
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    gl.enable(gl.SCISSOR_TEST);
    gl.scissor(left, 0, right - left, height);
    gl.drawArrays(gl.TRIANGLES, 0, 6 * side.drawn);
    gl.disable(gl.SCISSOR_TEST);
    gl.disable(gl.BLEND);
  }

  return {
    gl,
    /** Uploads the order of a side: the rows to draw, rounded up to a multiple of WIDTH. */
    upload(side, rows) {
      side.order ??= texture(gl, gl.R32UI, WIDTH, heightOf(side.model.count), gl.RED_INTEGER, gl.UNSIGNED_INT);
      gl.bindTexture(gl.TEXTURE_2D, side.order);
      gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, WIDTH, heightOf(side.drawn), gl.RED_INTEGER, gl.UNSIGNED_INT, rows);
    },
    release(side) {
      gl.deleteTexture(side.order);
      side.order = null;
    },
    /** Draws what each side shows in its range of the width; returns the milliseconds that it took. */
    draw: (shown, view) => timed(gl, () => {
      const { width, height } = view;
      if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
      image.resize(width, height);
      gl.bindFramebuffer(gl.FRAMEBUFFER, image.handle);
      gl.clear(gl.COLOR_BUFFER_BIT);
      for (const each of shown.filter(({ side }) => side.drawn)) {
        project(each, view);
        blend(each, view);
      }
      gl.bindFramebuffer(gl.FRAMEBUFFER, null);
      gl.viewport(0, 0, width, height);
      gl.useProgram(copy.handle);
      set(gl, copy.uniforms, {}, { image: image.textures[0] });
      gl.drawArrays(gl.TRIANGLES, 0, 3);
    }),
  };
}

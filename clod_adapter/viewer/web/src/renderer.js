// Draws models. A first pass projects each Gaussian to one texel; a second one draws a quad each, farthest first, into a
// half-float image, so that blending hundreds of layers does not round to 8 bits.
import { WIDTH, bindTextures, framebuffer, heightOf, program, quads, texture } from "./gpu.js";
import { growthDistance } from "../../../../viewers/equation.js";
import { copyVertex, copyFragment, projectFragment, splatFragment, splatVertex } from "./shaders.js";
import { timed } from "../../../../viewers/timer.js";

export function createRenderer(canvas) {
  const gl = canvas.getContext("webgl2", { alpha: false, antialias: false, depth: false, powerPreference: "high-performance" });
  if (!gl) throw new Error("this browser has no WebGL2; try a current Chrome, Edge, Firefox or Safari");
  gl.getExtension("EXT_color_buffer_float") ?? gl.getExtension("EXT_color_buffer_half_float"); // without these, framebuffer() throws
  const projectors = new Map(), splat = program(gl, splatVertex, splatFragment), copy = program(gl, copyVertex, copyFragment);
  const quadArray = quads(gl), empty = gl.createVertexArray();
  const projected = { textures: [], target: null, height: 0 }, image = { texture: null, target: null };
  let width = 0, height = 0;

  function resize(view) {
    if (view.width === width && view.height === height) return;
    ({ width, height } = view);
    gl.deleteTexture(image.texture);
    gl.deleteFramebuffer(image.target);
    image.texture = texture(gl, gl.RGBA16F, width, height, gl.RGBA, gl.HALF_FLOAT);
    image.target = framebuffer(gl, [image.texture]);
  }

  /** Enlarges the textures of projected Gaussians to at least so many rows of texels. */
  function resizeProjected(rows) {
    if (rows <= projected.height) return;
    projected.textures.forEach((old) => gl.deleteTexture(old));
    gl.deleteFramebuffer(projected.target);
    projected.textures = [0, 1, 2].map(() => texture(gl, gl.RGBA32UI, WIDTH, rows, gl.RGBA_INTEGER, gl.UNSIGNED_INT));
    projected.target = framebuffer(gl, projected.textures);
    projected.height = rows;
  }

  function projector(degree) {
    if (!projectors.has(degree)) projectors.set(degree, program(gl, copyVertex, projectFragment(degree)));
    return projectors.get(degree);
  }

  function project(side, view) {
    const { model } = side, { handle, uniforms: u } = projector(model.degree);
    resizeProjected(heightOf(model.count));
    gl.bindFramebuffer(gl.FRAMEBUFFER, projected.target);
    gl.viewport(0, 0, WIDTH, heightOf(side.drawn));
    gl.useProgram(handle);
    bindTextures(gl, u, { order: side.order, records: model.records, sh: model.sh });
    gl.uniform1i(u.drawn, side.drawn);
    gl.uniformMatrix3fv(u.view, true, view.rotation);
    gl.uniform3fv(u.eye, view.eye);
    gl.uniform4f(u.pinhole, view.fx, view.fy, view.cx, view.cy);
    gl.uniform3f(u.size, view.width, view.height, view.near);
    gl.uniform1f(u.blur, model.screen_filter.variance);
    gl.uniform1i(u.compensate, model.screen_filter.compensate);
    gl.uniform1i(u.attenuated, side.attenuated);
    if (side.attenuated) {
      gl.uniform1f(u.dial, side.dial);
      gl.uniform1f(u.distance_unit, side.distance);
      gl.uniform1f(u.reach, growthDistance(model.attenuation));
      gl.uniform1f(u.eps, model.attenuation.eps);
      gl.uniform1f(u.tau, model.attenuation.tau);
      gl.uniform1i(u.soft, model.attenuation.cut === "soft");
    }
    gl.bindVertexArray(empty);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  function clear() {
    gl.bindFramebuffer(gl.FRAMEBUFFER, image.target);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT);
  }

  function blend(side, view) {
    gl.bindFramebuffer(gl.FRAMEBUFFER, image.target);
    gl.viewport(0, 0, width, height);
    gl.useProgram(splat.handle);
    const [footprint, conic, color] = projected.textures;
    bindTextures(gl, splat.uniforms, { footprint, conic, color });
    gl.uniform3f(splat.uniforms.size, view.width, view.height, view.near);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    gl.enable(gl.SCISSOR_TEST);
    const from = Math.round(side.from * width), to = Math.round(side.to * width);
    gl.scissor(from, 0, to - from, height);
    gl.bindVertexArray(quadArray);
    gl.drawElementsInstanced(gl.TRIANGLES, 6 * WIDTH, gl.UNSIGNED_SHORT, 0, heightOf(side.drawn));
    gl.disable(gl.SCISSOR_TEST);
    gl.disable(gl.BLEND);
  }

  return {
    gl,
    /** Uploads the order of a side: its first `drawn` rows, rounded up to a multiple of WIDTH. */
    upload(side, rows, drawn) {
      const lines = heightOf(side.model.count);
      side.order ??= texture(gl, gl.R32UI, WIDTH, lines, gl.RED_INTEGER, gl.UNSIGNED_INT);
      gl.bindTexture(gl.TEXTURE_2D, side.order);
      gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, WIDTH, heightOf(drawn), gl.RED_INTEGER, gl.UNSIGNED_INT, rows);
      side.drawn = drawn;
    },
    release(side) {
      gl.deleteTexture(side.order);
      side.order = null;
    },
    /** Draws each side in its range [from, to] of the image's width, in [0, 1]; returns the milliseconds that it took. */
    draw: (sides, view) => timed(gl, () => {
      resize(view);
      if (canvas.width !== width || canvas.height !== height) [canvas.width, canvas.height] = [width, height];
      clear();
      for (const side of sides.filter(({ drawn }) => drawn)) {
        project(side, view);
        blend(side, view);
      }
      gl.bindFramebuffer(gl.FRAMEBUFFER, null);
      gl.viewport(0, 0, width, height);
      gl.useProgram(copy.handle);
      bindTextures(gl, copy.uniforms, { image: image.texture });
      gl.bindVertexArray(empty);
      gl.drawArrays(gl.TRIANGLES, 0, 3);
    }),
  };
}

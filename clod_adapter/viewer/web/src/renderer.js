// Draws models: each Gaussian is projected once into a buffer, then drawn as one quad, the farthest first, into a
// half-float picture, so that hundreds of blended layers are not rounded to 8 bits each.
import { instances, program, unfiltered } from "./gpu.js";
import { PROJECTED, copyFragment, copyVertex, nothing, projectVertex, splatFragment, splatVertex } from "./shaders.js";

const STRIDE = 12; // floats of a projected Gaussian
const LAYOUT = [[0, 2, 0], [1, 3, 2], [2, 3, 5], [3, 4, 8]];

export function createRenderer(canvas) {
  const gl = canvas.getContext("webgl2", { alpha: false, antialias: false, depth: false, powerPreference: "high-performance" });
  if (!gl) throw new Error("this browser has no WebGL2; try a current Chrome, Edge, Firefox or Safari");
  const precise = gl.getExtension("EXT_color_buffer_float") ?? gl.getExtension("EXT_color_buffer_half_float");
  const projectors = new Map();
  const splat = program(gl, splatVertex, splatFragment), copy = program(gl, copyVertex, copyFragment);
  const feedback = gl.createTransformFeedback(), projected = gl.createBuffer();
  const quads = instances(gl, projected, STRIDE, LAYOUT), target = gl.createFramebuffer();
  const picture = gl.createTexture(), rowArray = gl.createVertexArray(), empty = gl.createVertexArray();
  let capacity = 0, width = 0, height = 0;

  function resize(view) {
    if (view.width === width && view.height === height) return;
    ({ width, height } = view);
    [canvas.width, canvas.height] = [width, height];
    gl.bindTexture(gl.TEXTURE_2D, picture);
    const [internal, type] = precise ? [gl.RGBA16F, gl.HALF_FLOAT] : [gl.RGBA8, gl.UNSIGNED_BYTE];
    gl.texImage2D(gl.TEXTURE_2D, 0, internal, width, height, 0, gl.RGBA, type, null);
    unfiltered(gl);
    gl.bindFramebuffer(gl.FRAMEBUFFER, target);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, picture, 0);
  }

  function project(side, view) {
    const { model } = side;
    if (!projectors.has(model.degree)) {
      projectors.set(model.degree, program(gl, projectVertex(model.degree), nothing, PROJECTED));
    }
    const { made, uniforms: u } = projectors.get(model.degree);
    gl.useProgram(made);
    for (const [unit, name] of [[0, "records"], [1, "higher"]]) {
      gl.activeTexture(gl.TEXTURE0 + unit);
      gl.bindTexture(gl.TEXTURE_2D, model[name]);
      if (u[name]) gl.uniform1i(u[name], unit);
    }
    gl.uniformMatrix3fv(u.view, true, view.rotation);
    gl.uniform3fv(u.eye, view.eye);
    gl.uniform4f(u.pinhole, view.fx, view.fy, view.cx, view.cy);
    gl.uniform3f(u.size, view.width, view.height, view.near);
    gl.uniform1i(u.dialled, side.dialled);
    if (side.dialled) {
      gl.uniform1f(u.dial, side.dial);
      gl.uniform1f(u.distance_unit, side.distance);
      gl.uniform1f(u.eps, model.attenuation.eps);
      gl.uniform1f(u.tau, model.attenuation.tau);
      gl.uniform1i(u.soft, model.attenuation.cut === "soft");
    }
    gl.bindVertexArray(rowArray);
    gl.bindBuffer(gl.ARRAY_BUFFER, side.rows);
    gl.enableVertexAttribArray(0);
    gl.vertexAttribIPointer(0, 1, gl.UNSIGNED_INT, 0, 0);
    gl.bindBuffer(gl.ARRAY_BUFFER, null);
    gl.bindTransformFeedback(gl.TRANSFORM_FEEDBACK, feedback);
    gl.bindBufferBase(gl.TRANSFORM_FEEDBACK_BUFFER, 0, projected);
    gl.enable(gl.RASTERIZER_DISCARD);
    gl.beginTransformFeedback(gl.POINTS);
    gl.drawArrays(gl.POINTS, 0, side.drawn);
    gl.endTransformFeedback();
    gl.disable(gl.RASTERIZER_DISCARD);
    gl.bindBufferBase(gl.TRANSFORM_FEEDBACK_BUFFER, 0, null);
    gl.bindTransformFeedback(gl.TRANSFORM_FEEDBACK, null);
  }

  function paint(side, view) {
    gl.useProgram(splat.made);
    gl.uniform3f(splat.uniforms.size, view.width, view.height, view.near);
    gl.bindVertexArray(quads);
    gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, side.drawn);
    gl.bindVertexArray(null);
  }

  return {
    gl,
    /** New rows for a side; the buffers grow with them. */
    upload(side, indices) {
      side.rows ??= gl.createBuffer();
      gl.bindBuffer(gl.ARRAY_BUFFER, side.rows);
      gl.bufferData(gl.ARRAY_BUFFER, indices, gl.DYNAMIC_DRAW);
      if (indices.length > capacity) {
        capacity = side.model.count;
        gl.bindBuffer(gl.ARRAY_BUFFER, projected);
        gl.bufferData(gl.ARRAY_BUFFER, 4 * STRIDE * capacity, gl.DYNAMIC_COPY);
      }
      gl.bindBuffer(gl.ARRAY_BUFFER, null);
      side.drawn = indices.length;
    },
    release(side) {
      gl.deleteBuffer(side.rows);
      side.rows = null;
    },
    /** Draws the sides, each in its share [from, to] of the picture's width, and shows it. */
    draw(sides, view) {
      resize(view);
      gl.viewport(0, 0, width, height);
      gl.bindFramebuffer(gl.FRAMEBUFFER, target);
      gl.clearColor(0, 0, 0, 0);
      gl.clear(gl.COLOR_BUFFER_BIT);
      for (const side of sides) {
        if (!side.drawn) continue;
        gl.disable(gl.BLEND);
        project(side, view);
        gl.enable(gl.BLEND);
        gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
        gl.enable(gl.SCISSOR_TEST);
        const from = Math.round(side.from * width), to = Math.round(side.to * width);
        gl.scissor(from, 0, to - from, height);
        paint(side, view);
        gl.disable(gl.SCISSOR_TEST);
      }
      gl.disable(gl.BLEND);
      gl.bindFramebuffer(gl.FRAMEBUFFER, null);
      gl.useProgram(copy.made);
      gl.activeTexture(gl.TEXTURE0);
      gl.bindTexture(gl.TEXTURE_2D, picture);
      gl.bindVertexArray(empty);
      gl.drawArrays(gl.TRIANGLES, 0, 3);
      gl.bindVertexArray(null);
    },
    /** Resolves with the milliseconds since `began` once the GPU has finished what it was given. */
    finished(began) {
      const fence = gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
      gl.flush();
      return new Promise((resolve) => {
        const look = () => {
          const state = gl.clientWaitSync(fence, 0, 0);
          if (state === gl.TIMEOUT_EXPIRED) return setTimeout(look, 1);
          gl.deleteSync(fence);
          resolve(performance.now() - began);
        };
        setTimeout(look, 0);
      });
    },
  };
}

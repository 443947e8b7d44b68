// The few WebGL2 calls that everything is made of.

export const WIDTH = 4096; // of data textures, in texels; place() in shaders.js knows it

/** A linked program with its uniforms' locations by name; `captured` are varyings that become a buffer. */
export function program(gl, vertex, fragment, captured = []) {
  const made = gl.createProgram();
  for (const [kind, source] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    gl.attachShader(made, shader);
  }
  if (captured.length) gl.transformFeedbackVaryings(made, captured, gl.INTERLEAVED_ATTRIBS);
  gl.linkProgram(made);
  if (!gl.getProgramParameter(made, gl.LINK_STATUS) && !gl.isContextLost()) {
    const log = gl.getAttachedShaders(made).map((shader) => gl.getShaderInfoLog(shader)).join(" ");
    throw new Error(`this browser's WebGL2 cannot run the viewer (${gl.getProgramInfoLog(made)} ${log})`);
  }
  const uniforms = {};
  for (let k = 0; k < gl.getProgramParameter(made, gl.ACTIVE_UNIFORMS); k++) {
    const { name } = gl.getActiveUniform(made, k);
    uniforms[name] = gl.getUniformLocation(made, name);
  }
  return { made, uniforms };
}

/** `texels` texels of four values each as a texture WIDTH wide; `fill(target)` writes them. */
export function dataTexture(gl, texels, kind, fill) {
  const height = Math.max(Math.ceil(texels / WIDTH), 1);
  if (height > gl.getParameter(gl.MAX_TEXTURE_SIZE)) throw new Error("too many Gaussians for this graphics device");
  const data = new kind(4 * WIDTH * height);
  fill(data);
  const texture = gl.createTexture();
  gl.bindTexture(gl.TEXTURE_2D, texture);
  const [internal, format, type] =
    kind === Float32Array ? [gl.RGBA32F, gl.RGBA, gl.FLOAT] : [gl.RGBA32UI, gl.RGBA_INTEGER, gl.UNSIGNED_INT];
  gl.texImage2D(gl.TEXTURE_2D, 0, internal, WIDTH, height, 0, format, type, data);
  unfiltered(gl);
  return texture;
}

export function unfiltered(gl) {
  for (const name of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, name, gl.NEAREST);
  for (const name of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(gl.TEXTURE_2D, name, gl.CLAMP_TO_EDGE);
}

/** A vertex array of float attributes [location, values, offset] out of `buffer`, `stride` floats each, one an instance. */
export function instances(gl, buffer, stride, attributes) {
  const array = gl.createVertexArray();
  gl.bindVertexArray(array);
  gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
  for (const [location, values, offset] of attributes) {
    gl.enableVertexAttribArray(location);
    gl.vertexAttribPointer(location, values, gl.FLOAT, false, 4 * stride, 4 * offset);
    gl.vertexAttribDivisor(location, 1);
  }
  gl.bindVertexArray(null);
  gl.bindBuffer(gl.ARRAY_BUFFER, null);
  return array;
}

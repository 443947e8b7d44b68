// WebGL2 helpers: programs, textures, framebuffers, quads.

export const WIDTH = 2048; // texels per row of data textures, and quads per instance; every WebGL2 device supports it

/** {handle, uniforms}: a linked program, and the locations of its uniforms by name. */
export function program(gl, vertex, fragment) {
  const handle = gl.createProgram();
  for (const [kind, source] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    gl.attachShader(handle, shader);
  }
  gl.linkProgram(handle);
  if (!gl.getProgramParameter(handle, gl.LINK_STATUS) && !gl.isContextLost()) {
    const log = gl.getAttachedShaders(handle).map((shader) => gl.getShaderInfoLog(shader)).join(" ");
    throw new Error(`this browser's WebGL2 cannot compile the viewer's shaders (${gl.getProgramInfoLog(handle)} ${log})`);
  }
  const uniforms = {};
  for (let k = 0; k < gl.getProgramParameter(handle, gl.ACTIVE_UNIFORMS); k++) {
    const { name } = gl.getActiveUniform(handle, k);
    uniforms[name] = gl.getUniformLocation(handle, name);
  }
  return { handle, uniforms };
}

export const heightOf = (texels) => Math.max(Math.ceil(texels / WIDTH), 1);

/** The largest number of texels of a data texture. */
export const maxTexels = (gl) => WIDTH * gl.getParameter(gl.MAX_TEXTURE_SIZE);

/** A texture, WIDTH wide, of `texels` texels of four values; `fill(target)` writes the values. `type`: the array's. */
export function dataTexture(gl, texels, type, fill) {
  const height = heightOf(texels), data = new type(4 * WIDTH * height);
  fill(data);
  if (type === Float32Array) return texture(gl, gl.RGBA32F, WIDTH, height, gl.RGBA, gl.FLOAT, data);
  return texture(gl, gl.RGBA32UI, WIDTH, height, gl.RGBA_INTEGER, gl.UNSIGNED_INT, data);
}

export function texture(gl, internal, width, height, format, type, data = null) {
  const handle = gl.createTexture();
  gl.bindTexture(gl.TEXTURE_2D, handle);
  gl.texImage2D(gl.TEXTURE_2D, 0, internal, width, height, 0, format, type, data);
  for (const name of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, name, gl.NEAREST);
  for (const name of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(gl.TEXTURE_2D, name, gl.CLAMP_TO_EDGE);
  return handle;
}

/** A framebuffer with the textures as its colour attachments. */
export function framebuffer(gl, textures) {
  const handle = gl.createFramebuffer();
  gl.bindFramebuffer(gl.FRAMEBUFFER, handle);
  textures.forEach((each, k) => gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0 + k, gl.TEXTURE_2D, each, 0));
  gl.drawBuffers(textures.map((_, k) => gl.COLOR_ATTACHMENT0 + k));
  if (gl.checkFramebufferStatus(gl.FRAMEBUFFER) !== gl.FRAMEBUFFER_COMPLETE && !gl.isContextLost()) {
    throw new Error("this graphics device lacks the formats or the memory that the viewer needs; try another browser or device");
  }
  return handle;
}

/** Binds textures to units 0, 1, 2.. and sets the program's samplers; `textures` is by the names of these. */
export function bindTextures(gl, uniforms, textures) {
  Object.entries(textures).forEach(([name, each], unit) => {
    gl.activeTexture(gl.TEXTURE0 + unit);
    gl.bindTexture(gl.TEXTURE_2D, each);
    if (uniforms[name]) gl.uniform1i(uniforms[name], unit);
  });
}

/** A vertex array of WIDTH quads with corners by gl_VertexID: few large instances are faster than many small ones. */
export function quads(gl) {
  const array = gl.createVertexArray(), indices = new Uint16Array(6 * WIDTH);
  for (let k = 0; k < WIDTH; k++) indices.set([0, 1, 2, 2, 1, 3].map((corner) => 4 * k + corner), 6 * k);
  gl.bindVertexArray(array);
  gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
  gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, indices, gl.STATIC_DRAW);
  gl.bindVertexArray(null);
  return array;
}

// WebGL2 helpers: programs, textures, framebuffers, uniforms.

export const WIDTH = 2048; // texels per row of data textures; every WebGL2 device supports it

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
    throw new Error(`this browser's WebGL2 cannot compile the viewer's shaders (${gl.getProgramInfoLog(handle)})`);
  }
  const uniforms = {};
  for (let k = 0; k < gl.getProgramParameter(handle, gl.ACTIVE_UNIFORMS); k++) {
    const { name } = gl.getActiveUniform(handle, k);
    uniforms[name] = gl.getUniformLocation(handle, name);
  }
  return { handle, uniforms };
}

export const heightOf = (texels) => Math.max(Math.ceil(texels / WIDTH), 1);

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
  return handle;
}

/** A framebuffer with so many textures of a kind; `resize` makes them anew where they have another size. */
export function target(gl, count, internal, format, type) {
  const made = { textures: [], handle: null, width: 0, height: 0 };
  made.resize = (width, height) => {
    if (made.width === width && made.height === height) return;
    for (const old of made.textures) gl.deleteTexture(old);
    gl.deleteFramebuffer(made.handle);
    const textures = Array.from({ length: count }, () => texture(gl, internal, width, height, format, type));
    Object.assign(made, { width, height, textures, handle: gl.createFramebuffer() });
    gl.bindFramebuffer(gl.FRAMEBUFFER, made.handle);
    const points = textures.map((_, k) => gl.COLOR_ATTACHMENT0 + k);
    textures.forEach((each, k) => gl.framebufferTexture2D(gl.FRAMEBUFFER, points[k], gl.TEXTURE_2D, each, 0));
    gl.drawBuffers(points);
    if (gl.checkFramebufferStatus(gl.FRAMEBUFFER) === gl.FRAMEBUFFER_COMPLETE || gl.isContextLost()) return;
    throw new Error("this graphics device lacks the formats or the memory that the viewer needs; try another browser or device");
  };
  return made;
}

/** Sets uniforms that are numbers, vectors or bools, and samplers: textures are bound to units 0, 1, 2.. */
export function set(gl, uniforms, values, textures) {
  for (const [name, value] of Object.entries(values)) {
    const numbers = [value].flat().map(Number);
    gl[`uniform${numbers.length}fv`](uniforms[name], numbers);
  }
  Object.entries(textures).forEach(([name, each], unit) => {
    gl.activeTexture(gl.TEXTURE0 + unit);
    gl.bindTexture(gl.TEXTURE_2D, each);
    gl.uniform1i(uniforms[name], unit);
  });
}

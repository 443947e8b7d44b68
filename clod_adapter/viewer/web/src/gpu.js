// The few WebGL2 calls that everything is made of.

export const WIDTH = 2048; // of data textures, in texels, and the quads of an instance; any WebGL2 device has it

/** A linked program with its uniforms' locations by name. */
export function program(gl, vertex, fragment) {
  const made = gl.createProgram();
  for (const [kind, source] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    gl.attachShader(made, shader);
  }
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

export const heightOf = (texels) => Math.max(Math.ceil(texels / WIDTH), 1);

/** How many texels a data texture may have. */
export const mostTexels = (gl) => WIDTH * gl.getParameter(gl.MAX_TEXTURE_SIZE);

/** `texels` texels of four values each as a texture WIDTH wide; `fill(target)` writes them. */
export function dataTexture(gl, texels, kind, fill) {
  const height = heightOf(texels), data = new kind(4 * WIDTH * height);
  fill(data);
  if (kind === Float32Array) return texture(gl, gl.RGBA32F, WIDTH, height, gl.RGBA, gl.FLOAT, data);
  return texture(gl, gl.RGBA32UI, WIDTH, height, gl.RGBA_INTEGER, gl.UNSIGNED_INT, data);
}

export function texture(gl, internal, width, height, format, type, data = null) {
  const made = gl.createTexture();
  gl.bindTexture(gl.TEXTURE_2D, made);
  gl.texImage2D(gl.TEXTURE_2D, 0, internal, width, height, 0, format, type, data);
  for (const name of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, name, gl.NEAREST);
  for (const name of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(gl.TEXTURE_2D, name, gl.CLAMP_TO_EDGE);
  return made;
}

/** A framebuffer that draws into the textures. */
export function framebuffer(gl, textures) {
  const made = gl.createFramebuffer();
  gl.bindFramebuffer(gl.FRAMEBUFFER, made);
  textures.forEach((each, k) => gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0 + k, gl.TEXTURE_2D, each, 0));
  gl.drawBuffers(textures.map((_, k) => gl.COLOR_ATTACHMENT0 + k));
  if (gl.checkFramebufferStatus(gl.FRAMEBUFFER) !== gl.FRAMEBUFFER_COMPLETE && !gl.isContextLost()) {
    throw new Error("this graphics device cannot draw what the viewer draws, or has too little memory for it");
  }
  return made;
}

/** Binds textures to units 0, 1, 2.. by the names that a program has for them. */
export function bindTextures(gl, uniforms, textures) {
  Object.entries(textures).forEach(([name, each], unit) => {
    gl.activeTexture(gl.TEXTURE0 + unit);
    gl.bindTexture(gl.TEXTURE_2D, each);
    if (uniforms[name]) gl.uniform1i(uniforms[name], unit);
  });
}

/** A vertex array of WIDTH quads, their corners numbered in gl_VertexID: few large instances are faster than many small. */
export function quads(gl) {
  const array = gl.createVertexArray(), indices = new Uint16Array(6 * WIDTH);
  for (let k = 0; k < WIDTH; k++) indices.set([0, 1, 2, 2, 1, 3].map((corner) => 4 * k + corner), 6 * k);
  gl.bindVertexArray(array);
  gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
  gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, indices, gl.STATIC_DRAW);
  gl.bindVertexArray(null);
  return array;
}

// Draw the scene with WebGL2: points into a texture, then eye-dome lighting from their depths (Boucheny 2009).

const GROUND = [20, 22, 27]; // dark: diverging maps are lightest in their middle

const POINT_VERTEX = `#version 300 es
layout(location = 0) in vec4 code;
layout(location = 1) in float level;
uniform mat4 matrix;
uniform vec3 offset, cell, clipLow, clipHigh;
uniform float size, smallest, largest;
uniform sampler2D palette;
flat out vec3 color;
void main() {
  vec3 at = offset + cell * code.xyz;
  gl_Position = matrix * vec4(at, 1.0);
  if (any(lessThan(at, clipLow)) || any(greaterThan(at, clipHigh))) gl_Position = vec4(0.0, 0.0, 2.0, 1.0);
  gl_PointSize = clamp(size / gl_Position.w, smallest, largest);
  color = texelFetch(palette, ivec2(int(level), 0), 0).rgb;
}`;

const POINT_FRAGMENT = `#version 300 es
precision mediump float;
flat in vec3 color;
out vec4 result;
void main() {
  vec2 at = 2.0 * gl_PointCoord - 1.0;
  if (dot(at, at) > 1.1) discard;
  result = vec4(color, 1.0);
}`;

const LINE_VERTEX = `#version 300 es
layout(location = 0) in vec3 at;
uniform mat4 matrix;
uniform vec2 shift;
void main() {
  gl_Position = matrix * vec4(at, 1.0);
  gl_Position.xy += shift * gl_Position.w;
}`;

const LINE_FRAGMENT = `#version 300 es
precision mediump float;
uniform vec3 color;
out vec4 result;
void main() { result = vec4(color, 1.0); }`;

const SCREEN_VERTEX = `#version 300 es
void main() { gl_Position = vec4(vec2((gl_VertexID << 1) & 2, gl_VertexID & 2) * 2.0 - 1.0, 0.0, 1.0); }`;

const SCREEN_FRAGMENT = `#version 300 es
precision highp float;
uniform sampler2D colors;
uniform highp sampler2D depths;
uniform vec2 range; // near, far
uniform float strength, reach;
out vec4 result;
float logDepth(ivec2 at) {
  float z = texelFetch(depths, clamp(at, ivec2(0), textureSize(depths, 0) - 1), 0).r;
  return z >= 1.0 ? 1e3 : log2(2.0 * range.x * range.y / (range.y + range.x - (2.0 * z - 1.0) * (range.y - range.x)));
}
void main() {
  ivec2 at = ivec2(gl_FragCoord.xy);
  vec4 color = texelFetch(colors, at, 0);
  float here = logDepth(at), sum = 0.0;
  if (strength > 0.0 && here < 1e3) {
    for (int k = 0; k < 8; k++) {
      float angle = 0.7853981634 * float(k);
      sum += max(0.0, here - logDepth(at + ivec2(round(reach * vec2(cos(angle), sin(angle))))));
    }
    color.rgb *= exp(-strength * sum / 8.0);
  }
  result = color;
}`;

class WebglRenderer {
  constructor(canvas) {
    const gl = canvas.getContext("webgl2", { antialias: false, preserveDrawingBuffer: true, alpha: false });
    if (!gl) throw new Error("no WebGL2");
    this.canvas = canvas;
    this.gl = gl;
    this.points = program(gl, POINT_VERTEX, POINT_FRAGMENT);
    this.lines = program(gl, LINE_VERTEX, LINE_FRAGMENT);
    this.screen = program(gl, SCREEN_VERTEX, SCREEN_FRAGMENT);
    this.target = gl.createFramebuffer();
    this.colors = texture(gl);
    this.depths = texture(gl);
    this.palette = texture(gl);
    this.lineBuffer = gl.createBuffer();
    this.buffers = new Map(); // of each layer
  }

  // Draw panes {views, x, y, width, height}, in pixels from the upper left corner, all with the same camera.
  draw(scene, camera, panes) {
    const gl = this.gl;
    const { width, height } = this.canvas;
    this.resize(width, height);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.target);
    gl.disable(gl.SCISSOR_TEST);
    gl.clearColor(...GROUND.map((c) => c / 255), 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.enable(gl.DEPTH_TEST);
    for (const pane of panes) {
      this.aim(pane);
      for (const view of pane.views) this.drawPoints(scene, view, camera.matrix(pane.width / pane.height), pane.height);
    }
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.disable(gl.DEPTH_TEST);
    gl.disable(gl.SCISSOR_TEST);
    gl.viewport(0, 0, width, height);
    const { near, far } = camera.depths();
    gl.useProgram(this.screen.program);
    gl.activeTexture(gl.TEXTURE0);
    gl.bindTexture(gl.TEXTURE_2D, this.colors);
    gl.activeTexture(gl.TEXTURE1);
    gl.bindTexture(gl.TEXTURE_2D, this.depths);
    gl.uniform1i(this.screen.colors, 0);
    gl.uniform1i(this.screen.depths, 1);
    gl.uniform2f(this.screen.range, near, far);
    gl.uniform1f(this.screen.strength, scene.lighting ? 20 : 0);
    gl.uniform1f(this.screen.reach, Math.max(1, 1.4 * scene.pixelRatio));
    gl.bindVertexArray(null);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
    for (const pane of panes) {
      this.aim(pane);
      for (const lines of linesOf(scene, pane.views)) this.drawLines(lines, camera, pane);
    }
  }

  // Draw only inside a pane.
  aim({ x, y, width, height }) {
    const box = [x, this.canvas.height - y - height, width, height];
    this.gl.viewport(...box);
    this.gl.scissor(...box);
    this.gl.enable(this.gl.SCISSOR_TEST);
  }

  drawPoints(scene, view, matrix, height) {
    const gl = this.gl;
    const { layer } = view;
    const buffers = this.upload(layer);
    const scalar = scene.scalarOf(view);
    gl.useProgram(this.points.program);
    gl.bindVertexArray(buffers.vertices);
    if (scalar >= 0) {
      gl.bindBuffer(gl.ARRAY_BUFFER, buffers.scalars[scalar]);
      gl.enableVertexAttribArray(1);
      gl.vertexAttribPointer(1, 1, gl.UNSIGNED_BYTE, false, 0, 0);
    } else {
      gl.disableVertexAttribArray(1);
      gl.vertexAttrib1f(1, 0);
    }
    gl.activeTexture(gl.TEXTURE0);
    gl.bindTexture(gl.TEXTURE_2D, this.palette);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA8, 256, 1, 0, gl.RGBA, gl.UNSIGNED_BYTE, scene.palette(view));
    gl.uniform1i(this.points.palette, 0);
    gl.uniformMatrix4fv(this.points.matrix, false, matrix);
    gl.uniform3fv(this.points.offset, layer.offset);
    gl.uniform3fv(this.points.cell, layer.head.step);
    gl.uniform3fv(this.points.clipLow, scene.clip.low);
    gl.uniform3fv(this.points.clipHigh, scene.clip.high);
    const { size, smallest, largest } = scene.pointPixels(layer, height);
    gl.uniform1f(this.points.size, size);
    gl.uniform1f(this.points.smallest, smallest);
    gl.uniform1f(this.points.largest, largest);
    gl.drawArrays(gl.POINTS, 0, layer.head.shown);
  }

  drawLines({ color, width: lineWidth, ends }, camera, { width, height }) {
    const gl = this.gl;
    gl.useProgram(this.lines.program);
    gl.bindVertexArray(null);
    gl.bindBuffer(gl.ARRAY_BUFFER, this.lineBuffer);
    gl.bufferData(gl.ARRAY_BUFFER, ends, gl.DYNAMIC_DRAW);
    gl.enableVertexAttribArray(0);
    gl.vertexAttribPointer(0, 3, gl.FLOAT, false, 0, 0);
    gl.uniformMatrix4fv(this.lines.matrix, false, camera.matrix(width / height));
    gl.uniform3fv(this.lines.color, color.map((c) => c / 255));
    // Lines are one pixel wide; wider ones are drawn next to each other.
    for (const [across, down] of lineWidth > 1 ? [[0, 0], [1, 0], [0, 1]] : [[0, 0]]) {
      gl.uniform2f(this.lines.shift, (2 * across) / width, (2 * down) / height);
      gl.drawArrays(gl.LINES, 0, ends.length / 3);
    }
    gl.disableVertexAttribArray(0);
  }

  upload(layer) {
    if (this.buffers.has(layer)) return this.buffers.get(layer);
    const gl = this.gl;
    const filled = (data) => {
      const buffer = gl.createBuffer();
      gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
      gl.bufferData(gl.ARRAY_BUFFER, data, gl.STATIC_DRAW);
      return buffer;
    };
    const vertices = gl.createVertexArray();
    gl.bindVertexArray(vertices);
    filled(layer.codes);
    gl.enableVertexAttribArray(0);
    gl.vertexAttribPointer(0, 4, gl.UNSIGNED_SHORT, false, 0, 0);
    const buffers = { vertices, scalars: layer.scalars.map(filled) };
    this.buffers.set(layer, buffers);
    return buffers;
  }

  resize(width, height) {
    if (this.width === width && this.height === height) return;
    [this.width, this.height] = [width, height];
    const gl = this.gl;
    gl.bindTexture(gl.TEXTURE_2D, this.colors);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA8, width, height, 0, gl.RGBA, gl.UNSIGNED_BYTE, null);
    gl.bindTexture(gl.TEXTURE_2D, this.depths);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.DEPTH_COMPONENT24, width, height, 0, gl.DEPTH_COMPONENT, gl.UNSIGNED_INT, null);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.target);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, this.colors, 0);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.DEPTH_ATTACHMENT, gl.TEXTURE_2D, this.depths, 0);
  }

  // Wait until the picture is complete, without blocking the page.
  async finished() {
    const gl = this.gl;
    const sync = gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
    gl.flush();
    while (!gl.isContextLost() && gl.getSyncParameter(sync, gl.SYNC_STATUS) !== gl.SIGNALED) {
      await new Promise((done) => setTimeout(done, 4));
    }
    gl.deleteSync(sync);
  }

  // Return the colour [r, g, b] of a pixel, counted from the upper left corner.
  pixel(x, y) {
    const gl = this.gl;
    const found = new Uint8Array(4);
    gl.readPixels(x, this.canvas.height - 1 - y, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, found);
    return [...found.slice(0, 3)];
  }
}

// Compile a program; its uniforms become properties.
function program(gl, vertex, fragment) {
  const linked = gl.createProgram();
  for (const [kind, source] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    gl.attachShader(linked, shader);
  }
  gl.linkProgram(linked);
  if (!gl.getProgramParameter(linked, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(linked));
  const result = { program: linked };
  for (let k = 0; k < gl.getProgramParameter(linked, gl.ACTIVE_UNIFORMS); k++) {
    const { name } = gl.getActiveUniform(linked, k);
    result[name] = gl.getUniformLocation(linked, name);
  }
  return result;
}

function texture(gl) {
  const made = gl.createTexture();
  gl.bindTexture(gl.TEXTURE_2D, made);
  for (const name of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, name, gl.NEAREST);
  for (const name of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(gl.TEXTURE_2D, name, gl.CLAMP_TO_EDGE);
  return made;
}

// A view of a map's points: plain WebGL2, drawn when something changes, shaded by depth alone.

const POINT_VERTEX = `#version 300 es
in vec3 place; in vec3 colour; in uint owner;
uniform mat4 camera; uniform vec3 origin; uniform float spread, cut, pixels;
uniform int chosen;
out vec3 tint; flat out uint key;
void main() {
  vec3 world = origin + place * spread;
  gl_Position = camera * vec4(world, 1.0);
  gl_PointSize = clamp(pixels / gl_Position.w, 1.5, 40.0);
  bool other = chosen >= 0 && owner != uint(chosen);
  tint = other ? mix(colour, vec3(dot(colour, vec3(0.33)) * 0.4 + 0.4), 0.75) : colour;
  key = owner + 1u;
  if (world.z > cut) gl_Position = vec4(2.0, 2.0, 2.0, 1.0);
}`;
const POINT_FRAGMENT = `#version 300 es
precision mediump float;
in vec3 tint; flat in highp uint key;
layout(location = 0) out vec4 shown; layout(location = 1) out vec4 picked;
void main() {
  vec2 off = gl_PointCoord - 0.5;
  if (dot(off, off) > 0.25) discard;
  shown = vec4(tint, 1.0);
  picked = vec4(float(key & 255u), float((key >> 8) & 255u), 255.0, 255.0) / 255.0;
}`;
const SHADE_VERTEX = `#version 300 es
void main() { gl_Position = vec4(gl_VertexID == 1 ? 3.0 : -1.0, gl_VertexID == 2 ? 3.0 : -1.0, 0.0, 1.0); }`;
// Eye-dome lighting: a pixel is darker the farther it lies behind its neighbours.
const SHADE_FRAGMENT = `#version 300 es
precision highp float;
uniform sampler2D shown, depth; uniform float near, far, reach; uniform vec3 paper;
out vec4 result;
float distanceAt(ivec2 at) {
  float z = texelFetch(depth, clamp(at, ivec2(0), textureSize(depth, 0) - 1), 0).r;
  return z >= 1.0 ? 1e6 : near * far / (far - z * (far - near));
}
void main() {
  ivec2 at = ivec2(gl_FragCoord.xy);
  float own = distanceAt(at);
  if (own > 9e5) { result = vec4(paper, 1.0); return; }
  float behind = 0.0;
  int r = int(reach);
  for (int i = 0; i < 8; i++) {
    ivec2 side = ivec2((i % 4 == 0 ? 0 : i < 4 ? 1 : -1), (i % 4 == 2 ? 0 : (i + 2) % 8 < 4 ? 1 : -1)) * r;
    behind += clamp(log2(own) - log2(distanceAt(at + side)) - 0.006, 0.0, 0.04);
  }
  result = vec4(texelFetch(shown, at, 0).rgb * exp(-6.0 * behind), 1.0);
}`;
const FIELD_OF_VIEW = 0.8, TURN = 0.12, NO_OWNER = 0xffff;

function mapView(canvas, { onPick, onLost }) {
  const gl = canvas.getContext('webgl2', { antialias: false });
  if (!gl) return null;
  const eye = { target: [0, 0, 0], distance: 8, azimuth: 0.7, elevation: 0.75 };
  let made = null, cloud = null, colours = null, cut = Infinity, chosen = -1, pending = false, paper = [1, 1, 1];

  function program(vertex, fragment) {
    const linked = gl.createProgram();
    for (const [kind, source] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, source);
      gl.compileShader(shader);
      gl.attachShader(linked, shader);
    }
    gl.linkProgram(linked);
    if (gl.getProgramParameter(linked, gl.LINK_STATUS) || gl.isContextLost()) return linked;
    throw new Error(gl.getProgramInfoLog(linked));
  }
  function make() {
    const points = program(POINT_VERTEX, POINT_FRAGMENT), shade = program(SHADE_VERTEX, SHADE_FRAGMENT);
    const at = (name) => gl.getUniformLocation(points, name), of = (name) => gl.getUniformLocation(shade, name);
    const all = (names, place) => Object.fromEntries(names.map((name) => [name, place(name)]));
    made = {
      points, shade, array: gl.createVertexArray(), nothing: gl.createVertexArray(), frame: gl.createFramebuffer(),
      size: [0, 0],
      buffers: [gl.createBuffer(), gl.createBuffer(), gl.createBuffer()],
      textures: [gl.createTexture(), gl.createTexture(), gl.createTexture()],
      uniforms: all(['camera', 'origin', 'spread', 'cut', 'pixels', 'chosen'], at),
      shades: all(['shown', 'depth', 'near', 'far', 'reach', 'paper'], of),
    };
  }
  function resize() {
    const ratio = Math.min(2, window.devicePixelRatio || 1);
    const size = [canvas.clientWidth, canvas.clientHeight].map((length) => Math.max(1, Math.round(length * ratio)));
    if (canvas.width !== size[0] || canvas.height !== size[1]) [canvas.width, canvas.height] = size;
    if (made.size[0] === size[0] && made.size[1] === size[1]) return;
    made.size = size;
    const formats = [[gl.RGBA8, gl.RGBA, gl.UNSIGNED_BYTE], [gl.RGBA8, gl.RGBA, gl.UNSIGNED_BYTE],
      [gl.DEPTH_COMPONENT24, gl.DEPTH_COMPONENT, gl.UNSIGNED_INT]];
    const places = [gl.COLOR_ATTACHMENT0, gl.COLOR_ATTACHMENT1, gl.DEPTH_ATTACHMENT];
    gl.bindFramebuffer(gl.FRAMEBUFFER, made.frame);
    formats.forEach(([inside, format, type], k) => {
      gl.bindTexture(gl.TEXTURE_2D, made.textures[k]);
      gl.texImage2D(gl.TEXTURE_2D, 0, inside, size[0], size[1], 0, format, type, null);
      gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
      gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
      gl.framebufferTexture2D(gl.FRAMEBUFFER, places[k], gl.TEXTURE_2D, made.textures[k], 0);
    });
    gl.drawBuffers([gl.COLOR_ATTACHMENT0, gl.COLOR_ATTACHMENT1]);
  }
  function upload() {
    if (!cloud) return;
    gl.bindVertexArray(made.array);
    const place = (name) => gl.getAttribLocation(made.points, name);
    gl.bindBuffer(gl.ARRAY_BUFFER, made.buffers[0]);
    gl.bufferData(gl.ARRAY_BUFFER, cloud.positions, gl.STATIC_DRAW);
    gl.enableVertexAttribArray(place('place'));
    gl.vertexAttribPointer(place('place'), 3, gl.UNSIGNED_SHORT, false, 0, 0);
    gl.bindBuffer(gl.ARRAY_BUFFER, made.buffers[1]);
    gl.bufferData(gl.ARRAY_BUFFER, cloud.owner, gl.STATIC_DRAW);
    gl.enableVertexAttribArray(place('owner'));
    gl.vertexAttribIPointer(place('owner'), 1, gl.UNSIGNED_SHORT, 0, 0);
    paint();
  }
  function paint() {
    if (!colours || gl.isContextLost()) return;
    gl.bindVertexArray(made.array);
    gl.bindBuffer(gl.ARRAY_BUFFER, made.buffers[2]);
    gl.bufferData(gl.ARRAY_BUFFER, colours, gl.DYNAMIC_DRAW);
    const place = gl.getAttribLocation(made.points, 'colour');
    gl.enableVertexAttribArray(place);
    gl.vertexAttribPointer(place, 3, gl.UNSIGNED_BYTE, true, 0, 0);
    redraw();
  }
  function axes() {
    const { azimuth: a, elevation: e } = eye;
    const back = [Math.cos(a) * Math.cos(e), Math.sin(a) * Math.cos(e), Math.sin(e)];
    const right = [-Math.sin(a), Math.cos(a), 0];
    const up = [-Math.cos(a) * Math.sin(e), -Math.sin(a) * Math.sin(e), Math.cos(e)];
    return { back, right, up };
  }
  const range = () => [Math.max(0.05, eye.distance / 100), eye.distance * 4 + 40];
  function matrix() {
    const { back, right, up } = axes(), [near, far] = range(), f = 1 / Math.tan(FIELD_OF_VIEW / 2);
    const wide = canvas.width / canvas.height, p = eye.target.map((v, i) => v + back[i] * eye.distance);
    const dot = (u) => -(u[0] * p[0] + u[1] * p[1] + u[2] * p[2]);
    const rows = [[...right, dot(right)], [...up, dot(up)], [...back, dot(back)]];
    const out = new Float32Array(16), a = (far + near) / (near - far), b = (2 * far * near) / (near - far);
    for (let k = 0; k < 4; k++) {
      out[4 * k] = (rows[0][k] * f) / Math.max(wide, 1e-6);
      out[4 * k + 1] = rows[1][k] * f;
      out[4 * k + 2] = a * rows[2][k] + (k === 3 ? b : 0);
      out[4 * k + 3] = -rows[2][k];
    }
    return out;
  }
  function draw() {
    pending = false;
    if (gl.isContextLost() || !canvas.clientWidth) return;
    resize();
    const [near, far] = range();
    gl.bindFramebuffer(gl.FRAMEBUFFER, made.frame);
    gl.viewport(0, 0, ...made.size);
    gl.enable(gl.DEPTH_TEST);
    gl.clearBufferfv(gl.COLOR, 0, [0, 0, 0, 0]);
    gl.clearBufferfv(gl.COLOR, 1, [0, 0, 0, 0]);
    gl.clearBufferfv(gl.DEPTH, 0, [1]);
    if (cloud && cloud.n) {
      gl.useProgram(made.points);
      gl.bindVertexArray(made.array);
      gl.uniformMatrix4fv(made.uniforms.camera, false, matrix());
      gl.uniform3fv(made.uniforms.origin, cloud.origin);
      gl.uniform1f(made.uniforms.spread, cloud.step);
      gl.uniform1f(made.uniforms.cut, Math.min(cut, 1e9));
      gl.uniform1f(made.uniforms.pixels, (1.75 * cloud.spacing * made.size[1]) / (2 * Math.tan(FIELD_OF_VIEW / 2)));
      gl.uniform1i(made.uniforms.chosen, chosen);
      gl.drawArrays(gl.POINTS, 0, cloud.n);
    }
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.viewport(0, 0, ...made.size);
    gl.disable(gl.DEPTH_TEST);
    gl.useProgram(made.shade);
    gl.bindVertexArray(made.nothing);
    [['shown', 0], ['depth', 2]].forEach(([name, k], unit) => {
      gl.activeTexture(gl.TEXTURE0 + unit);
      gl.bindTexture(gl.TEXTURE_2D, made.textures[k]);
      gl.uniform1i(made.shades[name], unit);
    });
    gl.uniform1f(made.shades.near, near);
    gl.uniform1f(made.shades.far, far);
    gl.uniform1f(made.shades.reach, Math.max(1, Math.round(made.size[1] / 500)));
    gl.uniform3fv(made.shades.paper, paper);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }
  function redraw() {
    if (!pending) { pending = true; requestAnimationFrame(draw); }
  }
  // Reads without making the processor wait for the graphics card: into a buffer first, from it once a fence is passed.
  async function pickAt(x, y) {
    if (!cloud || gl.isContextLost()) return;
    draw();
    const ratio = canvas.width / canvas.clientWidth, reach = 3, side = 2 * reach + 1, mine = cloud;
    const pixels = new Uint8Array(side * side * 4), buffer = gl.createBuffer();
    gl.bindBuffer(gl.PIXEL_PACK_BUFFER, buffer);
    gl.bufferData(gl.PIXEL_PACK_BUFFER, pixels.length, gl.STREAM_READ);
    gl.bindFramebuffer(gl.FRAMEBUFFER, made.frame);
    gl.readBuffer(gl.COLOR_ATTACHMENT1);
    const left = Math.round(x * ratio) - reach, bottom = Math.round(canvas.height - y * ratio) - reach;
    gl.readPixels(left, bottom, side, side, gl.RGBA, gl.UNSIGNED_BYTE, 0);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.bindBuffer(gl.PIXEL_PACK_BUFFER, null);
    const fence = gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
    gl.flush();
    const isPassed = () => gl.isContextLost() || gl.clientWaitSync(fence, 0, 0) !== gl.TIMEOUT_EXPIRED;
    while (!isPassed()) await new Promise((done) => setTimeout(done, 5));
    if (gl.isContextLost() || mine !== cloud) return;
    gl.deleteSync(fence);
    gl.bindBuffer(gl.PIXEL_PACK_BUFFER, buffer);
    gl.getBufferSubData(gl.PIXEL_PACK_BUFFER, 0, pixels);
    gl.bindBuffer(gl.PIXEL_PACK_BUFFER, null);
    gl.deleteBuffer(buffer);
    // The pixel itself first, then its surroundings.
    const away = (k) => Math.hypot((k % side) - reach, Math.floor(k / side) - reach);
    const hit = [...Array(side * side).keys()].sort((a, b) => away(a) - away(b)).find((k) => pixels[4 * k + 2]);
    const owner = hit === undefined ? NO_OWNER : pixels[4 * hit] + 256 * pixels[4 * hit + 1] - 1;
    onPick(owner === NO_OWNER || owner < 0 ? -1 : owner);
  }
  function turn(across, along) {
    eye.azimuth -= across;
    eye.elevation = Math.min(1.56, Math.max(-1.2, eye.elevation + along));
    redraw();
  }
  function zoom(factor) {
    eye.distance = Math.min(200, Math.max(0.2, eye.distance * factor));
    redraw();
  }
  function pan(across, along) {
    // In shares of the height of the view.
    const { right, up } = axes(), size = 2 * eye.distance * Math.tan(FIELD_OF_VIEW / 2);
    eye.target = eye.target.map((v, i) => v - size * (across * right[i] - along * up[i]));
    redraw();
  }
  function whole() {
    if (!cloud || !cloud.n) return;
    const size = cloud.high.map((v, i) => v - cloud.low[i]);
    const wide = canvas.clientWidth / Math.max(1, canvas.clientHeight);
    eye.target = cloud.low.map((v, i) => v + size[i] * (i === 2 ? 0.35 : 0.5));
    eye.distance = (0.5 * Math.hypot(...size) * 0.92) / Math.sin(FIELD_OF_VIEW / 2) / Math.min(1, Math.max(0.45, wide));
    eye.azimuth = size[0] > size[1] ? -Math.PI / 2 + 0.5 : 0.5;
    eye.elevation = 0.85;
    redraw();
  }

  const held = new Map();
  let moved = 0;
  canvas.addEventListener('pointerdown', (event) => {
    canvas.setPointerCapture(event.pointerId);
    held.set(event.pointerId, [event.clientX, event.clientY]);
    if (held.size === 1) moved = 0;
  });
  canvas.addEventListener('pointermove', (event) => {
    const before = held.get(event.pointerId);
    if (!before) return;
    const now = [event.clientX, event.clientY], height = canvas.clientHeight;
    const across = now[0] - before[0], along = now[1] - before[1];
    moved += Math.abs(across) + Math.abs(along);
    if (held.size === 2) {
      const other = [...held].find(([id]) => id !== event.pointerId)[1];
      const [was, is] = [before, now].map((place) => Math.hypot(place[0] - other[0], place[1] - other[1]));
      if (was > 1 && is > 1) zoom(was / is);
      pan(across / 2 / height, along / 2 / height);
    } else if (event.buttons & 2 || event.shiftKey) pan(across / height, along / height);
    else turn((across / height) * 3, (along / height) * 3);
    held.set(event.pointerId, now);
  });
  const release = (event) => {
    const was = held.delete(event.pointerId);
    if (was && event.type === 'pointerup' && moved < 6 && !held.size) {
      const box = canvas.getBoundingClientRect();
      pickAt(event.clientX - box.left, event.clientY - box.top);
    }
  };
  canvas.addEventListener('pointerup', release);
  canvas.addEventListener('pointercancel', release);
  canvas.addEventListener('contextmenu', (event) => event.preventDefault());
  canvas.addEventListener('wheel', (event) => {
    // Until the view was clicked, the wheel scrolls the page.
    if (document.activeElement !== canvas) return;
    event.preventDefault();
    zoom(Math.exp(Math.max(-60, Math.min(60, event.deltaY)) * 0.004));
  }, { passive: false });
  canvas.addEventListener('keydown', (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const steps = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
    const step = steps[event.key];
    if (step && event.shiftKey) pan(-step[0] * 0.06, -step[1] * 0.06);
    else if (step) turn(step[0] * TURN, -step[1] * TURN);
    else if (event.key === '+' || event.key === '=') zoom(1 / 1.15);
    else if (event.key === '-') zoom(1.15);
    else if (event.key === 'Home' || event.key === '0') whole();
    else if (event.key === 'Enter') pickAt(canvas.clientWidth / 2, canvas.clientHeight / 2);
    else return;
    event.preventDefault();
  });
  canvas.addEventListener('webglcontextlost', (event) => { event.preventDefault(); onLost(true); });
  canvas.addEventListener('webglcontextrestored', () => { make(); upload(); onLost(false); });
  new ResizeObserver(redraw).observe(canvas);
  make();

  return {
    eye, redraw, zoom, turn, pan, whole,
    show(next) { cloud = next; colours = null; chosen = -1; upload(); whole(); },
    colour(next) { colours = next; paint(); },
    choose(instance) { chosen = instance; redraw(); },
    cutAt(height) { cut = height; redraw(); },
    onPaper(rgb) { paper = rgb; redraw(); },
    lookAt(centre, size) { eye.target = [...centre]; eye.distance = Math.max(1.2, 2.6 * size); redraw(); },
  };
}

// The content of a map, as reports/html_map.py packs it.
async function unpackMap(text) {
  const bytes = Uint8Array.from(atob(text.trim()), (c) => c.charCodeAt(0));
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream('deflate'));
  const data = new Uint8Array(await new Response(stream).arrayBuffer());
  const length = new DataView(data.buffer).getUint32(0, true);
  const about = JSON.parse(new TextDecoder().decode(data.subarray(4, 4 + length)));
  let at = 4 + length;
  const planes = {};
  for (const plane of about.planes) {
    const { n } = about, { bytes: size, width } = plane;
    const values = size === 2 ? new Uint16Array(n * width) : new Uint8Array(n * width);
    for (let column = 0; column < width; column++) {
      for (let k = 0; k < n; k++) values[k * width + column] = data[at + k] + (size === 2 ? 256 * data[at + n + k] : 0);
      at += n * size;
    }
    planes[plane.name] = values;
  }
  const positions = planes.position;
  const most = [0, 0, 0];
  for (let k = 0; k < positions.length; k++) {
    if (k > 2) positions[k] += positions[k - 3]; // modulo 2 ** 16, as the type itself has it
    most[k % 3] = Math.max(most[k % 3], positions[k]);
  }
  const { owner, colour, truth, class: classOfPoint } = planes;
  return { ...about, positions, owner, colour, truth, classOfPoint,
    low: about.origin, high: about.origin.map((v, i) => v + most[i] * about.step) };
}

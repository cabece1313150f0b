// A view of a map's points: plain WebGL 2, drawn only on changes, shaded by depth only.

const FIELD_OF_VIEW = 0.8, TURN = 0.12, NO_OWNER = 0xffff, GHOST = [0.86, 0.16, 0.55];
const DRAWN = { behind: 0, before: 1, all: 2 };
const LIMITS = { distance: [0.2, 200], elevation: [-1.2, 1.56] };
const within = (value, [low, high]) => Math.min(high, Math.max(low, value));

// Views that share an `eye` move together: `onMove` is called after this view has moved it.
function mapView(canvas, { eye, onMove, onPick, onHover, onLost }) {
  const gl = canvas.getContext('webgl2', { antialias: false });
  if (!gl) return null;
  let made = null, cloud = null, colours = null, born = null, ghosts = null;
  let cut = Infinity, now = NO_OWNER, chosen = -1, fades = true, pending = false, paper = [1, 1, 1];

  function make() {
    const points = linkedProgram(gl, POINT_VERTEX, POINT_FRAGMENT);
    const shade = linkedProgram(gl, SHADE_VERTEX, SHADE_FRAGMENT);
    const all = (program, names) =>
      Object.fromEntries(names.map((name) => [name, gl.getUniformLocation(program, name)]));
    made = {
      points, shade, nothing: gl.createVertexArray(), size: [0, 0], solid: pictureLayer(gl), thin: pictureLayer(gl),
      own: pointBuffers(gl, points), ghosts: pointBuffers(gl, points),
      uniforms: all(points, ['camera', 'origin', 'eye', 'spread', 'cut', 'pixels', 'chosen', 'only', 'now', 'opacity',
        'mark', 'stain', 'stained']),
      shades: all(shade, ['solid', 'solidDepth', 'thin', 'thinDepth', 'near', 'far', 'reach', 'paper']),
    };
  }
  function resize() {
    const ratio = Math.min(2, window.devicePixelRatio || 1);
    const size = [canvas.clientWidth, canvas.clientHeight].map((length) => Math.max(1, Math.round(length * ratio)));
    if (canvas.width !== size[0] || canvas.height !== size[1]) [canvas.width, canvas.height] = size;
    if (made.size[0] === size[0] && made.size[1] === size[1]) return;
    made.size = size;
    made.solid.resize(...size);
    made.thin.resize(...size);
  }
  function upload() {
    if (gl.isContextLost()) return;
    if (cloud && colours) {
      made.own.cloud(cloud);
      made.own.colours(colours);
      made.own.born(born);
    }
    if (ghosts) {
      made.ghosts.cloud(ghosts.cloud);
      made.ghosts.colours(new Uint8Array(3 * ghosts.cloud.n));
      made.ghosts.born(Uint16Array.from(ghosts.cloud.owner, (owner) => (ghosts.owners.has(owner) ? 0 : NO_OWNER)));
    }
    redraw();
  }
  function axes() {
    const { azimuth: a, elevation: e } = eye;
    const back = [Math.cos(a) * Math.cos(e), Math.sin(a) * Math.cos(e), Math.sin(e)];
    const right = [-Math.sin(a), Math.cos(a), 0];
    const up = [-Math.cos(a) * Math.sin(e), -Math.sin(a) * Math.sin(e), Math.cos(e)];
    return { back, right, up };
  }
  const place = () => { const { back } = axes(); return eye.target.map((v, i) => v + back[i] * eye.distance); };
  const range = () => [Math.max(0.05, eye.distance / 100), eye.distance * 4 + 40];
  function matrix() {
    const { back, right, up } = axes(), [near, far] = range(), f = 1 / Math.tan(FIELD_OF_VIEW / 2);
    const wide = canvas.width / canvas.height, p = place();
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
    gl.viewport(0, 0, ...made.size);
    gl.enable(gl.DEPTH_TEST);
    made.solid.clear();
    if (cloud && cloud.n && colours) drawPoints(made.own, cloud, { only: fades ? DRAWN.behind : DRAWN.all, mark: 1 });
    made.thin.clear();
    if (cloud && cloud.n && colours && fades) drawPoints(made.own, cloud, { only: DRAWN.before, opacity: 0.1 });
    gl.clearBufferfv(gl.DEPTH, 0, [1]);
    if (ghosts) drawPoints(made.ghosts, ghosts.cloud, { isGhost: true, opacity: 0.5, mark: 0.5 });
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.viewport(0, 0, ...made.size);
    gl.disable(gl.DEPTH_TEST);
    gl.useProgram(made.shade);
    gl.bindVertexArray(made.nothing);
    const { solid, thin } = made;
    [['solid', solid.colours], ['solidDepth', solid.depth], ['thin', thin.colours], ['thinDepth', thin.depth]]
      .forEach(([name, texture], unit) => {
        gl.activeTexture(gl.TEXTURE0 + unit);
        gl.bindTexture(gl.TEXTURE_2D, texture);
        gl.uniform1i(made.shades[name], unit);
      });
    gl.uniform1f(made.shades.near, near);
    gl.uniform1f(made.shades.far, far);
    gl.uniform1f(made.shades.reach, Math.max(1, Math.round(made.size[1] / 500)));
    gl.uniform3fv(made.shades.paper, paper);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }
  function drawPoints(buffers, of, { only = DRAWN.all, opacity = 1, mark = 0, isGhost = false }) {
    const { uniforms } = made;
    gl.useProgram(made.points);
    gl.bindVertexArray(buffers.array);
    gl.uniformMatrix4fv(uniforms.camera, false, matrix());
    gl.uniform3fv(uniforms.eye, place());
    gl.uniform3fv(uniforms.origin, of.origin);
    gl.uniform1f(uniforms.spread, of.step);
    gl.uniform1f(uniforms.cut, isGhost ? 1e9 : Math.min(cut, 1e9));
    gl.uniform1f(uniforms.pixels, (1.75 * of.spacing * made.size[1]) / (2 * Math.tan(FIELD_OF_VIEW / 2)));
    gl.uniform1i(uniforms.chosen, isGhost ? -1 : chosen);
    gl.uniform1ui(uniforms.now, isGhost ? 0 : now);
    gl.uniform1i(uniforms.only, only);
    gl.uniform1f(uniforms.opacity, opacity);
    gl.uniform1f(uniforms.mark, mark);
    gl.uniform3fv(uniforms.stain, GHOST);
    gl.uniform1f(uniforms.stained, isGhost ? 1 : 0);
    gl.drawArrays(gl.POINTS, 0, of.n);
  }
  function redraw() {
    if (!pending) { pending = true; requestAnimationFrame(draw); }
  }
  // What is at a pixel: {kind: 'own' or 'ghost', owner}; null if nothing is. Does not block on the GPU: pixels are read
  // into a buffer, and from there after a fence.
  async function at(x, y) {
    if (!cloud || gl.isContextLost()) return null;
    if (pending || !made.size[0]) draw();
    const ratio = canvas.width / canvas.clientWidth, reach = 3, side = 2 * reach + 1, mine = cloud, n = side * side * 4;
    const pixels = new Uint8Array(2 * n), buffer = gl.createBuffer();
    gl.bindBuffer(gl.PIXEL_PACK_BUFFER, buffer);
    gl.bufferData(gl.PIXEL_PACK_BUFFER, pixels.length, gl.STREAM_READ);
    const left = Math.round(x * ratio) - reach, bottom = Math.round(canvas.height - y * ratio) - reach;
    [made.solid, made.thin].forEach((layer, k) => {
      gl.bindFramebuffer(gl.FRAMEBUFFER, layer.frame);
      gl.readBuffer(gl.COLOR_ATTACHMENT1);
      gl.readPixels(left, bottom, side, side, gl.RGBA, gl.UNSIGNED_BYTE, k * n);
    });
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.bindBuffer(gl.PIXEL_PACK_BUFFER, null);
    const fence = gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
    gl.flush();
    const isPassed = () => gl.isContextLost() || gl.clientWaitSync(fence, 0, 0) !== gl.TIMEOUT_EXPIRED;
    while (!isPassed()) await new Promise((done) => setTimeout(done, 5));
    if (gl.isContextLost()) return null;
    gl.deleteSync(fence);
    gl.bindBuffer(gl.PIXEL_PACK_BUFFER, buffer);
    gl.getBufferSubData(gl.PIXEL_PACK_BUFFER, 0, pixels);
    gl.bindBuffer(gl.PIXEL_PACK_BUFFER, null);
    gl.deleteBuffer(buffer);
    if (mine !== cloud) return null;
    // The pixel itself first, then its neighbourhood; a ghost before what is behind it.
    const places = side * side;
    const away = (k) => Math.hypot((k % side) - reach, Math.floor((k % places) / side) - reach);
    const nearest = [...Array(2 * places).keys()].sort((a, b) => away(a) - away(b) || b - a);
    const hit = nearest.find((k) => pixels[4 * k + 2]);
    if (hit === undefined) return null;
    const owner = pixels[4 * hit] + 256 * pixels[4 * hit + 1] - 1;
    return owner === NO_OWNER || owner < 0 ? null : { kind: hit < places ? 'own' : 'ghost', owner };
  }
  async function pickAt(x, y) {
    onPick(await at(x, y), x, y);
  }
  // One read at a time, at the latest position of the pointer.
  let looksAt = null, isLooking = false;
  async function hoverAt(x, y) {
    looksAt = [x, y];
    if (isLooking) return;
    isLooking = true;
    while (looksAt) {
      const [atX, atY] = looksAt;
      looksAt = null;
      const found = await at(atX, atY);
      if (!held.size) onHover(found, atX, atY);
    }
    isLooking = false;
  }
  function turn(across, along) {
    eye.azimuth -= across;
    eye.elevation = within(eye.elevation + along, LIMITS.elevation);
    onMove();
  }
  function zoom(factor) {
    eye.distance = within(eye.distance * factor, LIMITS.distance);
    onMove();
  }
  function pan(across, along) {
    // As fractions of the height of the view.
    const { right, up } = axes(), size = 2 * eye.distance * Math.tan(FIELD_OF_VIEW / 2);
    eye.target = eye.target.map((v, i) => v - size * (across * right[i] - along * up[i]));
    onMove();
  }
  // Width over height, clipped to 0.45..1; narrow views are farther away, so that they show as much as wide ones.
  const narrowness = () => Math.min(1, Math.max(0.45, canvas.clientWidth / Math.max(1, canvas.clientHeight)));
  function whole() {
    if (!cloud || !cloud.n) return;
    const size = cloud.high.map((v, i) => v - cloud.low[i]);
    eye.target = cloud.low.map((v, i) => v + size[i] * (i === 2 ? 0.35 : 0.5));
    eye.distance = (0.5 * Math.hypot(...size) * 0.92) / Math.sin(FIELD_OF_VIEW / 2) / narrowness();
    eye.azimuth = size[0] > size[1] ? -Math.PI / 2 + 0.5 : 0.5;
    eye.elevation = 0.85;
    onMove();
  }

  const held = new Map();
  let moved = 0;
  canvas.addEventListener('pointerdown', (event) => {
    canvas.setPointerCapture(event.pointerId);
    onHover(null);
    held.set(event.pointerId, [event.clientX, event.clientY]);
    if (held.size === 1) moved = 0;
  });
  canvas.addEventListener('pointermove', (event) => {
    const before = held.get(event.pointerId);
    if (!before) {
      const box = canvas.getBoundingClientRect();
      if (event.pointerType === 'mouse') hoverAt(event.clientX - box.left, event.clientY - box.top);
      return;
    }
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
  canvas.addEventListener('pointerleave', () => { looksAt = null; onHover(null); });
  canvas.addEventListener('contextmenu', (event) => event.preventDefault());
  canvas.addEventListener('wheel', (event) => {
    // The wheel scrolls the page until the view is clicked.
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
    redraw, zoom, turn, pan, whole, narrowness,
    // `bornAt`: the timeline step at which each instance appears; 0 if unknown.
    show(next, values, bornAt) {
      cloud = next;
      colours = values;
      born = Uint16Array.from(next.owner, (owner) => bornAt[owner] || 0);
      upload();
    },
    colour(values) { colours = values; if (cloud && !gl.isContextLost()) made.own.colours(values); redraw(); },
    ghost(of, owners) { ghosts = of && owners.size ? { cloud: of, owners } : null; upload(); },
    nothing() { cloud = null; ghosts = null; redraw(); },
    choose(instance) { chosen = instance; redraw(); },
    cutAt(height) { cut = height; redraw(); },
    growTo(step) { now = step; redraw(); },
    fade(wanted) { fades = wanted; redraw(); },
    onPaper(rgb) { paper = rgb; redraw(); },
    lookAt(centre, size) { eye.target = [...centre]; eye.distance = Math.max(1.2, 2.6 * size); onMove(); },
  };
}

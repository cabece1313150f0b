// WebGL shaders, textures and buffers for the points of a map.

// A wall, ceiling or floor seen from outside hides the inside: `only` selects whether those points are omitted (0), the
// only ones drawn (1), or drawn like any other (2). Points of an instance that first appears after `now` are not drawn.
const POINT_VERTEX = `#version 300 es
in vec3 place; in vec3 colour; in vec3 outward; in uint owner; in uint born;
uniform mat4 camera; uniform vec3 origin, eye; uniform float spread, cut, pixels;
uniform int chosen, only; uniform uint now;
out vec3 tint; flat out uint key;
void main() {
  vec3 world = origin + place * spread;
  gl_Position = camera * vec4(world, 1.0);
  gl_PointSize = clamp(pixels / gl_Position.w, 1.5, 40.0);
  bool other = chosen >= 0 && owner != uint(chosen);
  tint = other ? mix(colour, vec3(dot(colour, vec3(0.33)) * 0.4 + 0.4), 0.75) : colour;
  key = owner + 1u;
  bool hides = dot(outward, outward) > 0.1 && dot(outward, normalize(eye - world)) > 0.12;
  if (world.z > cut || born > now || (only < 2 && hides != (only == 1))) gl_Position = vec4(2.0, 2.0, 2.0, 1.0);
}`;
const POINT_FRAGMENT = `#version 300 es
precision mediump float;
in vec3 tint; flat in highp uint key;
uniform float opacity, mark; uniform vec3 stain; uniform float stained;
layout(location = 0) out vec4 shown; layout(location = 1) out vec4 picked;
void main() {
  vec2 off = gl_PointCoord - 0.5;
  if (dot(off, off) > 0.25) discard;
  shown = vec4(mix(tint, stain, stained), opacity);
  picked = mark > 0.0 ? vec4(float(key & 255u) / 255.0, float((key >> 8) & 255u) / 255.0, mark, 1.0) : vec4(0.0);
}`;
const SHADE_VERTEX = `#version 300 es
void main() { gl_Position = vec4(gl_VertexID == 1 ? 3.0 : -1.0, gl_VertexID == 2 ? 3.0 : -1.0, 0.0, 1.0); }`;
// Eye-dome lighting: a pixel is darker the farther it is behind its neighbours. The thin layer is blended over the solid.
const SHADE_FRAGMENT = `#version 300 es
precision highp float;
uniform sampler2D solid, solidDepth, thin, thinDepth; uniform float near, far, reach; uniform vec3 paper;
out vec4 result;
float distanceAt(sampler2D depth, ivec2 at) {
  float z = texelFetch(depth, clamp(at, ivec2(0), textureSize(depth, 0) - 1), 0).r;
  return z >= 1.0 ? 1e6 : near * far / (far - z * (far - near));
}
float shadeAt(sampler2D depth, ivec2 at, float own) {
  float behind = 0.0;
  int r = int(reach);
  for (int i = 0; i < 8; i++) {
    ivec2 side = ivec2((i % 4 == 0 ? 0 : i < 4 ? 1 : -1), (i % 4 == 2 ? 0 : (i + 2) % 8 < 4 ? 1 : -1)) * r;
    behind += clamp(log2(own) - log2(distanceAt(depth, at + side)) - 0.006, 0.0, 0.04);
  }
  return exp(-6.0 * behind);
}
void main() {
  ivec2 at = ivec2(gl_FragCoord.xy);
  float own = distanceAt(solidDepth, at);
  vec3 ground = own > 9e5 ? paper : texelFetch(solid, at, 0).rgb * shadeAt(solidDepth, at, own);
  vec4 over = texelFetch(thin, at, 0);
  if (over.a > 0.0) {
    float before = distanceAt(thinDepth, at);
    ground = mix(ground, over.rgb * (over.a > 0.3 ? shadeAt(thinDepth, at, before) : 1.0), over.a);
  }
  result = vec4(ground, 1.0);
}`;

function linkedProgram(gl, vertex, fragment) {
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

// The framebuffer of one layer: colours, keys and depth.
function pictureLayer(gl) {
  const frame = gl.createFramebuffer(), textures = [gl.createTexture(), gl.createTexture(), gl.createTexture()];
  const formats = [[gl.RGBA8, gl.RGBA, gl.UNSIGNED_BYTE], [gl.RGBA8, gl.RGBA, gl.UNSIGNED_BYTE],
    [gl.DEPTH_COMPONENT24, gl.DEPTH_COMPONENT, gl.UNSIGNED_INT]];
  const places = [gl.COLOR_ATTACHMENT0, gl.COLOR_ATTACHMENT1, gl.DEPTH_ATTACHMENT];
  function resize(width, height) {
    gl.bindFramebuffer(gl.FRAMEBUFFER, frame);
    formats.forEach(([inside, format, type], k) => {
      gl.bindTexture(gl.TEXTURE_2D, textures[k]);
      gl.texImage2D(gl.TEXTURE_2D, 0, inside, width, height, 0, format, type, null);
      gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
      gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
      gl.framebufferTexture2D(gl.FRAMEBUFFER, places[k], gl.TEXTURE_2D, textures[k], 0);
    });
    gl.drawBuffers([gl.COLOR_ATTACHMENT0, gl.COLOR_ATTACHMENT1]);
  }
  function clear() {
    gl.bindFramebuffer(gl.FRAMEBUFFER, frame);
    gl.clearBufferfv(gl.COLOR, 0, [0, 0, 0, 0]);
    gl.clearBufferfv(gl.COLOR, 1, [0, 0, 0, 0]);
    gl.clearBufferfv(gl.DEPTH, 0, [1]);
  }
  return { frame, colours: textures[0], depth: textures[2], resize, clear };
}

// The vertex buffers of one point cloud.
function pointBuffers(gl, program) {
  const array = gl.createVertexArray(), buffers = {};
  function put(name, values, size, type, how) {
    const place = gl.getAttribLocation(program, name);
    gl.bindVertexArray(array);
    buffers[name] = buffers[name] || gl.createBuffer();
    gl.bindBuffer(gl.ARRAY_BUFFER, buffers[name]);
    gl.bufferData(gl.ARRAY_BUFFER, values, gl.DYNAMIC_DRAW);
    gl.enableVertexAttribArray(place);
    if (how === 'whole') gl.vertexAttribIPointer(place, size, type, 0, 0);
    else gl.vertexAttribPointer(place, size, type, how === 'share', 0, 0);
  }
  return {
    array,
    cloud(one) {
      put('place', one.positions, 3, gl.UNSIGNED_SHORT);
      put('owner', one.owner, 1, gl.UNSIGNED_SHORT, 'whole');
      put('outward', one.outward, 3, gl.BYTE, 'share');
    },
    colours: (values) => put('colour', values, 3, gl.UNSIGNED_BYTE, 'share'),
    born: (values) => put('born', values, 1, gl.UNSIGNED_SHORT, 'whole'),
  };
}

// The 3-D view: the left image as a mesh that turns about the middle of the scene. It starts at the left camera.
"use strict";

const MESH_VERTEX_SHADER = `#version 300 es
in float level;
uniform ivec2 size;         // of the map
uniform vec2 scale;         // px of the pair per px of the map
uniform vec2 code;          // disparity = code.x + code.y * level
uniform vec2 centre;
uniform vec3 lens;          // focal length, doffs, least disparity + doffs, in px of the pair
uniform mat4 matrix;
out vec2 place;
void main() {
  vec2 cell = vec2(gl_VertexID % size.x, gl_VertexID / size.x) + 0.5;
  place = cell / vec2(size);
  // In baselines.
  float z = lens.x / max(code.x + code.y * level + lens.y, lens.z);
  gl_Position = matrix * vec4((cell * scale - 0.5 - centre) * z / lens.x, z, 1.0);
}`;

const MESH_FRAGMENT_SHADER = `#version 300 es
precision mediump float;
in vec2 place;
uniform sampler2D picture;
out vec4 colour;
void main() { colour = texture(picture, place); }`;

const MOST_YAW = 1.3, MOST_PITCH = 1.0, NEAREST = 0.2, FARTHEST_AWAY = 4;
const SWAY_MS = 9000, SWAY = 0.14;

// Corners of the triangles between neighbours of one surface: their disparities differ by at most steepest_px.
function triangulate(maps, map, steepest_px) {
  const { width, height } = map, most = steepest_px / map.step_px;
  const corners = new Uint32Array(6 * (width - 1) * (height - 1));
  let count = 0;
  function join(a, b, c) {
    if (maps.percents[a] === 255 || maps.percents[b] === 255 || maps.percents[c] === 255) return;
    const x = maps.levels[a], y = maps.levels[b], z = maps.levels[c];
    if (Math.max(x, y, z) - Math.min(x, y, z) > most) return;
    corners[count++] = a;
    corners[count++] = b;
    corners[count++] = c;
  }
  for (let row = 0; row < height - 1; row++)
    for (let column = 0; column < width - 1; column++) {
      const at = row * width + column;
      join(at, at + width, at + 1);
      join(at + 1, at + width, at + width + 1);
    }
  return corners.subarray(0, count);
}

// The matrix, in columns, from points in baselines (x right, y down, z forward) to the canvas.
function sceneMatrix(pose, scene, size_px) {
  const [width, height] = size_px, { focal_px, cx_px, cy_px, middle, farthest } = scene;
  const cosY = Math.cos(pose.yaw), sinY = Math.sin(pose.yaw), cosP = Math.cos(pose.pitch), sinP = Math.sin(pose.pitch);
  const turn = [cosY, 0, sinY, sinP * sinY, cosP, -sinP * cosY, -cosP * sinY, sinP, cosP * cosY];
  // Turned about the point (0, 0, middle), then moved away from the eye.
  const rows = [0, 1, 2].map((row) => {
    const [a, b, c] = turn.slice(3 * row, 3 * row + 3);
    return [a, b, c, -c * middle + (row === 2 ? middle * pose.away : 0)];
  });
  const near = 0.02 * middle, far = 2 * (farthest + middle * FARTHEST_AWAY);
  const [x, y, z] = rows, deep = (far + near) / (far - near);
  const column = (k) => [
    ((2 * focal_px) / width) * x[k] + ((2 * cx_px + 1) / width - 1) * z[k],
    -((2 * focal_px) / height) * y[k] - ((2 * cy_px + 1) / height - 1) * z[k],
    deep * z[k] - (k === 3 ? near * (deep + 1) : 0),
    z[k],
  ];
  return new Float32Array([0, 1, 2, 3].flatMap(column));
}

function startMesh(canvas, picture, maps) {
  const gl = canvas.getContext("webgl2");
  if (!gl) return null;
  const { map, scene } = data, size_px = [data.width_px, data.height_px];
  const pose = { yaw: 0, pitch: 0, away: 1 };
  const corners = triangulate(maps, map, scene.steepest_px);
  let matrixAt = null, asked = 0, swaying = 0;

  function build() {
    const program = gl.createProgram();
    for (const [kind, source] of [[gl.VERTEX_SHADER, MESH_VERTEX_SHADER], [gl.FRAGMENT_SHADER, MESH_FRAGMENT_SHADER]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, source);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
    }
    gl.linkProgram(program);
    gl.useProgram(program);
    gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ARRAY_BUFFER, maps.levels, gl.STATIC_DRAW);
    const level = gl.getAttribLocation(program, "level");
    gl.enableVertexAttribArray(level);
    gl.vertexAttribPointer(level, 1, gl.UNSIGNED_SHORT, false, 0, 0);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, corners, gl.STATIC_DRAW);
    gl.bindTexture(gl.TEXTURE_2D, gl.createTexture());
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, gl.RGBA, gl.UNSIGNED_BYTE, picture);
    gl.generateMipmap(gl.TEXTURE_2D);
    const at = (name) => gl.getUniformLocation(program, name);
    gl.uniform2i(at("size"), map.width, map.height);
    gl.uniform2f(at("scale"), size_px[0] / map.width, size_px[1] / map.height);
    gl.uniform2f(at("code"), map.low_px, map.step_px);
    gl.uniform2f(at("centre"), scene.cx_px, scene.cy_px);
    gl.uniform3f(at("lens"), scene.focal_px, scene.doffs_px, scene.least_px);
    gl.enable(gl.DEPTH_TEST);
    matrixAt = at("matrix");
  }

  function draw() {
    asked = 0;
    const width = Math.round(canvas.clientWidth * Math.min(devicePixelRatio, 2));
    const height = Math.round((width * size_px[1]) / size_px[0]);
    if (canvas.width !== width || canvas.height !== height) [canvas.width, canvas.height] = [width, height];
    gl.viewport(0, 0, width, height);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.uniformMatrix4fv(matrixAt, false, sceneMatrix(pose, scene, size_px));
    gl.drawElements(gl.TRIANGLES, corners.length, gl.UNSIGNED_INT, 0);
  }
  const redraw = () => (asked ||= requestAnimationFrame(draw));

  function sway(startMs) {
    swaying = requestAnimationFrame((nowMs) => {
      pose.yaw = SWAY * Math.sin((2 * Math.PI * (nowMs - startMs)) / SWAY_MS);
      draw();
      sway(startMs);
    });
  }
  function stop() {
    cancelAnimationFrame(swaying);
    swaying = 0;
  }
  const within = (value, most) => Math.min(Math.max(value, -most), most);
  function turn(yaw, pitch) {
    stop();
    pose.yaw = within(pose.yaw + yaw, MOST_YAW);
    pose.pitch = within(pose.pitch + pitch, MOST_PITCH);
    redraw();
  }
  function zoom(factor) {
    stop();
    pose.away = Math.min(Math.max(pose.away * factor, NEAREST), FARTHEST_AWAY);
    redraw();
  }
  function reset() {
    stop();
    Object.assign(pose, { yaw: 0, pitch: 0, away: 1 });
    redraw();
  }

  const fingers = new Map();
  const spread = () => {
    const [one, other] = [...fingers.values()];
    return Math.hypot(one.x - other.x, one.y - other.y);
  };
  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    fingers.set(event.pointerId, { x: event.clientX, y: event.clientY });
    stop();
  });
  canvas.addEventListener("pointermove", (event) => {
    const from = fingers.get(event.pointerId);
    if (!from) return;
    const before = fingers.size === 2 ? spread() : 0, to = { x: event.clientX, y: event.clientY };
    fingers.set(event.pointerId, to);
    if (fingers.size === 2) zoom(before / Math.max(spread(), 1));
    // What is near follows the pointer; the whole width turns by 2 radians.
    else turn((-2 * (to.x - from.x)) / canvas.clientWidth, (2 * (to.y - from.y)) / canvas.clientWidth);
  });
  for (const name of ["pointerup", "pointercancel"]) canvas.addEventListener(name, (event) => fingers.delete(event.pointerId));
  canvas.addEventListener("wheel", (event) => {
    // Elsewhere the wheel scrolls the page.
    if (document.activeElement !== canvas) return;
    event.preventDefault();
    zoom(Math.exp(event.deltaY / 800));
  });
  canvas.addEventListener("keydown", (event) => {
    const step = STEPS[event.key];
    if (step) turn(-0.1 * step[0], 0.1 * step[1]);
    else if (event.key === "+" || event.key === "=") zoom(1 / 1.15);
    else if (event.key === "-") zoom(1.15);
    else if (event.key === "0") reset();
    else return;
    event.preventDefault();
  });
  canvas.addEventListener("webglcontextlost", (event) => event.preventDefault());
  canvas.addEventListener("webglcontextrestored", () => {
    build();
    redraw();
  });
  new ResizeObserver(redraw).observe(canvas);
  build();
  redraw();
  return { pose, zoom, reset, stop, sway: () => sway(performance.now()) };
}

/* The 3-D viewer: draws a packed scene (stereoweave/outputs/viewer.py) on a canvas, from any viewpoint near the
   cameras. `StereoweaveViewer.makeView` draws; `makeViewer` adds movement by mouse, finger, keys or by itself. */
const StereoweaveViewer = (() => {
"use strict";

const IDLE_MS = 2500, SWAY_MS = 7000, SWAY_PART = 0.8, EASE_MS = 120, SLOW_MS = 40, REST_MS = 300;
const IDENTITY = new Float32Array([1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]);
const VERTEX_SHADER = $vertex_shader;
const FRAGMENT_SHADER = $fragment_shader;

/** Return a promise of {draw, drawWith, gl, scene}, or of null where the browser has no WebGL.
    scene: the packed scene; its images may be image elements instead of addresses. */
async function makeView(canvas, scene) {
  const options = { alpha: false, antialias: false, depth: false, xrCompatible: false };
  const gl = canvas.getContext("webgl2", options) || canvas.getContext("webgl", options);
  if (!gl) return null;
  const names = ["front", "frontDepth", "behind", "behindDepth", "bounds"];
  const images = await Promise.all(names.map((name) => loadImage(scene[name])));
  let uniforms;

  function build() {
    const program = gl.createProgram();
    for (const [kind, source] of [[gl.VERTEX_SHADER, VERTEX_SHADER], [gl.FRAGMENT_SHADER, FRAGMENT_SHADER]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, source);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
    }
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS)) return false;
    gl.useProgram(program);
    gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ARRAY_BUFFER, new Float32Array([0, 0, 1, 0, 0, 1, 1, 1]), gl.STATIC_DRAW);
    const corner = gl.getAttribLocation(program, "corner");
    gl.enableVertexAttribArray(corner);
    gl.vertexAttribPointer(corner, 2, gl.FLOAT, false, 0, 0);
    uniforms = (name) => gl.getUniformLocation(program, name);
    images.forEach((image, unit) => {
      addTexture(gl, image, unit, names[unit] === "front" || names[unit] === "behind");
      gl.uniform1i(uniforms(names[unit]), unit);
    });
    gl.uniform2fv(uniforms("size"), scene.size_px);
    gl.uniform4fv(uniforms("shown"), scene.shown_px);
    gl.uniform4fv(uniforms("behindFrame"), scene.behind_frame_px);
    gl.uniform2fv(uniforms("tiles"), scene.tiles_px);
    gl.uniform2fv(uniforms("code"), scene.code_px);
    gl.uniform2fv(uniforms("range"), scene.range_px);
    gl.uniform1f(uniforms("plane"), scene.plane_px);
    return true;
  }

  /** Draw into the bound frame buffer: `matrix` places the picture, (x, up) is the eye in baselines. */
  function drawWith(matrix, x, up) {
    const [first, last] = scene.positions;
    gl.uniformMatrix4fv(uniforms("matrix"), false, matrix);
    gl.uniform2f(uniforms("eye"), clamp(x, first, last), -clamp(up, -scene.up, scene.up));
    gl.drawArrays(gl.TRIANGLE_STRIP, 0, 4);
  }

  /** Draw the view from position x and height `up` on the canvas. */
  function draw(x, up) {
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.viewport(0, 0, canvas.width, canvas.height);
    drawWith(IDENTITY, x, up);
  }

  if (!build()) return null;
  canvas.addEventListener("webglcontextlost", (event) => event.preventDefault());
  canvas.addEventListener("webglcontextrestored", build);
  return { gl, draw, drawWith, scene };
}

/** Add a viewer to a canvas: it moves with the mouse, a finger, the arrow keys, or by itself when idle.
    Return a promise of the viewer, {look, stop, sway, eye, target, view}, or of null where the browser has no WebGL.
    options.area: the element whose mouse and touch events move the view (default: the canvas);
    options.sway: whether the view moves by itself (default: unless the reader asked for less motion). */
async function makeViewer(canvas, scene, options = {}) {
  const view = await makeView(canvas, scene);
  if (!view) return null;
  const area = options.area || canvas;
  const [first, last] = scene.positions;
  const middle = (first + last) / 2, reach = (last - first) / 2;
  const calm = matchMedia("(prefers-reduced-motion: reduce)").matches;
  const viewer = { view, sway: options.sway ?? !calm, target: [0, 0], eye: [0, 0] };
  let touched_ms = -1e9, previous_ms = 0, moved_ms = 0, drawn = null, sharpness = 1, slow = 0, visible = true, dragged = null;

  /** Look from (u, v), each -1 to 1, to the right and up. */
  viewer.look = (u, v) => {
    viewer.target = [clamp(u, -1, 1), clamp(v, -1, 1)];
    touched_ms = performance.now();
  };
  viewer.stop = () => { visible = false; watcher?.disconnect(); viewer.stopped = true; };

  function resize(sharp) {
    const scale = Math.max(devicePixelRatio || 1, 1) * sharp;
    const width = Math.min(Math.round(canvas.clientWidth * scale), Math.round(1.25 * scene.shown_px[2]));
    const height = Math.round(width * scene.shown_px[3] / scene.shown_px[2]);
    if (width > 0 && (canvas.width !== width || canvas.height !== height)) {
      canvas.width = width;
      canvas.height = height;
      drawn = null;
    }
  }

  function step(now_ms) {
    if (viewer.stopped) return;
    requestAnimationFrame(step);
    const passed_ms = now_ms - previous_ms;
    previous_ms = now_ms;
    if (!visible || viewer.busy) return;
    if (viewer.sway && now_ms - touched_ms > IDLE_MS && dragged === null) {
      const turn = (2 * Math.PI * now_ms) / SWAY_MS;
      viewer.target = [SWAY_PART * Math.sin(turn), 0.5 * SWAY_PART * Math.cos(turn)];
    }
    const share = 1 - Math.exp(-Math.min(passed_ms, 100) / EASE_MS);
    viewer.eye = viewer.eye.map((at, k) => at + share * (viewer.target[k] - at));
    const [u, v] = viewer.eye;
    const still = drawn && Math.abs(drawn[0] - u) + Math.abs(drawn[1] - v) < 1e-4;
    // At rest, one sharp frame costs nothing.
    const rested = still && now_ms - moved_ms > REST_MS;
    resize(rested ? 1 : sharpness);
    if (drawn && still) return;
    drawn = [u, v];
    view.draw(middle + reach * u, scene.up * v);
    if (rested) return;
    moved_ms = now_ms;
    // A slow graphics processor draws fewer pixels rather than fewer frames.
    slow = passed_ms > SLOW_MS ? slow + Math.min(passed_ms / SLOW_MS, 4) : Math.max(0, slow - 1);
    if (slow > 12 && sharpness > 0.3) {
      sharpness *= 0.8;
      slow = 0;
    }
  }

  function lookAt(event) {
    const box = area.getBoundingClientRect();
    viewer.look((2 * (event.clientX - box.left)) / box.width - 1, 1 - (2 * (event.clientY - box.top)) / box.height);
  }
  area.addEventListener("pointermove", (event) => {
    if (event.pointerType === "mouse") lookAt(event);
    else if (dragged) {
      // A finger drags the scene; a third of the width is the whole way.
      const width = canvas.clientWidth / 3;
      viewer.look(dragged.u - (event.clientX - dragged.x) / width, dragged.v + (event.clientY - dragged.y) / width);
    }
  });
  area.addEventListener("pointerdown", (event) => {
    if (event.pointerType !== "mouse")
      dragged = { x: event.clientX, y: event.clientY, u: viewer.eye[0], v: viewer.eye[1] };
  });
  for (const name of ["pointerup", "pointercancel", "pointerleave"])
    area.addEventListener(name, () => { dragged = null; });
  canvas.tabIndex = 0;
  canvas.addEventListener("keydown", (event) => {
    const way = { ArrowLeft: [-0.2, 0], ArrowRight: [0.2, 0], ArrowUp: [0, 0.2], ArrowDown: [0, -0.2] }[event.key];
    if (!way) return;
    event.preventDefault();
    viewer.look(viewer.target[0] + way[0], viewer.target[1] + way[1]);
  });
  const watcher = window.IntersectionObserver && new IntersectionObserver((entries) => {
    visible = entries[entries.length - 1].isIntersecting;
  });
  watcher?.observe(canvas);
  canvas.addEventListener("webglcontextrestored", () => { drawn = null; });
  requestAnimationFrame(step);
  return viewer;
}

function clamp(value, least, greatest) { return Math.min(Math.max(value, least), greatest); }

async function loadImage(source) {
  const image = typeof source === "string" ? new Image() : source;
  if (typeof source === "string") image.src = source;
  await image.decode();
  return image;
}

function addTexture(gl, image, unit, smooth) {
  gl.activeTexture(gl.TEXTURE0 + unit);
  gl.bindTexture(gl.TEXTURE_2D, gl.createTexture());
  // The levels of a depth map are numbers, which no conversion of colours may change.
  gl.pixelStorei(gl.UNPACK_COLORSPACE_CONVERSION_WEBGL, gl.NONE);
  gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, gl.RGBA, gl.UNSIGNED_BYTE, image);
  for (const way of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(gl.TEXTURE_2D, way, gl.CLAMP_TO_EDGE);
  for (const way of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER])
    gl.texParameteri(gl.TEXTURE_2D, way, smooth ? gl.LINEAR : gl.NEAREST);
}

return { makeView, makeViewer };
})();

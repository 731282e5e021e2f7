/* The page of one scene: the viewer over the still picture, its buttons, tilt and headset. */
const element = (id) => document.getElementById(id);

async function startPage() {
  const scene = JSON.parse(element("scene").textContent);
  scene.front = element("still");
  const viewer = await StereoweaveViewer.makeViewer(element("view"), scene, { area: document.querySelector("main") });
  if (!viewer) {
    element("hint").textContent = "Still picture: this browser has no WebGL, which the 3-D view needs.";
    return;
  }
  element("view").hidden = false;
  element("still").setAttribute("aria-hidden", "true");
  const touches = matchMedia("(pointer: coarse)").matches;
  element("hint").textContent = touches ? "Drag to look around" : "Move the mouse to look around";
  element("sway").hidden = false;
  const showSway = () => { element("sway").textContent = viewer.sway ? "Pause motion" : "Play motion"; };
  element("sway").addEventListener("click", () => { viewer.sway = !viewer.sway; showSway(); });
  showSway();
  setTimeout(() => element("hint").classList.add("gone"), 5000);
  if (touches) offerTilt(viewer);
  offerHeadset(viewer);
  window.stereoweaveViewer = viewer;
}

/** Move the view with the phone's tilt; browsers that ask for permission do so after a press of the button. */
function offerTilt(viewer) {
  if (!window.isSecureContext || !window.DeviceOrientationEvent) return;
  let level = null;
  function follow(event) {
    if (event.gamma === null) return;
    const turned = Math.abs(screen.orientation?.angle ?? 0) === 90;
    const now = turned ? [event.beta, -event.gamma] : [event.gamma, event.beta];
    // The way in which the phone is held comes to be the middle within seconds.
    level = level ? level.map((at, k) => at + 0.01 * (now[k] - at)) : now;
    viewer.look((now[0] - level[0]) / 15, (now[1] - level[1]) / 15);
  }
  const start = () => window.addEventListener("deviceorientation", follow);
  if (!DeviceOrientationEvent.requestPermission) return start();
  element("tilt").hidden = false;
  element("tilt").addEventListener("click", async () => {
    if ((await DeviceOrientationEvent.requestPermission()) !== "granted") return;
    start();
    element("tilt").hidden = true;
  });
}

/** Offer a headset, where the page is served securely and the browser has one. */
async function offerHeadset(viewer) {
  try {
    if (!(await navigator.xr?.isSessionSupported("immersive-vr"))) return;
  } catch {
    return;
  }
  element("headset").hidden = false;
  element("headset").addEventListener("click", () => enterHeadset(viewer));
}

const EYES_APART_M = 0.063, SCREEN_M = 2, SCREEN_WIDTH_M = 2;

/** Show the scene on a screen 2 m away. Each eye sees its camera's view; the head moves both. */
async function enterHeadset(viewer) {
  const { gl, drawWith, scene } = viewer.view;
  const session = await navigator.xr.requestSession("immersive-vr");
  await gl.makeXRCompatible();
  const layer = new XRWebGLLayer(session, gl);
  session.updateRenderState({ baseLayer: layer });
  const space = await session.requestReferenceSpace("local");
  const middle = (scene.positions[0] + scene.positions[1]) / 2;
  viewer.busy = true;
  session.addEventListener("end", () => { viewer.busy = false; viewer.look(0, 0); });
  session.requestAnimationFrame(function show(time, frame) {
    session.requestAnimationFrame(show);
    const pose = frame.getViewerPose(space);
    gl.bindFramebuffer(gl.FRAMEBUFFER, layer.framebuffer);
    gl.clear(gl.COLOR_BUFFER_BIT);
    for (const eye of pose ? pose.views : []) {
      const box = layer.getViewport(eye), at = eye.transform.position;
      gl.viewport(box.x, box.y, box.width, box.height);
      const matrix = multiply(eye.projectionMatrix, multiply(eye.transform.inverse.matrix, screenMatrix(scene)));
      drawWith(matrix, middle + at.x / EYES_APART_M, at.y / EYES_APART_M);
    }
  });
}

/** The screen's place in the room, as a 4x4 matrix in columns. */
function screenMatrix(scene) {
  const half = SCREEN_WIDTH_M / 2;
  return [half, 0, 0, 0, 0, (half * scene.shown_px[3]) / scene.shown_px[2], 0, 0, 0, 0, 1, 0, 0, 0, -SCREEN_M, 1];
}

function multiply(one, other) {
  const product = new Float32Array(16);
  for (let column = 0; column < 4; column++)
    for (let row = 0; row < 4; row++)
      for (let k = 0; k < 4; k++) product[4 * column + row] += one[4 * k + row] * other[4 * column + k];
  return product;
}

startPage();

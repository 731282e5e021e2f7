const data = JSON.parse(document.getElementById("data").textContent);
const still = matchMedia("(prefers-reduced-motion: reduce)").matches;
const stage = document.getElementById("stage");
document.body.classList.add("alive");

// --- The view from any position: by WebGL, or the nearest of a few images ---

const slider = document.getElementById("position");
const views = document.querySelectorAll("#views img");
const photo = document.getElementById("photo");
const shownFrom = { position: 0.5, up: 0 };
let photoView = null;

function showFrom(position, up) {
  Object.assign(shownFrom, { position, up });
  if (photoView) return photoView.draw(position, up);
  const distances = data.positions.map((at) => Math.abs(at - position));
  const nearest = distances.indexOf(Math.min(...distances));
  views.forEach((view, i) => view.classList.toggle("shown", i === nearest));
}

async function startPhoto() {
  const front = document.querySelector(".frame img");
  photoView = await StereoweaveViewer.makeView(photo, { ...data.photo, front });
  if (!photoView) return;
  photo.hidden = false;
  new ResizeObserver(fitPhoto).observe(photo);
  photo.addEventListener("webglcontextrestored", fitPhoto);
}

function fitPhoto() {
  const [, , width_px, height_px] = data.photo.shown_px;
  photo.width = Math.max(1, Math.min(Math.round(photo.clientWidth * devicePixelRatio), Math.round(1.25 * width_px)));
  photo.height = Math.max(1, Math.round((photo.width * height_px) / width_px));
  showFrom(shownFrom.position, shownFrom.up);
}

function place(position) {
  if (position < 0) return "left of the left camera";
  if (position > 1) return "right of the right camera";
  return { 0: "at the left camera", 0.5: "halfway between the cameras", 1: "at the right camera" }[position] ?? "between the cameras";
}

function moveViewpoint(up = shownFrom.up) {
  const position = Math.round(100 * slider.value) / 100;
  showFrom(position, up);
  const text = position + ", " + place(position);
  document.getElementById("where").textContent = text;
  slider.setAttribute("aria-valuetext", text);
}
slider.addEventListener("input", () => moveViewpoint());
moveViewpoint();
startPhoto();

// --- The wiggle: from one camera to the other and back ---

const TURN_MS = 1600;
const play = document.getElementById("play");
let wiggling = 0, startMs = 0;

function wiggle(nowMs) {
  showFrom(0.5 - 0.5 * Math.cos((2 * Math.PI * (nowMs - startMs)) / TURN_MS), 0);
  wiggling = requestAnimationFrame(wiggle);
}

function setWiggling(on) {
  cancelAnimationFrame(wiggling);
  wiggling = 0;
  play.textContent = on ? "Pause" : "Play";
  startMs = performance.now();
  if (on) wiggling = requestAnimationFrame(wiggle);
}
play.addEventListener("click", () => setWiggling(!wiggling));

// --- Which of them is shown ---

function chooseMode(mode) {
  stage.dataset.mode = mode;
  for (const controls of document.querySelectorAll(".controls")) controls.hidden = controls.dataset.mode !== mode;
  setWiggling(false);
  document.getElementById("anaglyph").classList.toggle("shown", mode === "anaglyph");
  showMesh(mode === "turn");
  if (mode === "wiggle") {
    showFrom(0.5, 0);
    setWiggling(!still);
  } else if (mode === "slide") moveViewpoint(0);
}
for (const choice of document.querySelectorAll("[name=mode]")) {
  choice.addEventListener("change", () => chooseMode(choice.value));
}

// --- The 3-D view: see mesh.js ---

const meshCanvas = document.getElementById("mesh");
let mesh = null;

async function showMesh(on) {
  meshCanvas.hidden = !on;
  mesh?.stop();
  if (!on) return;
  if (!mesh) {
    const picture = document.querySelector(".frame img");
    await Promise.all([unpacked, picture.decode()]);
    mesh = maps && startMesh(meshCanvas, picture, maps);
    if (!mesh) document.getElementById("turning").textContent = "This browser is too old for the 3-D view, or has no WebGL 2.";
  }
  if (mesh && !still && !meshCanvas.hidden) mesh.sway();
}
for (const [id, use] of [["nearer", () => mesh?.zoom(1 / 1.15)], ["farther", () => mesh?.zoom(1.15)], ["again", () => mesh?.reset()]]) {
  document.getElementById(id).addEventListener("click", use);
}

// Dragging the picture moves the viewpoint. A finger that moves up or down scrolls the page.
stage.addEventListener("pointermove", (event) => {
  if (stage.dataset.mode !== "slide" || !stage.hasPointerCapture(event.pointerId)) return;
  const box = stage.getBoundingClientRect();
  const share = Math.min(Math.max((event.clientX - box.left) / box.width, 0), 1);
  slider.value = Number(slider.min) + share * (slider.max - slider.min);
  const up = event.pointerType === "mouse" ? 1 - (2 * (event.clientY - box.top)) / box.height : 0;
  moveViewpoint(data.photo.up * Math.min(Math.max(up, -1), 1));
});
stage.addEventListener("pointerdown", (event) => {
  if (stage.dataset.mode === "slide" && !event.target.closest("button")) stage.setPointerCapture(event.pointerId);
});
stage.addEventListener("dragstart", (event) => event.preventDefault());

// --- The read-out: see pack_map in report_parts.py ---

let maps = null;

async function unpackMaps() {
  if (!window.DecompressionStream) return;
  const bytes = Uint8Array.from(atob(data.map.packed), (letter) => letter.charCodeAt(0));
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
  const planes = new Uint8Array(await new Response(stream).arrayBuffer());
  const { width, height } = data.map, count = width * height;
  const levels = new Uint16Array(count);
  for (let at = 0; at < count; at++) {
    const before = at % width ? levels[at - 1] : 0;
    levels[at] = before + planes[at] + 256 * planes[count + at];
  }
  maps = { levels, percents: planes.subarray(2 * count) };
}

function formatDepth(depth_m) {
  // The digits that a disparity to 1/64 px can support; otherwise as in outputs/metres.py.
  if (depth_m < 0 || depth_m === Infinity) return "infinity";
  return depth_m >= 10000 ? "over 10 km" : depth_m.toFixed(depth_m < 10 ? 3 : depth_m < 100 ? 2 : depth_m < 1000 ? 1 : 0) + " m";
}

function describe(u, v) {
  const { width, height, low_px, step_px } = data.map;
  const at = Math.floor(v * height) * width + Math.floor(u * width);
  const place = "(" + Math.floor(u * data.width_px) + ", " + Math.floor(v * data.height_px) + "): ";
  const percent = maps.percents[at];
  if (percent === 255) return place + "outside the picture";
  const disparity_px = low_px + step_px * maps.levels[at];
  let text = place + "disparity " + disparity_px.toFixed(2) + " px";
  if (data.camera) {
    const { focal_px, baseline_m, doffs_px } = data.camera;
    text += ", depth " + formatDepth((focal_px * baseline_m) / (disparity_px + doffs_px));
  }
  text += ", confidence " + (percent % 128) + " %";
  return percent < 128 ? text : text + ", occluded";
}

const placed = { u: 0.5, v: 0.5 };

function read(u, v) {
  if (!maps || u < 0 || v < 0 || u >= 1 || v >= 1) return "";
  Object.assign(placed, { u, v });
  document.documentElement.style.setProperty("--place-x", 100 * u + "%");
  document.documentElement.style.setProperty("--place-y", 100 * v + "%");
  document.body.classList.add("placed");
  const text = describe(u, v);
  for (const reading of document.querySelectorAll(".reading")) reading.textContent = text;
  return text;
}

function readUnderPointer(event) {
  const box = event.currentTarget.getBoundingClientRect();
  read((event.clientX - box.left) / box.width, (event.clientY - box.top) / box.height);
}

const STEPS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };

function readByKey(event) {
  const step = STEPS[event.key];
  if (!step) return;
  event.preventDefault();
  const far = event.shiftKey ? 20 : 1;
  const inside = (share) => Math.min(Math.max(share, 0), 0.9999);
  const u = inside(placed.u + (far * step[0]) / data.map.width), v = inside(placed.v + (far * step[1]) / data.map.height);
  document.getElementById("spoken").textContent = read(u, v);
}

const frames = document.querySelectorAll(".frame");
for (const frame of frames) {
  frame.addEventListener("pointermove", readUnderPointer);
  frame.addEventListener("pointerdown", readUnderPointer);
  frame.addEventListener("keydown", readByKey);
  frame.tabIndex = 0;
  frame.setAttribute("role", "group");
  frame.setAttribute("aria-label", frame.querySelector("img").alt + ": arrow keys read the values");
}
const unpacked = unpackMaps();

// --- The full window: the picture's whole card moves into a dialog ---

const full = document.getElementById("full");
const gap = document.createElement("div");
let opener = null;

function enlarge(picture, button) {
  if (full.open) return;
  opener = button;
  const card = picture.closest(".card");
  gap.style.height = card.offsetHeight + "px";
  card.replaceWith(gap);
  full.append(card);
  full.setAttribute("aria-labelledby", card.getAttribute("aria-labelledby"));
  full.showModal();
  if (picture.tabIndex === 0) picture.focus();
}

full.addEventListener("close", () => {
  gap.replaceWith(full.querySelector(".card"));
  opener.focus({ preventScroll: true });
});
document.getElementById("close").addEventListener("click", () => full.close());

const CORNERS = "M3 8V3h5M16 3h5v5M21 16v5h-5M8 21H3v-5";

for (const picture of [stage, ...frames]) {
  const button = document.createElement("button");
  button.type = "button";
  button.className = "enlarge";
  button.innerHTML = `<svg viewBox="0 0 24 24" aria-hidden="true"><path d="${CORNERS}"/></svg>`;
  button.setAttribute("aria-label", "Enlarge: " + picture.closest(".card").querySelector("h2").textContent);
  button.addEventListener("click", (event) => {
    event.stopPropagation();
    enlarge(picture, button);
  });
  picture.append(button);
  let fromX = 0, fromY = 0;
  picture.addEventListener("pointerdown", (event) => ([fromX, fromY] = [event.clientX, event.clientY]));
  picture.addEventListener("click", (event) => {
    // A drag is no click, and the 3-D view is dragged.
    if (event.target !== meshCanvas && Math.hypot(event.clientX - fromX, event.clientY - fromY) < 5) enlarge(picture, button);
  });
}

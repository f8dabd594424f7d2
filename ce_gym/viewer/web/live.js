// The live page: shows the state that the server sends, and posts what the user does. Expects OFFER, scene.js,
// overlays.js and stream.js.

addGhost("/world/1");
offerOverlays();
const show = (path, on) => { node(path).object.visible = on; };

function tell() {
  const [forward, left, turn] = state.command, [vx, vy] = state.base.velocity;
  find("speeds").textContent =
    `commanded ${forward.toFixed(2)} ${left.toFixed(2)} m/s, ${turn.toFixed(2)} rad/s · moves ${vx.toFixed(2)} ${vy.toFixed(2)} m/s`;
  find("rate").textContent = state.rate < 0.97 && !state.paused
    ? `slower than real time: ${Math.round(100 * state.rate)} %` : "";
  find("notice").textContent = state.making ? "compiling ..." : state.notice;
  find("pause").innerHTML = state.paused ? "&#9654;" : "&#10074;&#10074;";
  find("past").min = -state.kept;
  if (document.activeElement !== find("past") || !state.paused) find("past").value = -state.back;
  find("clock").value = state.time.toFixed(2) + " s" + (state.back > 0.03 && state.paused ? ` (${state.back.toFixed(2)} s ago)` : "");
  find("record").textContent = state.recording ? "stop" : "record";
  find("record").classList.toggle("on", state.recording);
  find("align").style.display = state.ghost ? "" : "none";
  show("/world/1", state.ghost);
  show("/surroundings/ground", state.flat);
  show("/world/ground", !state.flat);
  for (const name of ["policy", "transmission", "ghost", "terrain"]) {
    if (document.activeElement !== find(name) && !state.making) find(name).value = state.setup[name] || find(name).value;
  }
  if (!state.setup.ghost && !state.making && document.activeElement !== find("ghost")) find("ghost").value = "";
  for (const [name, value] of Object.entries(state.figures)) {
    if (document.activeElement !== find(name)) find(name).value = value;
    find(name + "_value").textContent = value.toFixed(name === "friction" ? 2 : 1) + (name === "friction" ? "" : " kg");
  }
}

// The panel, closed at first in a narrow window.
find("panel").open = window.innerWidth > 560;
for (const [name, choices] of Object.entries(OFFER.choices)) {
  for (const [value, text] of choices) find(name).add(new Option(text, value));
  find(name).onchange = event => { post({ do: "choose", [name]: event.target.value }); event.target.blur(); };
}
for (const [name, [low, high]] of Object.entries(OFFER.figures)) {
  Object.assign(find(name), { min: low, max: high });
  find(name).oninput = event => post({ do: "figure", name, value: Number(event.target.value) });
  find(name).onchange = event => event.target.blur();
}
for (const name of ["throw", "drop", "reset", "align", "step"]) find(name).onclick = () => post({ do: name });
find("pause").onclick = () => post({ do: "pause", on: !state.paused });
find("record").onclick = () => post({ do: "record", on: !state.recording });
find("speed").onchange = event => { post({ do: "speed", speed: Number(event.target.value) }); event.target.blur(); };
find("past").oninput = event => post({ do: "look_back", seconds: -Number(event.target.value) });
find("past").onchange = event => event.target.blur();

// Driving by keys, stick and gamepad: the largest share of each direction counts.
const DRIVING = { w: [1, 0, 0], s: [-1, 0, 0], a: [0, 0, 1], d: [0, 0, -1], q: [0, 1, 0], e: [0, -1, 0],
                  arrowup: [1, 0, 0], arrowdown: [-1, 0, 0], arrowleft: [0, 0, 1], arrowright: [0, 0, -1] };
const ACTIONS = { " ": () => find("pause").click(), ".": () => find("step").click(), t: () => find("throw").click(),
                  l: () => find("drop").click(), r: () => find("reset").click(), g: () => find("align").click() };
const held = new Set();
let stick = [0, 0, 0], pad = [0, 0, 0], posted = "[0,0,0]";
function drive() {
  const sources = [...[...held].map(key => DRIVING[key]), stick, pad];
  const shares = [0, 1, 2].map(i => {
    const largest = Math.max(0, ...sources.map(s => s[i])), least = Math.min(0, ...sources.map(s => s[i]));
    return largest + least;
  });
  if (JSON.stringify(shares) === posted) return;
  posted = JSON.stringify(shares);
  post({ do: "drive", shares });
}
document.addEventListener("keydown", event => {
  if (event.ctrlKey || event.metaKey || event.altKey || event.target.tagName === "SELECT") return;
  const key = event.key.toLowerCase();
  if (key in DRIVING) { held.add(key); drive(); event.preventDefault(); }
  if (key in ACTIONS && !event.repeat) { ACTIONS[key](); event.preventDefault(); }
});
document.addEventListener("keyup", event => { held.delete(event.key.toLowerCase()); drive(); });
window.addEventListener("blur", () => { held.clear(); stick = [0, 0, 0]; drive(); });

const knob = find("stick").firstElementChild;
function moveStick(event) {
  const box = find("stick").getBoundingClientRect();
  let x = (event.clientX - box.left) / box.width * 2 - 1, y = (event.clientY - box.top) / box.height * 2 - 1;
  const length = Math.max(1, Math.hypot(x, y));
  [x, y] = [x / length, y / length];
  knob.style.transform = `translate(${40 * x}px, ${40 * y}px)`;
  stick = [-y, 0, -x];
  drive();
}
find("stick").onpointerdown = event => { find("stick").setPointerCapture(event.pointerId); moveStick(event); };
find("stick").onpointermove = event => { if (event.buttons) moveStick(event); };
find("stick").onpointerup = find("stick").onpointercancel = () => {
  knob.style.transform = "";
  stick = [0, 0, 0];
  drive();
};
const dead = x => Math.abs(x) < 0.12 ? 0 : x;
function readGamepad() {
  const gamepad = [...navigator.getGamepads()].find(Boolean);
  if (gamepad) { pad = [-dead(gamepad.axes[1]), -dead(gamepad.axes[0]), -dead(gamepad.axes[2] ?? 0)]; drive(); }
  requestAnimationFrame(readGamepad);
}
readGamepad();

// Dragging a body: a spring to the pointer, in the plane that faces the camera.
const bodies = Object.entries(OFFER.bodies).map(([path, name]) => [node(path).object, name]);
const caster = new THREE.Raycaster(), plane = new THREE.Plane(), line = new THREE.Line(
  new THREE.BufferGeometry(), new THREE.LineBasicMaterial({ color: 0xd7263d }));
line.frustumCulled = false;
let drag = null;
viewer.scene.add(line);
function aim(event) {
  const box = viewer.renderer.domElement.getBoundingClientRect();
  const place = new THREE.Vector2((event.clientX - box.left) / box.width * 2 - 1, 1 - (event.clientY - box.top) / box.height * 2);
  caster.setFromCamera(place, viewer.camera);
}
function bodyOf(object) {
  let nearest = null;
  for (; object; object = object.parent) {
    if (!object.visible) return null;
    nearest ??= bodies.find(([body]) => body === object) ?? null;
  }
  return nearest;
}
function pick(event) {
  viewer.scene.updateMatrixWorld();  // poses may be newer than the picture
  aim(event);
  for (const hit of caster.intersectObject(node("/world/0").object, true)) {
    const [object, body] = bodyOf(hit.object) ?? [];
    if (object) return { object, body, at: hit.point };
  }
  return null;
}
function pull(event) {
  aim(event);
  const target = caster.ray.intersectPlane(plane, new THREE.Vector3());
  if (!target) return;
  drag.target = node("/world").object.worldToLocal(target.clone());
  post({ do: "drag", body: drag.body, point: drag.point.toArray(), target: drag.target.toArray() });
}
find("pane").addEventListener("pointerdown", event => {
  const hit = event.button === 0 ? pick(event) : null;
  if (!hit) return;
  event.stopPropagation();
  viewer.controls.enabled = false;
  find("pane").setPointerCapture(event.pointerId);
  plane.setFromNormalAndCoplanarPoint(viewer.camera.getWorldDirection(new THREE.Vector3()), hit.at);
  drag = { object: hit.object, body: hit.body, point: hit.object.worldToLocal(hit.at.clone()), target: null };
  pull(event);
}, true);
find("pane").addEventListener("pointermove", event => { if (drag) { event.stopPropagation(); pull(event); } }, true);
for (const kind of ["pointerup", "pointercancel"]) {
  find("pane").addEventListener(kind, () => {
    if (!drag) return;
    drag = null;
    viewer.controls.enabled = true;
    post({ do: "release" });
  }, true);
}
function drawPull() {
  line.visible = Boolean(drag && drag.target);
  if (line.visible) {
    const ends = [drag.object.localToWorld(drag.point.clone()), node("/world").object.localToWorld(drag.target.clone())];
    line.geometry.setFromPoints(ends.map(end => viewer.scene.worldToLocal(end)));
  }
  moveOverlays();
  viewer.set_dirty();
  requestAnimationFrame(drawPull);
}
drawPull();

// A film of the scene.
let film = null;
find("film").onclick = () => {
  if (film) { film.stop(); return; }
  const kind = ["video/mp4", "video/webm"].find(type => MediaRecorder.isTypeSupported(type)), parts = [];
  film = new MediaRecorder(viewer.renderer.domElement.captureStream(60), { mimeType: kind, videoBitsPerSecond: 8e6 });
  film.ondataavailable = event => parts.push(event.data);
  film.onstop = () => {
    download("live." + kind.split("/")[1], URL.createObjectURL(new Blob(parts, { type: kind })));
    film = null;
    find("film").textContent = "film";
    find("film").classList.remove("on");
  };
  film.start();
  find("film").textContent = "stop";
  find("film").classList.add("on");
};

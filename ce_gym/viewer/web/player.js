// The controls of a page that plays rollouts. Expects DATA and FRAME, scene.js, belts.js, overlays.js, graph.js and plots.js.

const robots = DATA.robots.map(robot => ({
  ...robot, times: numbers(robot.times, Float32Array), signals: unpacked(robot.signals),
  commanded: unpacked(robot.commanded), effort: numbers(robot.effort, Uint8Array),
}));

// Time.
const animator = viewer.animator;
find("time").max = animator.duration;

function seek(time) {
  animator.pause();
  animator.seek(time);
  animator.display_progress(Math.max(0, Math.min(animator.duration, time)));
}
function toggle() { animator.playing ? animator.pause() : animator.play(); }
function step(frames) { seek(animator.time + frames * FRAME); }

find("play").onclick = toggle;
find("time").oninput = event => seek(Number(event.target.value));
find("speed").onchange = event => { animator.mixer.timeScale = Number(event.target.value); };
document.addEventListener("keydown", event => {
  if (event.target.tagName === "SELECT") return;
  const keys = { " ": toggle, ArrowLeft: () => step(-1), ArrowRight: () => step(1), Home: () => seek(0) };
  if (event.key in keys) { event.preventDefault(); keys[event.key](); }
});

// The first action moves the world under the camera; without weight the world stays at rest.
function follow(on) {
  animator.actions[0].setEffectiveWeight(on ? 1 : 0);
  animator.mixer.update(0);
}
robots.forEach((robot, i) => { if (robot.ghost) addGhost(`/world/${i}`); });

// Links of solid robots with the number of their joint; links without a motor stay grey.
const REST = new THREE.Color(0xcfd8e1), HALF = new THREE.Color(0xf2b134), FULL = new THREE.Color(0xd7263d);
const painted = [];
robots.forEach(robot => {
  if (robot.ghost || !robot.paths.length) return;
  const joints = new Map(robot.paths.map((path, joint) => [node(path).object, joint]));
  node(robot.paths[0].split("/").slice(0, 3).join("/")).object.traverse(object => {
    if (!object.isMesh || !/^link_\d+$/.test(object.parent.name)) return;
    const color = object.material.color;
    painted.push({ robot, color, own: color.clone(), joint: joints.get(object.parent.parent) });
  });
});
function paint(time) {
  for (const { robot, color, joint } of painted) {
    const frame = frameAt(robot.times, time);
    const share = joint === undefined ? 0 : robot.effort[frame * robot.paths.length + joint] / 255;
    if (share < 0.5) color.copy(REST).lerp(HALF, 2 * share); else color.copy(HALF).lerp(FULL, 2 * share - 1);
  }
}
function torque(on) {
  find("scale").style.display = on ? "block" : "none";
  if (!on) for (const { color, own } of painted) color.copy(own);
}
if (!painted.length) find("torque").parentElement.style.display = "none";

for (const box of document.querySelectorAll("#about [data-paths]")) {
  box.onchange = () => {
    for (const path of JSON.parse(box.dataset.paths)) node(path).object.visible = box.checked;
    viewer.set_dirty();
  };
}
const few = window.innerWidth <= 820 ? 1 : DATA.chosen.length;
const plots = makePlots(find("plots"), robots, DATA.chosen.slice(0, few), {
  span: [0, animator.duration], unit: "s", seek, file: document.title,
});
if (!DATA.chosen.length) for (const hidden of [find("plots"), find("charts").parentElement]) hidden.style.display = "none";

// Text after # in the address sets the view: #t=4.2&xray&torque&charts=0 opens the page paused at 4.2 s.
const wanted = new URLSearchParams(location.hash.slice(1));
if (wanted.has("t")) seek(Number(wanted.get("t")));
offerOverlays();
connect({ follow, torque, charts: on => { find("plots").style.display = on ? "" : "none"; } });

// In a narrow window the robot stands above plots and bar.
function shift() {
  const width = find("pane").offsetWidth, height = find("pane").offsetHeight;
  const hidden = width <= 820 ? find("low").offsetHeight - find("about").offsetHeight : 0;
  viewer.camera.setViewOffset(width, height, 0, hidden / 2, width, height);
  viewer.set_dirty();
}
window.addEventListener("resize", shift);
find("charts").addEventListener("change", shift);
shift();

function refresh() {
  moveFields();
  moveOverlays();
  find("play").innerHTML = animator.playing ? "&#10074;&#10074;" : "&#9654;";
  if (document.activeElement !== find("time") || animator.playing) find("time").value = animator.time;
  find("clock").value = animator.time.toFixed(2) + " / " + animator.duration.toFixed(2) + " s";
  if (find("torque").checked) { paint(animator.time); viewer.set_dirty(); }
  plots.move(animator.time);
  requestAnimationFrame(refresh);
}
refresh();

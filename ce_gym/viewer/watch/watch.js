// The page of a training run. Expects HORIZON, meshcat's viewer, ground.js, graph.js and plots.js.

const find = id => document.getElementById(id);
const viewer = new MeshCat.Viewer(find("pane"));
const resize = viewer.set_3d_pane_size.bind(viewer);  // would take the height of the window
viewer.set_3d_pane_size = () => resize(find("pane").offsetWidth, find("pane").offsetHeight);
viewer.set_3d_pane_size();
viewer.scene.fog = new MeshCat.THREE.Fog(HORIZON, 8, 40);
viewer.gui.domElement.hidden = true;  // meshcat's own panel, by the key C
document.addEventListener("keydown", event => {
  if (event.key === "c") viewer.gui.domElement.hidden = !viewer.gui.domElement.hidden;
});
const node = path => viewer.scene_tree.find(path.split("/").filter(Boolean));

let state = null, plots = null, received = 0, drawn = false;
const events = new EventSource("events");
events.onerror = () => { find("notice").textContent = "has stopped"; };

// The robot, and the ground around it.
events.addEventListener("scene", event => {
  viewer.handle_command({ type: "delete", path: "/world" });
  for (const command of JSON.parse(event.data)) {
    viewer.handle_command_bytearray(Uint8Array.from(atob(command), c => c.charCodeAt(0)));
  }
  drawn = true;
  find("waiting").style.display = "none";
  find("pane").style.visibility = "visible";
});
events.addEventListener("ground", event => viewer.handle_command(JSON.parse(event.data)));

// Curves: all runs over the steps.
const unpacked = packed => Object.fromEntries(Object.entries(packed).map(([name, text]) => [name, numbers(text, Float32Array)]));
events.addEventListener("curves", event => {
  const told = JSON.parse(event.data);
  const sources = told.sources.map(one => ({
    ...one, times: numbers(one.times, Float32Array), signals: unpacked(one.signals), commanded: {}, limits: {},
  }));
  find("runs").replaceChildren();
  for (const { name, color } of told.sources.length > 1 ? told.sources : []) {
    const text = element("span", find("runs"));
    element("i", text, { style: `background: ${color}` });
    text.append(name);
  }
  if (plots) plots.replace(sources, told.span);
  else if (told.chosen.length) {
    plots = makePlots(find("plots"), sources, told.chosen, { span: told.span, unit: "steps", seek: null, file: document.title });
  }
});

events.onmessage = event => {
  const told = JSON.parse(event.data);
  for (const [path, matrix] of Object.entries(drawn ? told.moves : {})) {
    viewer.handle_command({ type: "set_transform", path, matrix });
  }
  if (drawn) moveFields();
  state = told.state;
  received++;
  tell();
};

const many = count => count >= 1e6 ? (count / 1e6).toFixed(2) + " M" : count >= 1e4 ? Math.round(count / 1e3) + " k" : String(count);
function clock(seconds) {
  const [hours, minutes, rest] = [seconds / 3600, seconds / 60 % 60, seconds % 60].map(Math.floor);
  return (hours ? hours + " h " : "") + (hours || minutes ? minutes + " min " : "") + (hours ? "" : rest + " s");
}
function tell() {
  const { steps, total, seconds, ended, finished } = state, left = total > steps ? seconds / steps * (total - steps) : 0;
  find("steps").textContent = `${many(steps)}${total ? " of " + many(total) : ""} steps in ${clock(seconds)}`
    + (ended ? finished ? ", finished" : ", ended early" : steps && left ? `, about ${clock(left)} left` : "");
  find("progress").style.display = total ? "" : "none";
  find("progress").firstElementChild.style.width = `${100 * Math.min(1, steps / (total || 1))}%`;
  find("policy").textContent = state.policy_steps === null ? "" : `policy after ${many(state.policy_steps)} steps`;
  find("waiting").textContent = state.making ? "compiling its environment ..." : "no policy yet";
  if (state.command) {
    const [[x, y, turn], [vx, vy, spin]] = [state.command, state.moves].map(row => row.map(number => number.toFixed(1)));
    find("speeds").textContent = `commanded ${x} ${y} m/s, ${turn} rad/s · moves ${vx} ${vy} m/s, ${spin} rad/s`;
  }
  find("notice").textContent = state.notice;
}

function refresh() {
  if (plots) plots.move(null);
  requestAnimationFrame(refresh);
}
refresh();

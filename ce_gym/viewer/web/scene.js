// The scene of every page: meshcat's viewer and the objects of COMMANDS. Expects HORIZON, COMMANDS and ground.js.

const find = id => document.getElementById(id);
const THREE = MeshCat.THREE;
let viewer;
try {
  viewer = new MeshCat.Viewer(find("pane"));
} catch (error) {
  find("pane").textContent = "This page needs WebGL, which this browser does not offer.";
  throw error;
}
const node = path => viewer.scene_tree.find(path.split("/").filter(Boolean));

function draw(commands) {
  for (const command of commands) {
    viewer.handle_command_bytearray(Uint8Array.from(atob(command), c => c.charCodeAt(0)));
  }
}
function move(matrices) {
  for (const [path, matrix] of Object.entries(matrices)) viewer.handle_command({ type: "set_transform", path, matrix });
  moveFields();
}
// Draws a ghost behind a robot in the same place; without this their surfaces flicker.
function drawBehind(ghost) {
  ghost.traverse(({ material }) => {
    if (material) Object.assign(material, { polygonOffset: true, polygonOffsetFactor: 1, polygonOffsetUnits: 4 });
  });
}
// Keeps the whole robot in a narrow window.
function fit() {
  viewer.camera.zoom = Math.min(1, 1.2 * find("pane").offsetWidth / find("pane").offsetHeight);
  viewer.camera.updateProjectionMatrix();
  viewer.set_dirty();
}
function download(name, url) {
  const link = document.createElement("a");
  Object.assign(link, { href: url, download: name });
  link.click();
}

draw(COMMANDS);
const resize = viewer.set_3d_pane_size.bind(viewer);  // by itself it takes the height of the window
viewer.set_3d_pane_size = () => resize(find("pane").offsetWidth, find("pane").offsetHeight);
viewer.set_3d_pane_size();
viewer.scene.fog = new THREE.Fog(HORIZON, 8, 40);
viewer.gui.domElement.hidden = true;  // meshcat's own panel; key C shows it
document.addEventListener("keydown", event => {
  if (event.key !== "c" || event.ctrlKey || event.metaKey || event.target.tagName === "SELECT") return;
  viewer.gui.domElement.hidden = !viewer.gui.domElement.hidden;
});
window.addEventListener("resize", fit);
fit();

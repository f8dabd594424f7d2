// X-ray and overlays of robots, each with a box in the list #overlays. Expects scene.js and belts.js.

const OVERLAYS = { contacts: "contacts", frames: "frames", inertia: "inertia boxes", collision: "collision shapes",
                   center: "centre of mass" };

function overlayNodes(kind) {
  const found = [];
  viewer.scene.traverse(object => { if (object.name === `overlay_${kind}`) found.push(object); });
  return found;
}
// Overlays are drawn over the links that hide them, and have no shadow.
function showOverlay(kind, on) {
  for (const group of overlayNodes(kind)) {
    group.visible = on;
    group.traverse(object => {
      if (!object.isMesh) return;
      Object.assign(object, { castShadow: false, receiveShadow: false, renderOrder: 1 });
      Object.assign(object.material, { depthTest: false, transparent: true });
    });
  }
}
// Places each ball at the mean of its robot's bodies, weighted with their masses.
function moveCenters() {
  viewer.scene.updateMatrixWorld();
  for (const group of overlayNodes("center")) {
    const sum = new THREE.Vector3(), point = new THREE.Vector3();
    let total = 0;
    group.traverse(({ userData }) => {
      for (const [path, mass, x, y, z] of userData.center_of_mass ?? []) {
        sum.addScaledVector(node(path).object.localToWorld(point.set(x, y, z)), mass);
        total += mass;
      }
    });
    group.position.copy(group.parent.worldToLocal(sum.divideScalar(total)));
  }
}

// X-ray leaves ghosts unchanged: two transparent robots could not be told apart.
const ghostly = new Set();
function addGhost(path) {
  node(path).object.traverse(object => ghostly.add(object));
  drawBehind(node(path).object);
}
function xray(on) {
  viewer.scene.traverse(object => {
    if (ghostly.has(object)) return;
    if (object.name === "inside") object.visible = on;
    if (!object.isMesh || !/^link_\d+$/.test(object.parent.name)) return;
    const material = object.material;
    material.userData.opacity ??= material.opacity;
    material.opacity = material.userData.opacity * (on ? 0.3 : 1);
    material.transparent = material.opacity < 1;
    material.depthWrite = !on;
    material.needsUpdate = true;
  });
}

// Connects boxes with what they change. Text after # in the address sets them: #xray&contacts&plots=0.
function connect(changes) {
  const wanted = new URLSearchParams(location.hash.slice(1));
  for (const [id, change] of Object.entries(changes)) {
    const box = find(id);
    box.onchange = () => { change(box.checked); viewer.set_dirty(); };
    if (wanted.has(id)) { box.checked = wanted.get(id) !== "0"; box.onchange(); }
  }
}
function addBox(id, text) {
  const label = find("overlays").appendChild(document.createElement("li")).appendChild(document.createElement("label"));
  label.append(Object.assign(document.createElement("input"), { type: "checkbox", id }), " " + text);
}
// Makes a box for each overlay that the robots of the scene have.
function offerOverlays() {
  findBelts();
  if (!find("xray")) addBox("xray", "x-ray");
  const kinds = Object.keys(OVERLAYS).filter(kind => overlayNodes(kind).length);
  for (const kind of kinds) addBox(kind, OVERLAYS[kind]);
  connect({ xray, ...Object.fromEntries(kinds.map(kind => [kind, on => showOverlay(kind, on)])) });
}
function moveOverlays() {
  if (find("xray")?.checked) moveBelts();
  if (find("center")?.checked) moveCenters();
}

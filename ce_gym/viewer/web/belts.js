// Belts: moves strands and turns pulleys with their joints. Expects scene.js.

const MARKS = 8;  // around a pulley
const belts = [];

function findBelts() {
  viewer.scene.traverse(object => { if (object.userData.belt) belts.push(object); });
  for (const object of belts) if (object.userData.belt.reach) mark(object);
}

// Light bars along a strand, one after each eighth of a pulley.
function mark(strand) {
  const { length, width, height, reach } = strand.userData.belt;
  const pitch = 2 * Math.PI * Math.abs(reach) / MARKS, row = new THREE.Group();
  const material = strand.material.clone();
  material.color.set(0xedf0f2);
  for (let k = 0; k < Math.floor(length / pitch); k++) {
    const bar = new THREE.Mesh(new THREE.BoxGeometry(0.3 * pitch, 1.6 * width, 1.02 * height), material);
    bar.position.x = (k + 0.15) * pitch - length / 2;
    row.add(bar);
  }
  strand.add(row);
  Object.assign(strand.userData.belt, { pitch, row });
}

// Angle of a joint [rad]; whole turns are lost, and a belt of whole marks looks the same after one.
function angle({ path, rest, axis, sign }) {
  const turned = new THREE.Quaternion(...rest).invert().multiply(node(path).object.quaternion);
  return sign * 2 * Math.atan2(turned.x * axis[0] + turned.y * axis[1] + turned.z * axis[2], turned.w);
}

function moveBelts() {
  for (const object of belts) {
    const { links, axis, reach, pitch, row } = object.userData.belt;
    const turn = links.reduce((sum, link) => sum + angle(link), 0);
    if (row) row.position.x = ((reach * turn) % pitch + pitch) % pitch;
    else object.parent.quaternion.setFromAxisAngle(new THREE.Vector3(...axis), turn);
  }
}

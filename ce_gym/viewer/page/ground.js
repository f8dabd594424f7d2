// Ground that is not flat: draws the fields that the scene's commands carry, each around its robots, fading away from
// them into the horizon. Expects meshcat's viewer, its node() and HORIZON. Knows nothing of robots.

const TILE = 1.0;  // edge of the square that the ground's image repeats over [m]
const fields = [];

// Heights as control values of a biquadratic spline -> the surface at every height and halfway between. One call does
// one direction and swaps the two: (rows, columns) -> (columns, 2 rows - 3).
function refined(heights, rows, columns) {
  const count = 2 * rows - 3, result = new Float32Array(columns * count);
  for (let j = 0; j < columns; j++) {
    const at = i => heights[i * columns + j];
    for (let i = 0; i < count; i++) {
      const k = (i + 1) >> 1;
      result[j * count + i] = i % 2 ? (at(k - 1) + 6 * at(k) + at(k + 1)) / 8 : (at(k) + at(k + 1)) / 2;
    }
  }
  return result;
}

function fieldGeometry(field) {
  const bytes = Uint8Array.from(atob(field.heights), c => c.charCodeAt(0));
  const heights = Float32Array.from(new Uint16Array(bytes.buffer), number => field.low + field.step * number);
  const rows = 2 * field.rows - 3, columns = 2 * field.columns - 3;
  const surface = refined(refined(heights, field.rows, field.columns), field.columns, rows);
  const positions = new Float32Array(3 * rows * columns), spots = new Float32Array(2 * rows * columns);
  for (let i = 0, at = 0; i < rows; i++) for (let j = 0; j < columns; j++, at++) {
    const x = field.origin[0] + field.cell / 2 * (i + 1), y = field.origin[1] + field.cell / 2 * (j + 1);
    positions.set([x, y, surface[at]], 3 * at);
    spots.set([x / TILE, y / TILE], 2 * at);
  }
  const corners = new Uint32Array(6 * (rows - 1) * (columns - 1));
  for (let i = 0, at = 0; i < rows - 1; i++) for (let j = 0; j < columns - 1; j++, at += 6) {
    const a = i * columns + j, b = a + columns;
    corners.set([a, b, b + 1, a, b + 1, a + 1], at);
  }
  const geometry = new MeshCat.THREE.BufferGeometry();
  geometry.setAttribute("position", new MeshCat.THREE.BufferAttribute(positions, 3));
  geometry.setAttribute("uv", new MeshCat.THREE.BufferAttribute(spots, 2));
  geometry.setIndex(new MeshCat.THREE.BufferAttribute(corners, 1));
  geometry.computeVertexNormals();
  return geometry;
}

// Only what is near a robot is drawn, by a few lines added to three.js' own shader.
function drawField(mesh) {
  const field = mesh.userData.field, count = field.bodies.length;
  const places = field.bodies.map(() => new MeshCat.THREE.Vector2());
  mesh.geometry = fieldGeometry(field);
  mesh.castShadow = false;
  mesh.material.onBeforeCompile = shader => {
    const horizon = new MeshCat.THREE.Color(HORIZON);
    Object.assign(shader.uniforms, { places: { value: places }, reach: { value: field.reach }, horizon: { value: horizon } });
    shader.vertexShader = shader.vertexShader.replace("void main() {", "varying vec3 spot;\nvoid main() {\n  spot = vec3(position.xy, normal.z);");
    shader.fragmentShader = shader.fragmentShader
      .replace("void main() {", `
        varying vec3 spot;  // place, and how level the ground is there
        uniform vec2 places[${count}];
        uniform float reach;
        uniform vec3 horizon;
        void main() {
          float away = reach + 1.0;
          for (int i = 0; i < ${count}; i++) away = min(away, distance(spot.xy, places[i]));
          if (away > reach) discard;`)
      .replace("#include <fog_fragment>", `#include <fog_fragment>
        gl_FragColor.rgb *= 1.0 - float(${field.steep}) * sqrt(max(1.0 - spot.z * spot.z, 0.0));
        gl_FragColor.rgb = mix(gl_FragColor.rgb, horizon, smoothstep(float(${field.fading}) * reach, reach, away));`);
  };
  mesh.material.customProgramCacheKey = () => `field of ${count}`;
  mesh.material.needsUpdate = true;  // it may have been drawn before
  const dots = field.scan && drawScan(mesh, field);
  fields.push({ mesh, places, bodies: field.bodies, dots });
  viewer.set_dirty();
}

// Points of a height scan, on the field.
function drawScan(mesh, field) {
  const geometry = new MeshCat.THREE.BufferGeometry();
  geometry.setAttribute("position", new MeshCat.THREE.BufferAttribute(new Float32Array(3 * field.scan.length), 3));
  const look = new MeshCat.THREE.PointsMaterial({ color: field.color, size: 5, sizeAttenuation: false });
  const dots = new MeshCat.THREE.Points(geometry, look);
  dots.frustumCulled = false;
  mesh.add(dots);
  return dots;
}

// Height of what is drawn of a field, between its vertices.
function heightOf(mesh, x, y) {
  const field = mesh.userData.field, columns = 2 * field.columns - 3, rows = 2 * field.rows - 3;
  const vertices = mesh.geometry.attributes.position.array, step = field.cell / 2;
  const along = (at, first, count) => Math.min(Math.max((at - first) / step - 1, 0), count - 1.001);
  const u = along(x, field.origin[0], rows), w = along(y, field.origin[1], columns);
  const i = Math.floor(u), j = Math.floor(w), s = u - i, t = w - j;
  const z = (a, b) => vertices[3 * ((i + a) * columns + j + b) + 2];
  return (1 - s) * ((1 - t) * z(0, 0) + t * z(0, 1)) + s * ((1 - t) * z(1, 0) + t * z(1, 1));
}

// The grid turns with the heading of the base, not with roll and pitch.
function moveScan({ mesh, dots, bodies }) {
  const base = node(bodies[0]).object, ahead = new MeshCat.THREE.Vector3(1, 0, 0).applyQuaternion(base.quaternion);
  const length = Math.hypot(ahead.x, ahead.y) || 1, c = ahead.x / length, s = ahead.y / length;
  const place = dots.geometry.attributes.position;
  mesh.userData.field.scan.forEach(([forward, left], i) => {
    const x = base.position.x + c * forward - s * left, y = base.position.y + s * forward + c * left;
    place.setXYZ(i, x, y, heightOf(mesh, x, y) + 0.01);  // above the ground, to be seen
  });
  place.needsUpdate = true;
}

// Lets the ground follow the robots' bases. Objects with images appear some time after their commands.
function moveFields() {
  const loaded = [];
  viewer.scene.traverse(object => { if (object.userData.field && !fields.some(one => one.mesh === object)) loaded.push(object); });
  loaded.forEach(drawField);
  fields.splice(0, fields.length, ...fields.filter(field => field.mesh.parent));  // others have been replaced
  for (const { places, bodies } of fields) {
    bodies.forEach((path, i) => { const { x, y } = node(path).object.position; places[i].set(x, y); });
  }
  fields.filter(field => field.dots).forEach(moveScan);
}

// Uneven ground: draws the fields of the scene's commands around their robots, fading into the horizon. Expects HORIZON
// and scene.js.

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
  const geometry = new THREE.BufferGeometry();
  geometry.setAttribute("position", new THREE.BufferAttribute(positions, 3));
  geometry.setAttribute("uv", new THREE.BufferAttribute(spots, 2));
  geometry.setIndex(new THREE.BufferAttribute(corners, 1));
  geometry.computeVertexNormals();
  return geometry;
}

// Lines added to the shader of three.js draw only the ground near a robot.
function drawField(mesh) {
  const field = mesh.userData.field, count = field.bodies.length;
  const places = field.bodies.map(() => new THREE.Vector2());
  mesh.geometry = fieldGeometry(field);
  mesh.castShadow = false;
  mesh.material.onBeforeCompile = shader => {
    const horizon = new THREE.Color(HORIZON);
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
  mesh.material.needsUpdate = true;  // it may be compiled already
  fields.push({ mesh, places, bodies: field.bodies, ...(field.scans && drawScans(mesh, field)) });
  viewer.set_dirty();
}

// Scans: dots on the field, and lines for the rays of range scans.
function drawScans(mesh, { scans, color }) {
  const { BufferGeometry, BufferAttribute, Points, PointsMaterial, LineSegments, LineBasicMaterial } = THREE;
  const count = key => scans.reduce((sum, scan) => sum + (scan[key] || []).length, 0);
  const shape = size => new BufferGeometry().setAttribute("position", new BufferAttribute(new Float32Array(3 * size), 3));
  const dots = new Points(shape(count("points") + count("rays")), new PointsMaterial({ color, size: 5, sizeAttenuation: false }));
  const lines = new LineSegments(shape(2 * count("rays")), new LineBasicMaterial({ color, transparent: true, opacity: 0.35 }));
  for (const drawn of [dots, lines]) { drawn.frustumCulled = false; mesh.add(drawn); }
  return { dots, lines };
}

// Height of the drawn field, interpolated between its vertices.
function heightOf(mesh, x, y) {
  const field = mesh.userData.field, columns = 2 * field.columns - 3, rows = 2 * field.rows - 3;
  const vertices = mesh.geometry.attributes.position.array, step = field.cell / 2;
  const along = (at, first, count) => Math.min(Math.max((at - first) / step - 1, 0), count - 1.001);
  const u = along(x, field.origin[0], rows), w = along(y, field.origin[1], columns);
  const i = Math.floor(u), j = Math.floor(w), s = u - i, t = w - j;
  const z = (a, b) => vertices[3 * ((i + a) * columns + j + b) + 2];
  return (1 - s) * ((1 - t) * z(0, 0) + t * z(0, 1)) + s * ((1 - t) * z(1, 0) + t * z(1, 1));
}

// The point where a ray hits the field, by the sensor's steps, or its end.
function hitOf(mesh, start, along, { reach, steps }) {
  const at = distance => start.clone().addScaledVector(along, distance);
  const above = distance => { const { x, y, z } = at(distance); return z - heightOf(mesh, x, y); };
  let low = 0, over = above(0);
  if (over <= 0) return start;
  for (let k = 1; k <= steps; k++) {
    let high = reach * k / steps, under = above(high);
    if (under > 0) { [low, over] = [high, under]; continue; }
    const middle = low + (high - low) * over / (over - under), here = above(middle);
    if (here > 0) [low, over] = [middle, here]; else [high, under] = [middle, here];
    return at(low + (high - low) * over / (over - under));
  }
  return at(reach);
}

// Grids turn with the heading of the base, not with roll and pitch; rays turn with their link.
function moveScans({ mesh, dots, lines, bodies }) {
  const { Vector3, Matrix4 } = THREE, base = node(bodies[0]).object, field = mesh.userData.field;
  const ahead = new Vector3(1, 0, 0).applyQuaternion(base.quaternion), length = Math.hypot(ahead.x, ahead.y) || 1;
  const c = ahead.x / length, s = ahead.y / length, [dot, end] = [dots, lines].map(drawn => drawn.geometry.attributes.position);
  let i = 0, j = 0;
  mesh.updateWorldMatrix(true, false);
  for (const scan of field.scans) {
    const link = node(scan.path).object;
    link.updateWorldMatrix(true, false);
    const pose = new Matrix4().copy(mesh.matrixWorld).invert().multiply(link.matrixWorld), middle = new Vector3();
    for (const place of scan.at) middle.addScaledVector(new Vector3(...place).applyMatrix4(pose), 1 / scan.at.length);
    for (const [forward, left] of scan.points || []) {
      const x = middle.x + c * forward - s * left, y = middle.y + s * forward + c * left;
      dot.setXYZ(i++, x, y, heightOf(mesh, x, y) + 0.01);  // above the ground, to be seen
    }
    for (const along of scan.rays || []) {
      const hit = hitOf(mesh, middle, new Vector3(...along).transformDirection(pose), scan);
      dot.setXYZ(i++, hit.x, hit.y, hit.z + 0.01);
      end.setXYZ(j++, middle.x, middle.y, middle.z);
      end.setXYZ(j++, hit.x, hit.y, hit.z);
    }
  }
  dot.needsUpdate = end.needsUpdate = true;
}

// Lets the ground follow the robots' bases. Objects with images appear some time after their commands.
function moveFields() {
  const loaded = [];
  viewer.scene.traverse(object => { if (object.userData.field && !fields.some(field => field.mesh === object)) loaded.push(object); });
  loaded.forEach(drawField);
  fields.splice(0, fields.length, ...fields.filter(field => field.mesh.parent));  // without replaced fields
  for (const { places, bodies } of fields) {
    bodies.forEach((path, i) => { const { x, y } = node(path).object.position; places[i].set(x, y); });
  }
  fields.filter(field => field.dots).forEach(moveScans);
}

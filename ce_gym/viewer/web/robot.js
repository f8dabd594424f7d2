// The page of a robot file: a slider for each independent joint, and the values of the joints that follow. Expects
// SLIDERS, STANDING, DEPENDENT, SUMMARY, scene.js, overlays.js and stream.js.

offerOverlays();
find("summary").textContent = SUMMARY;

function addRow(table, { name, link, unit, limits: [low, high], effort }) {
  const row = find(table).insertRow();
  row.title = `link ${link}, limits ${low ?? "-∞"} to ${high ?? "∞"} ${unit}`
    + (effort === null ? "" : `, effort ${effort} ${unit === "m" ? "N" : "N m"}`);
  row.insertCell().textContent = name;
  return row;
}
const sliders = SLIDERS.map(slider => {
  const cell = addRow("joints", slider).insertCell();
  cell.className = "slider";
  const input = cell.appendChild(document.createElement("input"));
  Object.assign(input, { type: "range", min: slider.low, max: slider.high, step: "any", ariaLabel: slider.name });
  input.oninput = moveRobot;
  return input;
});
for (const joint of DEPENDENT) addRow("dependent", joint);
if (!DEPENDENT.length) find("others").style.display = "none";
const valueCells = table => [...find(table).rows].map(row => {
  const cell = row.insertCell();
  cell.className = "value";
  return cell;
});
const cells = [...valueCells("joints"), ...valueCells("dependent")], joints = [...SLIDERS, ...DEPENDENT];

function moveRobot() {
  post({ do: "move", values: sliders.map(slider => Number(Number(slider.value).toFixed(5))) });
}
function moveTo(values) {
  sliders.forEach((slider, i) => { slider.value = values[i]; });
  moveRobot();
}
find("standing").onclick = () => moveTo(STANDING);
find("zero").onclick = () => moveTo(SLIDERS.map(() => 0));

function tell() {
  if (!waiting.size) {
    sliders.forEach((slider, i) => { if (slider !== document.activeElement || state.notice) slider.value = state.values[i]; });
  }
  [...state.values, ...state.dependent].forEach((value, i) => {
    const { unit, limits: [low, high] } = joints[i];
    cells[i].textContent = `${value.toFixed(3)} ${unit}`;
    cells[i].title = unit === "rad" ? `${(value * 180 / Math.PI).toFixed(1)}°` : "";
    cells[i].classList.toggle("beyond", value < (low ?? -Infinity) - 1e-4 || value > (high ?? Infinity) + 1e-4);
  });
  find("notice").textContent = state.notice;
}

function refresh() {
  moveOverlays();
  viewer.set_dirty();
  requestAnimationFrame(refresh);
}
refresh();

// Plots beside the scene: each shows one signal of every robot, what was commanded and what the robot allows, with a
// line at the present time. The wheel zooms into time around that line. Knows nothing of the scene.

let zoom = 1;  // of all plots: how much shorter the time shown is than the whole

function numbers(text, kind) {
  return new kind(Uint8Array.from(atob(text), c => c.charCodeAt(0)).buffer);
}

// Last frame at or before a time.
function frameAt(times, time) {
  let low = 0, high = times.length - 1;
  while (low < high) {
    const middle = (low + high + 1) >> 1;
    if (times[middle] <= time + 1e-6) low = middle; else high = middle - 1;
  }
  return low;
}

function unpackRobots(robots) {
  const all = packed => Object.fromEntries(Object.entries(packed).map(([k, v]) => [k, numbers(v, Float32Array)]));
  return robots.map(robot => ({
    ...robot, times: numbers(robot.times, Float32Array), signals: all(robot.signals),
    commanded: all(robot.commanded), effort: numbers(robot.effort, Uint8Array),
  }));
}

function element(tag, parent, attributes = {}) {
  const svg = tag === "svg" || parent.namespaceURI.endsWith("svg");
  const made = svg ? document.createElementNS("http://www.w3.org/2000/svg", tag) : document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) made.setAttribute(name, value);
  parent.appendChild(made);
  return made;
}

// One plot; returns what moves its line to a time. It asks for that by `redraw` where nothing else has changed.
function makePlot(parent, robots, name, duration, seek, redraw) {
  const box = element("div", parent, { class: "plot" });
  const select = element("select", box, { "aria-label": "Signal" });
  for (const known of [...new Set(robots.flatMap(robot => Object.keys(robot.signals)))]) {
    element("option", select, { value: known }).textContent = known;
  }
  const graph = element("div", box, { class: "graph" });
  const svg = element("svg", graph, { preserveAspectRatio: "none" });
  const top = element("div", graph, { class: "end" }), bottom = element("div", graph, { class: "end low" });
  const values = element("div", box, { class: "values" });
  let lines = [], now, shown = 0;  // shown: when the time shown begins [s]

  function show(signal) {
    lines = robots.filter(robot => signal in robot.signals)
      .map(robot => ({ color: robot.color, times: robot.times, values: robot.signals[signal] }));
    const told = robots.find(robot => signal in robot.commanded);
    let [low, high] = [0, 0];
    for (const line of lines) for (const value of line.values) { low = Math.min(low, value); high = Math.max(high, value); }
    if (high === low) high = low + 1;
    const limit = robots.map(robot => robot.limits[signal]).find(value => value !== undefined);
    const room = 0.06 * (high - low);
    const y = value => 100 - 100 * (value - low + room) / (high - low + 2 * room);
    const path = (times, numbers) => "M" + Array.from(numbers, (v, i) => `${times[i].toFixed(3)},${y(v).toFixed(2)}`).join("L");
    svg.replaceChildren();
    const straight = value => element("path", svg, { d: `M0,${y(value)}H${duration}`, stroke: "#cbd2d9" });
    straight(0);
    for (const value of [limit, -limit]) if (value > low && value < high) straight(value).setAttribute("stroke-dasharray", "4 3");
    if (told) element("path", svg, { d: path(told.times, told.commanded[signal]), stroke: "#21a659", "stroke-dasharray": "5 3" });
    for (const line of [...lines].reverse()) element("path", svg, { d: path(line.times, line.values), stroke: line.color });
    now = element("path", svg, { class: "now" });
    top.textContent = high.toPrecision(3);
    bottom.textContent = low.toPrecision(3);
  }

  function drag(event) {
    if (event.type === "pointerdown") svg.setPointerCapture(event.pointerId);
    if (!svg.hasPointerCapture(event.pointerId)) return;
    const area = svg.getBoundingClientRect();
    seek(Math.max(0, Math.min(duration, shown + duration / zoom * (event.clientX - area.left) / area.width)));
  }
  svg.onwheel = event => {
    event.preventDefault();
    zoom = Math.max(1, Math.min(duration / 0.2, zoom * (event.deltaY < 0 ? 1.25 : 0.8)));
    redraw();
  };
  svg.onpointerdown = svg.onpointermove = drag;
  select.onchange = () => { show(select.value); redraw(); };
  select.value = name;
  show(name);

  return time => {
    const width = duration / zoom;
    shown = Math.max(0, Math.min(duration - width, time - width / 2));
    svg.setAttribute("viewBox", `${shown} 0 ${width} 100`);
    now.setAttribute("d", `M${time},0V100`);
    const texts = lines.map(line => line.values[frameAt(line.times, time)].toPrecision(3));
    values.replaceChildren();
    texts.forEach((text, i) => { element("span", values, { style: "color:" + lines[i].color }).textContent = text; });
  };
}

// Plots beside a scene: signals of every source (a robot, a run) over time or steps, and their present values. All plots
// share one view of time. Expects graph.js and scene.js.

const COLORS = ["#1f2933", "#d9480f", "#1c7ed6", "#2b8a3e", "#9c36b5", "#c2255c"];  // of several signals in one plot
const COMMANDED = "#21a659", DASHED = [6, 3], TALL = 118;

function element(tag, parent, attributes = {}) {
  const child = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) child.setAttribute(name, value);
  parent.appendChild(child);
  return child;
}

function button(parent, text, title, act) {
  const made = element("button", parent, { title, "aria-label": title });
  made.textContent = text;
  made.onclick = () => { act(); made.blur(); };
}

// Panel of plots.
//   sources: {name, color, times, signals, commanded, limits}, see charts.py; names: the signal or signals of each first plot;
//   span: first and last time; seek: called with the time at the pointer, null where time cannot be chosen.
function makePlots(parent, sources, names, { span, unit, seek, file }) {
  let view = [...span], now = seek ? span[0] : null, drawn = "";
  const plots = [], redraw = () => { drawn = ""; };
  const tools = element("div", parent, { class: "tools" }), list = element("div", parent, { class: "plotlist" });

  const known = () => [...new Set(sources.flatMap(source => Object.keys(source.signals)))];
  function curvesOf(signals) {
    return signals.flatMap((signal, k) => {
      const commanded = sources.find(source => signal in source.commanded);
      const curves = sources.filter(source => signal in source.signals).map((source, i) => ({
        signal, name: source.name, times: source.times, values: source.signals[signal],
        color: signals.length > 1 ? COLORS[k % COLORS.length] : source.color, dash: signals.length > 1 && i ? DASHED : [],
      }));
      const command = { signal, name: "commanded", color: COMMANDED, dash: [4, 3] };
      return commanded ? [...curves, { ...command, times: commanded.times, values: commanded.commanded[signal] }] : curves;
    });
  }
  function contentOf(plot) {
    const curves = curvesOf(plot.signals), range = rangeOf(curves.map(curve => curve.values));
    const largest = plot.signals.map(signal => sources.map(source => source.limits[signal]).find(Number.isFinite));
    const limits = plot.signals.length > 1 ? [] : largest.flatMap(limit => limit ? [limit, -limit] : []);
    return { curves, range, limits: limits.filter(value => value > range[0] && value < range[1]) };
  }

  // Rows of a plot: a signal to choose, the values of its curves now.
  function fill(plot) {
    plot.rows.replaceChildren();
    plot.content = contentOf(plot);
    plot.signals.forEach((signal, k) => {
      const row = element("div", plot.rows, { class: "signal" });
      const select = element("select", row, { "aria-label": "Signal" });
      for (const name of known()) element("option", select, { value: name }).textContent = name;
      select.value = signal;
      select.onchange = () => { plot.signals[k] = select.value; fill(plot); };
      if (k === plot.signals.length - 1) button(row, "+", "Another signal in this plot", () => { plot.signals.push(signal); fill(plot); });
      button(row, "×", "Remove this signal", () => { plot.signals.splice(k, 1); plot.signals.length ? fill(plot) : remove(plot); });
      const curves = plot.content.curves.filter(one => one.signal === signal);
      const inline = plot.signals.length > 1 && curves.length === 1;  // to save room
      const values = element("div", inline ? row : plot.rows, { class: "values" });
      for (const curve of curves) {
        const text = element("span", values, { title: curve.name, style: `color: ${curve.color}` });
        element("i", text, { class: curve.dash.length ? "dashed" : "" });
        curve.text = element("span", text);
      }
    });
    redraw();
  }
  function remove(plot) {
    plots.splice(plots.indexOf(plot), 1);
    plot.box.remove();
  }
  function add(signals) {
    const box = element("div", list, { class: "plot" });
    const plot = { box, rows: element("div", box), canvas: element("canvas", box), signals: [signals].flat() };
    plots.push(plot);
    point(plot.canvas);
    fill(plot);
  }

  // Pointing: drag moves through time, the wheel zooms about the pointer.
  function timeAt(canvas, event) {
    const area = canvas.getBoundingClientRect(), width = area.width - MARGIN.left - MARGIN.right;
    const share = Math.max(0, Math.min(1, (event.clientX - area.left - MARGIN.left) / width));
    return view[0] + share * (view[1] - view[0]);
  }
  function point(canvas) {
    canvas.onpointerdown = canvas.onpointermove = event => {
      if (event.type === "pointerdown") canvas.setPointerCapture(event.pointerId);
      if (!seek) { now = timeAt(canvas, event); return; }
      if (canvas.hasPointerCapture(event.pointerId)) seek(timeAt(canvas, event));
    };
    canvas.onpointerleave = () => { if (!seek) now = null; };
    canvas.onwheel = event => {
      event.preventDefault();
      event.deltaX && !event.deltaY ? pan(event.deltaX / 500) : zoom(event.deltaY < 0 ? 1.25 : 0.8, timeAt(canvas, event));
    };
  }
  function zoom(factor, about = now ?? (view[0] + view[1]) / 2) {
    const width = Math.max((span[1] - span[0]) / 1000, Math.min(span[1] - span[0], (view[1] - view[0]) / factor));
    const share = (about - view[0]) / (view[1] - view[0]);
    show(about - share * width, width);
  }
  function pan(share) { show(view[0] + share * (view[1] - view[0]), view[1] - view[0]); }
  function show(from, width) {
    const first = Math.max(span[0], Math.min(span[1] - width, from));
    view = [first, first + width];
    redraw();
  }

  // Drawing.
  function paint(context, box, plot) {
    drawGraph(context, box, { ...plot.content, from: view[0], to: view[1], now, unit });
  }
  function draw() {
    for (const plot of plots) {
      const width = plot.canvas.clientWidth, ratio = window.devicePixelRatio || 1, context = plot.canvas.getContext("2d");
      if (!width) continue;
      Object.assign(plot.canvas, { width: width * ratio, height: TALL * ratio });
      context.scale(ratio, ratio);
      paint(context, { x: 0, y: 0, width, height: TALL }, plot);
      for (const { text, times, values } of plot.content.curves) {
        const at = now === null ? times.length - 1 : frameAt(times, now);
        if (text) text.textContent = figure(values[at]);
      }
    }
  }
  function move(time) {
    if (time !== null) now = time;
    if (time !== null && (now < view[0] || now > view[1])) show(now - 0.05 * (view[1] - view[0]), view[1] - view[0]);
    const wanted = [now, parent.clientWidth, ...view].join();
    if (wanted !== drawn) draw();
    drawn = wanted;
  }

  // Files: all frames of the shown signals; a picture of the plots with a legend.
  function csv() {
    const columns = [...new Set(plots.flatMap(plot => plot.signals))], quoted = text => `"${String(text).replaceAll('"', '""')}"`;
    const rows = [["source", `time [${unit}]`, ...columns, ...columns.map(name => `${name}, commanded`)].map(quoted).join()];
    for (const source of sources) {
      const arrays = [...columns.map(name => source.signals[name]), ...columns.map(name => source.commanded[name])];
      source.times.forEach((time, i) => rows.push([quoted(source.name), time, ...arrays.map(values => values?.[i] ?? "")].join()));
    }
    return rows.join("\n") + "\n";
  }
  function png(width = 900, height = 260) {
    const canvas = document.createElement("canvas"), context = canvas.getContext("2d"), line = 18;
    const tall = plot => height + line * plot.content.curves.length;
    Object.assign(canvas, { width: 2 * width, height: 2 * plots.reduce((sum, plot) => sum + tall(plot), 10) });
    context.scale(2, 2);
    context.fillStyle = "white";
    context.fillRect(0, 0, canvas.width, canvas.height);
    let y = 10;
    for (const plot of plots) {
      for (const { color, dash, name, signal } of plot.content.curves) {
        Object.assign(context, { strokeStyle: color, fillStyle: "#1f2933", lineWidth: 2, font: FONT, textBaseline: "middle", textAlign: "left" });
        context.setLineDash(dash);
        context.beginPath();
        context.moveTo(MARGIN.left, y + line / 2);
        context.lineTo(MARGIN.left + 26, y + line / 2);
        context.stroke();
        context.fillText(`${signal} (${name})`, MARGIN.left + 32, y + line / 2);
        y += line;
      }
      paint(context, { x: 0, y, width, height }, plot);
      y += height;
    }
    return canvas.toDataURL("image/png");
  }
  button(tools, "+ plot", "Another plot", () => add(known()[0]));
  button(tools, "−", "See more of the time (wheel)", () => zoom(1 / 1.6));
  button(tools, "+", "See less of the time (wheel)", () => zoom(1.6));
  button(tools, "CSV", "Save the signals shown as a table", () => download(`${file}.csv`, URL.createObjectURL(new Blob([csv()], { type: "text/csv" }))));
  button(tools, "PNG", "Save the plots as a picture", () => download(`${file}.png`, png()));
  names.forEach(add);

  // Replaces the data and keeps the chosen signals; a view of the whole span stays whole.
  function replace(newSources, newSpan) {
    const all = view[0] === span[0] && view[1] === span[1];
    [sources, span] = [newSources, newSpan];
    if (all) view = [...span];
    const choosing = parent.contains(document.activeElement) && document.activeElement.tagName === "SELECT";
    plots.forEach(plot => update(plot, choosing));
    redraw();
  }
  // Unchanged rows stay, so that an open list does not close.
  function update(plot, choosing) {
    const before = plot.content, options = plot.rows.querySelector("select")?.options.length, after = contentOf(plot);
    const names = content => content.curves.map(curve => `${curve.name} ${curve.signal}`).join();
    if (!choosing && (names(before) !== names(after) || options !== known().length)) { fill(plot); return; }
    after.curves.forEach((curve, i) => { curve.text = before.curves[i]?.text; });
    plot.content = after;
  }
  return { move, redraw, replace, csv, png };
}

// Draws curves over axes with numbers into a canvas.

const MARGIN = { left: 46, right: 10, top: 6, bottom: 20 };  // of a graph, for the numbers [pixels]
const FONT = "11px system-ui, sans-serif";

// Base64 -> an array of numbers.
function numbers(text, kind) {
  return new kind(Uint8Array.from(atob(text), c => c.charCodeAt(0)).buffer);
}
const unpacked = packed => Object.fromEntries(Object.entries(packed).map(([name, text]) => [name, numbers(text, Float32Array)]));

// Last frame at or before a time.
function frameAt(times, time) {
  let low = 0, high = times.length - 1;
  while (low < high) {
    const middle = (low + high + 1) >> 1;
    if (times[middle] <= time + 1e-6) low = middle; else high = middle - 1;
  }
  return low;
}

// About `count` round numbers between two values, and the distance between them.
function ticks(low, high, count) {
  const rough = (high - low) / count, power = 10 ** Math.floor(Math.log10(rough));
  const step = power * [1, 2, 5, 10].find(times => times * power >= rough * 0.999);
  const values = [];
  for (let k = Math.ceil(low / step - 1e-6); k * step <= high + 1e-6 * step; k++) values.push(k * step);
  return { values, step };
}

// A number at the precision of a step: 0.25, 40, 20k, 1.5M, 2e-7.
function label(value, step) {
  const text = (number, by) => number.toFixed(Math.max(0, -Math.floor(Math.log10(by) + 1e-9)));
  if (value === 0) return "0";
  if (step < 1e-4) return value.toExponential(1);
  if (Math.abs(value) >= 1e6) return text(value / 1e6, step / 1e6) + "M";
  if (Math.abs(value) >= 1e4) return text(value / 1e3, step / 1e3) + "k";
  return text(value, step);
}

// A number as text: 0.0123, 4.56, 1234, 1.2e-5; no text for NaN.
function figure(value) {
  const size = Math.abs(value);
  if (!Number.isFinite(value)) return "";
  return size >= 1e6 || (size && size < 1e-3) ? value.toExponential(2) : size >= 100 ? value.toFixed(0) : value.toPrecision(3);
}

// Smallest and largest value of some arrays, with room, zero among them.
function rangeOf(arrays) {
  let [low, high] = [0, 0];
  for (const values of arrays) {
    for (const value of values) { if (value < low) low = value; if (value > high) high = value; }
  }
  if (high === low) high = low + 1;
  const room = 0.06 * (high - low);
  return [low === 0 ? 0 : low - room, high === 0 ? 0 : high + room];
}

// Part of a canvas, of `width` x `height` from `x`, `y` on: a graph of `curves` ({times, values, color, dash}) for times
// from..to, with lines at `limits` and at the time `now`. Units stand at the end of the axis.
function drawGraph(context, { x, y, width, height }, { curves, from, to, range, limits, now, unit }) {
  const left = x + MARGIN.left, right = x + width - MARGIN.right, top = y + MARGIN.top, bottom = y + height - MARGIN.bottom;
  const [low, high] = range;
  const across = time => left + (right - left) * (time - from) / (to - from);
  const up = value => bottom - (bottom - top) * (value - low) / (high - low);
  const line = (color, dash, width, path) => {
    context.beginPath();
    context.strokeStyle = color;
    context.setLineDash(dash);
    context.lineWidth = width;
    path();
    context.stroke();
  };
  const straight = (x1, y1, x2, y2) => () => { context.moveTo(x1, y1); context.lineTo(x2, y2); };
  context.font = FONT;
  context.fillStyle = "#52606d";
  context.textBaseline = "middle";
  context.textAlign = "right";
  const rows = ticks(low, high, (bottom - top) / 32), columns = ticks(from, to, (right - left) / 60);
  for (const value of rows.values) {
    line(value === 0 ? "#9aa5b1" : "#e4e7eb", [], 1, straight(left, up(value), right, up(value)));
    context.fillText(label(value, rows.step), left - 6, up(value));
  }
  context.textBaseline = "top";
  context.textAlign = "center";
  const free = right - context.measureText(unit).width - 16;  // up to here, numbers do not overprint the unit
  for (const time of columns.values) {
    line("#e4e7eb", [], 1, straight(across(time), top, across(time), bottom));
    if (across(time) < free) context.fillText(label(time, columns.step), across(time), bottom + 6);
  }
  context.textAlign = "right";
  context.fillText(unit, right, bottom + 6);
  context.save();
  context.beginPath();
  context.rect(left, top, right - left, bottom - top);
  context.clip();
  for (const value of limits) line("#c53030", [2, 3], 1, straight(left, up(value), right, up(value)));
  for (const curve of [...curves].reverse()) {
    line(curve.color, curve.dash, 1.5, () => trace(context, curve, from, to, right - left, across, up));
  }
  if (now !== null) line("#52606d", [], 1, straight(across(now), top, across(now), bottom));
  context.restore();
}

// The path of a curve; where many frames share a pixel, from the smallest to the largest of them.
function trace(context, { times, values }, from, to, width, across, up) {
  const first = frameAt(times, from), last = Math.min(frameAt(times, to) + 1, times.length - 1);
  const stride = Math.max(1, Math.floor((last - first) / (2 * width)));
  for (let i = first; i <= last; i += stride) {
    const some = values.slice(i, i + stride).filter(Number.isFinite);
    if (!some.length) continue;
    context.lineTo(across(times[i]), up(Math.min(...some)));
    if (stride > 1) context.lineTo(across(times[i]), up(Math.max(...some)));
  }
}

// The page of a training run: curves of all runs, and the robot under the newest policy. Expects scene.js, stream.js,
// graph.js and plots.js.

let plots = null;

// The robot and its surroundings, again for each new environment.
events.addEventListener("scene", event => {
  viewer.handle_command({ type: "delete", path: "/world" });
  draw(JSON.parse(event.data));
  find("waiting").style.display = "none";
  find("pane").style.visibility = "visible";
});

// Curves: all runs over the steps.
events.addEventListener("curves", event => {
  const message = JSON.parse(event.data);
  const sources = message.sources.map(run => ({
    ...run, times: numbers(run.times, Float32Array), signals: unpacked(run.signals), commanded: {}, limits: {},
  }));
  find("runs").replaceChildren();
  for (const { name, color } of message.sources.length > 1 ? message.sources : []) {
    const text = element("span", find("runs"));
    element("i", text, { style: `background: ${color}` });
    text.append(name);
  }
  if (plots) plots.replace(sources, message.span);
  else if (message.chosen.length) {
    plots = makePlots(find("plots"), sources, message.chosen, { span: message.span, unit: "steps", seek: null, file: document.title });
  }
});

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

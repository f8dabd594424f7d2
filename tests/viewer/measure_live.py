"""What reaches the live page, and how soon: run by hand, `python tests/viewer/measure_live.py`, on a quiet machine.

Updates per second as another program gets them, and as the page in headless Chromium gets them, with and without
drawing (without a GPU the processor draws, and has less time for all else); pictures drawn per second; from a key
event in the page to the state that has its command.
"""

from __future__ import annotations

import http.client
import json
import multiprocessing
import os
import statistics
import tempfile
import time
import urllib.parse
from pathlib import Path

from chromium import Chromium

from ce_gym.viewer.live.command import serving
from ce_gym.viewer.live.setup import named

SECONDS, KEYS = 8.0, 41
RATES = """new Promise(done => {
  const first = received, start = performance.now(), render = viewer.renderer.render.bind(viewer.renderer);
  let pictures = 0;
  if (!DRAW) viewer.renderer.render = () => {};
  else viewer.renderer.render = (...some) => { pictures++; return render(...some); };
  setTimeout(() => {
    viewer.renderer.render = render;
    const seconds = (performance.now() - start) / 1000;
    done([(received - first) / seconds, pictures / seconds, state.rate]);
  }, MILLISECONDS);
})"""
LATENCIES = """(async () => {
  const took = [];
  for (let i = 0; i < COUNT; i++) {
    await new Promise(done => setTimeout(done, 60 + 60 * Math.random()));
    const down = i % 2 === 0, start = performance.now();
    document.dispatchEvent(new KeyboardEvent(down ? "keydown" : "keyup", { key: "w", bubbles: true }));
    await new Promise(done => {
      const usual = events.onmessage;
      events.onmessage = event => {
        usual(event);
        if (down === state.command[0] > 0) { events.onmessage = usual; done(); }
      };
    });
    took.push(performance.now() - start);
  }
  return took;
})()"""


def watch(url: str, result: multiprocessing.Queue) -> None:
    """Count the updates that a program gets that does nothing else."""
    where = urllib.parse.urlsplit(url)
    connection = http.client.HTTPConnection("127.0.0.1", where.port or 0)
    connection.request("GET", f"{where.path}events")
    answer, count, start = connection.getresponse(), -1, 0.0
    while count < 0 or time.monotonic() < start + SECONDS:
        if answer.readline().startswith(b"data: {"):
            start = start or time.monotonic()
            count += 1
    result.put(count / (time.monotonic() - start))


def main() -> None:
    """Measure, and print JSON."""
    found: dict[str, object] = {}
    context = multiprocessing.get_context("spawn")
    with tempfile.TemporaryDirectory() as folder, serving(named("mini_cheetah_velocity"), Path(folder)) as url:
        result = context.Queue()
        other = context.Process(target=watch, args=(url, result))
        other.start()
        found["updates/s, a program"] = result.get()
        other.join()
        with Chromium(url) as browser:
            browser.until("received > 60")
            for drawing in ("false", "true"):
                script = RATES.replace("DRAW", drawing).replace("MILLISECONDS", str(1000 * SECONDS))
                updates, pictures, share = browser.run(script)
                found[f"updates/s, page, {'' if drawing == 'true' else 'not '}drawing"] = updates
            found |= {"pictures/s": pictures, "share of real time": share}
            took = sorted(browser.run(LATENCIES.replace("COUNT", str(KEYS))))
            found |= {"key to state, median [ms]": statistics.median(took), "90 % [ms]": took[int(0.9 * KEYS)]}
    rounded = {name: round(float(value), 1) for name, value in found.items()}  # type: ignore[arg-type]
    print(json.dumps(rounded | {"load": os.getloadavg(), "cores": os.cpu_count()}, indent=2))


if __name__ == "__main__":
    main()

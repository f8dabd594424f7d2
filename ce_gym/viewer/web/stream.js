// Receives poses, ground and state from the server, and posts messages to it. A page may define tell(), which shows the state as text.

let state = null, received = 0;
const events = new EventSource("events");
events.onopen = () => { find("notice").textContent = ""; };
events.onerror = () => { find("notice").textContent = "has stopped"; };
events.addEventListener("ground", event => viewer.handle_command(JSON.parse(event.data)));
events.onmessage = event => {
  const message = JSON.parse(event.data);
  move(message.moves);
  state = message.state;
  received++;
  window.tell?.();
};

// Posts one message at a time. Of messages of one kind that wait, only the newest is sent.
const waiting = new Map();
let busy = false;
function post(message) {
  waiting.delete(message.do);
  waiting.set(message.do, message);
  if (!busy) send();
}
async function send() {
  busy = true;
  while (waiting.size) {
    const [kind, message] = waiting.entries().next().value;
    waiting.delete(kind);
    try {
      const answer = await fetch("messages", { method: "POST", body: JSON.stringify(message) });
      if (!answer.ok) find("notice").textContent = "refused: " + JSON.stringify(message);
    } catch { find("notice").textContent = "has stopped"; }
  }
  busy = false;
}

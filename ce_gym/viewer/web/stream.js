// Receives poses, ground and state from the server. A page may define tell(), which shows the state as text.

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

// The connection to the world: a websocket.

const FRAME = 1;

/** Read a binary frame: number of the lane, shapes, instant, poses (n × 7), contacts (k × 7), vertices. */
export function readFrame(buffer) {
  const head = new Uint32Array(buffer, 0, 6);
  if (head[0] !== FRAME) return null;
  const [, lane, scene, step, shapes, contacts] = head;
  const poses = new Float32Array(buffer, 24, shapes * 7);
  const end = 24 + shapes * 28;
  return { lane, scene, step, poses, contacts: new Float32Array(buffer, end, contacts * 7),
    vertices: new Float32Array(buffer, end + contacts * 28) };
}

export function bytesOf(text) {
  const raw = atob(text), bytes = new Uint8Array(raw.length);
  for (let i = 0; i < raw.length; i++) bytes[i] = raw.charCodeAt(i);
  return bytes;
}

function sessionName() {
  let name = sessionStorage.getItem("session");
  if (!/^[0-9a-f]{32}$/.test(name ?? "")) {
    name = [...crypto.getRandomValues(new Uint8Array(16))].map(b => b.toString(16).padStart(2, "0")).join("");
    sessionStorage.setItem("session", name);
  }
  return name;
}

/** Connect to the server, again and again; `on` has a function for each type of message. */
export function connect(on) {
  const waiting = new Map();
  let socket = null, count = 0, pause = 300, closed = false;

  function open() {
    const address = new URL(`session/${sessionName()}${location.search}`, location.href);
    address.protocol = location.protocol === "https:" ? "wss:" : "ws:";
    socket = new WebSocket(address);
    socket.binaryType = "arraybuffer";
    socket.onopen = () => { pause = 300; on.connection("connected"); };
    socket.onmessage = event => {
      if (typeof event.data !== "string") {
        const frame = readFrame(event.data);
        if (frame) on.frame(frame);
        return;
      }
      const message = JSON.parse(event.data);
      if (message.type === "reply") {
        const answer = waiting.get(message.id);
        waiting.delete(message.id);
        answer?.(message);
      } else on[message.type]?.(message);
    };
    socket.onclose = event => {
      for (const answer of waiting.values()) answer({ error: "the connection was lost", nearest: [] });
      waiting.clear();
      if (closed) return;
      if (event.code === 4001) return on.connection("elsewhere");
      if (event.code === 4002 || event.code === 4003) return on.connection("refused", event.reason);
      on.connection("lost");
      setTimeout(open, pause);
      pause = Math.min(2 * pause, 5000);
    };
  }
  open();
  addEventListener("pagehide", () => { closed = true; socket?.close(); });
  return {
    reopen: open,
    /** Ask for something; the reply has `ok`, or `error` and `nearest`. */
    ask(op, given = {}) {
      if (socket?.readyState !== WebSocket.OPEN)
        return Promise.resolve({ error: "there is no connection to the server", nearest: [] });
      const id = ++count;
      socket.send(JSON.stringify({ op, id, ...given }));
      return new Promise(answer => waiting.set(id, answer));
    },
  };
}

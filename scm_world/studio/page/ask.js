// The connection to the world: a websocket.

const FRAME = 1;
const ARRAYS = { "|u1": Uint8Array, "|i1": Int8Array, "<u4": Uint32Array, "<f4": Float32Array };

/** Read a binary frame: number of the lane, shapes, instant, poses (n × 7), contacts (k × 7), vertices. */
export function readFrame(buffer) {
  if (new Uint32Array(buffer, 0, 1)[0] !== FRAME) return null;
  const head = new Uint32Array(buffer, 0, 6);
  const [, lane, scene, step, shapes, contacts] = head;
  const poses = new Float32Array(buffer, 24, shapes * 7);
  const end = 24 + shapes * 28;
  return { lane, scene, step, poses, contacts: new Float32Array(buffer, end, contacts * 7),
    vertices: new Float32Array(buffer, end + contacts * 28) };
}

/** Read a packed message: JSON, and the arrays that it refers to. */
function unpack(buffer) {
  const [, size] = new Uint32Array(buffer, 0, 2);
  return JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 8, size)),
    (_, value) => value?.array ? new ARRAYS[value.array](buffer, 8 + size + value.at, value.n) : value);
}

function sessionName() {
  let name = sessionStorage.getItem("session");
  if (!/^[0-9a-f]{32}$/.test(name ?? "")) {
    name = [...crypto.getRandomValues(new Uint8Array(16))].map(b => b.toString(16).padStart(2, "0")).join("");
    sessionStorage.setItem("session", name);
  }
  return name;
}

/** Connect to the server, again and again; `on` has a function for each type of message. Coarse meshes have fewer triangles. */
export function connect(on, coarse) {
  const waiting = new Map();
  let socket = null, count = 0, pause = 300, closed = false;

  function open() {
    const address = new URL(`session/${sessionName()}${location.search}`, location.href);
    if (coarse) address.searchParams.set("coarse", "");
    address.protocol = location.protocol === "https:" ? "wss:" : "ws:";
    socket = new WebSocket(address);
    socket.binaryType = "arraybuffer";
    socket.onopen = () => { pause = 300; on.connection("connected"); };
    socket.onmessage = event => {
      const frame = typeof event.data !== "string" && readFrame(event.data);
      if (frame) return on.frame(frame);
      const message = typeof event.data === "string" ? JSON.parse(event.data) : unpack(event.data);
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

// The connection to the world: a websocket, or a recording in the page itself.

const FRAME = 1;

/** Read a binary frame: number of the lane, shapes, instant, poses (n × 7), contacts (k × 7). */
export function readFrame(buffer) {
  const head = new Uint32Array(buffer, 0, 6);
  if (head[0] !== FRAME) return null;
  const [, lane, scene, step, shapes, contacts] = head;
  const poses = new Float32Array(buffer, 24, shapes * 7);
  return { lane, scene, step, poses, contacts: new Float32Array(buffer, 24 + shapes * 28, contacts * 7) };
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
    live: true,
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

/** Play a recording: the same messages as those of a server, without one. */
export function replay(recording, on) {
  const frames = recording.frames.map(text => readFrame(bytesOf(text).buffer));
  let step = recording.steps, timer = 0, speed = 1;
  const show = () => {
    for (const frame of frames) if (frame.step === step) on.frame(frame);
    const values = recording.rows.map(lane =>
      Object.fromEntries(Object.entries(lane.values).map(([name, row]) => [name, row[step]])));
    on.news({ step, steps: recording.steps, time: step * recording.hello.dt, playing: timer !== 0,
      past: step < recording.steps, held: recording.held, twin: recording.twin, values,
      rows: recording.rows, lit: recording.lit[step] ?? [], python: recording.python });
  };
  const stop = () => { clearInterval(timer); timer = 0; };
  const play = () => {
    stop();
    if (step >= recording.steps) step = 0;
    timer = setInterval(() => {
      if (++step >= recording.steps) stop();
      show();
    }, 1000 * recording.hello.dt / speed);
  };
  const ops = {
    play(given) { speed = given.speed ?? 1; play(); },
    pause: stop,
    step() { stop(); step = Math.min(step + 1, recording.steps); },
    look(given) { stop(); step = given.step ?? recording.steps; },
    watch() {}, plot() {},
    inspect(given) {
      const row = recording.rows[0].values[given.name];
      return { name: given.name, value: row ? row[step] : null, bounds: null, a: null, b: null };
    },
  };
  queueMicrotask(() => {
    on.connection("recorded");
    on.hello(recording.hello);
    recording.scenes.forEach(on.scene);
    show();
  });
  return {
    live: false,
    ask(op, given = {}) {
      if (!ops[op]) return Promise.resolve({ error: "this page is a recording", nearest: [] });
      const ok = ops[op](given);
      queueMicrotask(show);
      return Promise.resolve({ ok });
    },
  };
}

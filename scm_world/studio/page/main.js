// The page: what the parts tell one another.

import { connect } from "studio/ask";
import { Graph } from "studio/graph";
import { Panel, make } from "studio/panel";
import { Plots, show } from "studio/plots";
import { View } from "studio/view";

const $ = id => document.getElementById(id);
const PLOTS = ["reward", "fractional_success"];

let hello = null, news = null, plotted = [], chosen = null, job = null, elsewhere = false;
let world = null; // the connection

const say = text => { $("said").textContent = text; };
const ask = (op, given) => world.ask(op, given);
/** Ask for something, and say what went wrong. */
async function tell(op, given) {
  const reply = await ask(op, given);
  say(reply.error ?? "");
  return reply;
}

const view = new View($("canvas"), name => {
  if (!hello) return;
  const groups = [...graph.groups.keys()];
  const group = groups.find(g => g === name) ?? groups.find(g => g && name.startsWith(g));
  const own = hello.variables.find(v => v.name.startsWith(`${name}.`)) ??
    hello.variables.find(v => v.group === group && v.settable);
  if (own) choose(own.name);
});

const graph = new Graph($("graph"), choose);
const plots = new Plots($("plots"), step => tell("look", { step: Math.min(step, news?.steps ?? 0) }), togglePlot);
const panel = new Panel($("variable"), $("message"), {
  graph, choose, ask,
  plot: togglePlot, plotted: name => plotted.includes(name),
  steps: () => news?.steps ?? 0, past: () => Boolean(news?.past),
  done: (name, act, audit, twin) => {
    document.body.dataset.did = Number(document.body.dataset.did ?? 0) + 1;
    if (twin) say(`A twin runs from instant ${news?.step}.`);
    else addAudit(audit);
  },
});

async function choose(name) {
  if (!hello || (name && !graph.byName.has(name))) return;
  chosen = name;
  graph.select(name);
  $("search").value = name ?? "";
  if (!name) { panel.clear(); return; }
  tab("variable", true);
  await panel.show(graph.byName.get(name));
}

async function togglePlot(name) {
  plotted = plotted.includes(name) ? plotted.filter(n => n !== name) : [...plotted, name];
  await choosePlots();
}

async function choosePlots() {
  plotted = plotted.filter(name => graph.byName.has(name)).slice(-12);
  plots.choose(plotted.map(name => graph.byName.get(name)));
  const reply = await ask("plot", { names: plotted });
  if (reply.error) say(reply.error);
  plots.draw();
}

function addAudit(audit) {
  const list = $("audit"), words = value => [value].flat(9).map(show).join(", ");
  const item = make("li", {}, make("time", { textContent: `instant ${news?.step ?? 0}` }));
  for (const one of audit.targets) {
    item.append(make("p", {}, make("b", { textContent: one.name }), ` requested ${one.requested}`,
      one.applied === null ? " at every step" : `, applied ${words(one.applied)}`,
      one.read_back === null ? "" : `, engine reports ${words(one.read_back)}`));
  }
  for (const [name, before, after] of audit.followed)
    item.append(make("p", { className: "follows" }, `follows: ${name} ${words(before)} → ${words(after)}`));
  for (const name of audit.came) item.append(make("p", { textContent: `new: ${name}` }));
  for (const name of audit.went) item.append(make("p", { textContent: `gone: ${name}` }));
  if (!audit.targets.length) item.append(make("p", { textContent: "it takes place later" }));
  list.prepend(item);
  while (list.children.length > 40) list.lastChild.remove();
}

// --- messages ------------------------------------------------------------------------------------

const on = {
  connection(state, why = "") {
    const texts = { connected: "connected", lost: "connection lost; trying again…", refused: why || "not allowed",
      elsewhere: "open in another tab" };
    $("connection").textContent = texts[state];
    document.body.dataset.connection = state;
    if (state === "lost") { hello = null; view.forget(); }
    if (state === "elsewhere" && !elsewhere) {
      elsewhere = true;
      const button = make("button", { type: "button", textContent: "Use it here" });
      button.onclick = () => { elsewhere = false; button.remove(); world.reopen(); };
      $("connection").after(button);
    }
  },
  building(message) {
    $("connection").textContent = `building ${message.system}…`;
  },
  fatal(message) {
    $("connection").textContent = message.error;
    document.body.dataset.connection = "refused";
    say(message.error);
    hello = null;
    view.forget();
  },
  trouble(message) { say(message.error); },
  hello(message) {
    const first = !hello;
    hello = message;
    graph.load(message);
    document.title = `${message.title} · scm_world studio`;
    $("title").textContent = message.title;
    $("about").textContent = `${message.backend} · ${message.variables.length} variables · ${graph.edges.cause.length} edges · control step ${show(message.dt)} s`;
    $("connection").textContent = "connected";
    if (first) view.forget();
    $("names").replaceChildren(...message.variables.map(v => make("option", { value: v.name })));
    $("policy").replaceChildren(make("option", { value: "", textContent: "none" }),
      ...message.policies.map(name => make("option", { value: name, textContent: name })),
      ...(message.actions.length ? [make("option", { value: "sliders", textContent: "sliders" })] : []));
    sliders();
    $("no-shapes").hidden = message.has_shapes;
    view.period = message.dt;
    if (first) {
      if (!plotted.length) {
        const usual = PLOTS.filter(name => graph.byName.has(name));
        plotted = usual.length ? usual : message.variables.filter(v => v.role === "readout").concat(
          message.variables.filter(v => (v.role === "state" || v.kind === "derived") && v.name !== "control_index")).slice(0, 2).map(v => v.name);
      }
      choosePlots();
      if (chosen && graph.byName.has(chosen)) choose(chosen); else panel.clear();
    }
  },
  scene(message) { view.addScene(message); },
  frame(frame) {
    view.smooth = Boolean(news?.playing);
    view.addFrame(frame);
  },
  news(message) {
    news = message;
    $("play").textContent = message.playing ? "Pause" : "Play";
    $("play").setAttribute("aria-pressed", message.playing);
    if (message.policy !== undefined && document.activeElement !== $("policy")) {
      $("policy").value = message.policy;
      $("sliders").hidden = message.policy !== "sliders";
    }
    $("scrub").max = message.steps;
    if (document.activeElement !== $("scrub") || !scrubbing) $("scrub").value = message.step;
    $("instant").textContent = `${message.step} of ${message.steps}`;
    $("clock").textContent = `${message.time.toFixed(2)} s${message.past ? " · past" : ""}`;
    document.body.classList.toggle("past", message.past);
    $("now").disabled = !message.past;
    const hadTwin = view.twin;
    view.twin = message.twin !== null;
    document.body.classList.toggle("twins", view.twin);
    $("join").disabled = $("save-twin").disabled = !view.twin;
    $("twin-about").textContent = view.twin
      ? `The twin differs from instant ${message.twin} on. It takes the same actions, with the same noise.`
      : "No twin. “Split here” runs a counterfactual from the instant shown, with the same noise and actions.";
    plots.add(message.rows);
    plots.step = message.step;
    plots.twin = message.twin;
    plots.draw();
    if (chosen && message.values[0]?.[chosen] !== undefined) panel.value(message.values[0][chosen]);
    graph.light(message.lit);
    graph.hold(new Set(message.held[0].map(([name]) => name)), new Set(message.cut));
    inForce(message.held);
    newLines = message.python ?? newLines;
    python();
    if (view.twin !== hadTwin) view.redraw();
  },
  job(message) {
    job ??= { found: [], missed: [], extra: [] };
    document.body.classList.add("jobs");
    if (message.edges) { job.found.push(...message.edges); graph.found(job); }
    if (message.planned) {
      $("progress").hidden = false;
      $("progress").max = message.planned;
      $("progress").value = message.done;
      $("job").textContent = `${message.done} of ${message.planned} probe states, ${job.found.length} edges found`;
    }
    if (message.facts) {
      Object.assign(job, { missed: message.missed, extra: message.extra });
      graph.found(job);
      $("facts").replaceChildren(...Object.entries(message.facts).flatMap(([name, value]) =>
        [make("dt", { textContent: name }), make("dd", { textContent: typeof value === "number" ? show(value) : value })]));
      $("job").textContent = `${job.found.length} edges found, ${message.missed.length} not found, ${message.extra.length} not declared`;
    }
    if (message.error) { $("job").textContent = message.error; say(message.error); }
    if (message.ended) {
      $("progress").hidden = true;
      $("discover").disabled = $("verify").disabled = false;
      $("cancel").disabled = true;
      document.body.dataset.job = "ended";
    }
  },
};

let heldText = "";
function inForce(held) {
  const text = JSON.stringify(held);
  if (text === heldText) return;
  heldText = text;
  const items = held.flatMap((lane, number) => lane.map(([name, act]) => {
    const item = make("li", {}, make("b", { textContent: name }), ` ${act}${number ? " (twin)" : ""} `);
    const button = make("button", { type: "button", textContent: "release" });
    button.setAttribute("aria-label", `Release ${name}${number ? " in the twin" : ""}`);
    button.onclick = async () => {
      const reply = await tell("release", { name, lane: number });
      if (reply.ok) addAudit(reply.ok);
    };
    item.append(button);
    return item;
  }));
  $("held").replaceChildren(...(items.length ? items : [make("li", { textContent: "nothing" })]));
}

let newLines = null, written = 0;
function python() {
  if (!newLines || (news.playing && performance.now() - written < 500)) return; // the lines of a loop count its steps
  const lines = newLines;
  written = performance.now();
  newLines = null;
  const box = $("python"), end = box.scrollTop + box.clientHeight >= box.scrollHeight - 30;
  box.textContent = lines.join("\n");
  if (end) box.scrollTop = box.scrollHeight;
}

// --- the transport -------------------------------------------------------------------------------

let scrubbing = false, looking = false, wanted = null;
const speed = () => Number($("speed").value);

$("play").onclick = () => { view.period = hello.dt / speed(); return tell(news?.playing ? "pause" : "play", news?.playing ? {} : { speed: speed() }); };
$("step").onclick = () => tell("step");
$("reset").onclick = () => tell("reset", { seed: Math.max(0, Math.floor($("seed").valueAsNumber || 0)) });
$("speed").onchange = () => { if (hello) view.period = hello.dt / speed(); if (news?.playing) tell("play", { speed: speed() }); };
$("now").onclick = () => tell("look", {});
$("scrub").oninput = async () => {
  wanted = Number($("scrub").value);
  scrubbing = true;
  if (looking) return;
  looking = true;
  while (wanted !== null) { const step = wanted; wanted = null; await tell("look", { step }); }
  looking = false;
};
$("scrub").onchange = () => { scrubbing = false; };
$("policy").onchange = () => {
  const name = $("policy").value;
  $("sliders").hidden = name !== "sliders";
  $("sliders").open = name === "sliders";
  if (name === "sliders") slide(); else tell("policy", { name: name || null });
};

function sliders() {
  $("actions").replaceChildren(...hello.actions.map(({ name, low, high, unit }) => {
    const input = make("input", { type: "range", min: low, max: high, step: (high - low) / 200, value: (low + high) / 2 });
    input.oninput = slide;
    return make("label", {}, make("span", { textContent: `${name}${unit && unit !== "1" ? ` [${unit}]` : ""}` }), input);
  }));
}

let sliding = false;
async function slide() {
  if (sliding) { sliding = "again"; return; }
  do {
    sliding = true;
    await tell("policy", { action: [...$("actions").querySelectorAll("input")].map(i => i.valueAsNumber) });
  } while (sliding === "again");
  sliding = false;
}

$("split").onclick = () => tell("split");
$("join").onclick = () => tell("join");
$("layout").onchange = () => { view.beside = $("layout").value === "beside"; view.redraw(); };
$("contacts").onchange = () => { view.showContacts = $("contacts").checked; view.redraw(); };
$("goals").onchange = () => { view.showGoals = $("goals").checked; view.redraw(); };
$("home").onclick = () => view.home();
$("canvas").onkeydown = event => {
  const turns = { ArrowLeft: [-0.12, 0], ArrowRight: [0.12, 0], ArrowUp: [0, 0.1], ArrowDown: [0, -0.1], "+": [0, 0, 0.87], "-": [0, 0, 1.15] };
  if (turns[event.key]) { view.turn(...turns[event.key]); event.preventDefault(); }
};

$("search").onchange = () => {
  const text = $("search").value.trim(), names = hello?.variables.map(v => v.name) ?? [];
  choose(names.find(n => n === text) ?? (text ? names.find(n => n.includes(text)) : null) ?? null);
};
$("expand").onclick = () => graph.all(true);
$("collapse").onclick = () => graph.all(false);
$("fit").onclick = () => graph.fit();

// --- experiments ---------------------------------------------------------------------------------

for (const kind of ["discover", "verify"]) {
  $(kind).onclick = async () => {
    const reply = await tell("experiment", { kind, probes: $("probes").valueAsNumber || 16 });
    if (reply.error) return;
    job = { found: [], missed: [], extra: [] };
    graph.found(job);
    $("facts").replaceChildren();
    $("discover").disabled = $("verify").disabled = true;
    $("cancel").disabled = false;
    $("job").textContent = "building a world for the experiments…";
    document.body.dataset.job = kind;
  };
}
$("cancel").onclick = () => tell("cancel");

// --- files ---------------------------------------------------------------------------------------

function download(name, blob) {
  const link = make("a", { href: URL.createObjectURL(blob), download: name });
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 10_000);
  say(`${name} was saved.`);
}

async function save(what, lane = 0) {
  const reply = await tell("save", { what, lane });
  if (reply.error) return;
  const { name, text, base64 } = reply.ok;
  const content = text ?? Uint8Array.from(atob(base64), c => c.charCodeAt(0));
  const type = name.endsWith(".json") ? "application/json" : "application/octet-stream";
  download(name, new Blob([content], { type }));
}
$("save-episode").onclick = () => save("episode");
$("save-twin").onclick = () => save("episode", 1);
$("save-plan").onclick = () => save("plan");
const stem = () => (hello?.title ?? "world").replace(/[^\w.-]+/g, "_");
$("png").onclick = () => view.picture(blob => download(`${stem()}.png`, blob));
let recorder = null;
$("webm").onclick = () => {
  if (recorder) { recorder.stop(); return; }
  if (!window.MediaRecorder) return say("This browser cannot record video.");
  const parts = [];
  recorder = new MediaRecorder($("canvas").captureStream(30), { mimeType: "video/webm" });
  recorder.ondataavailable = event => parts.push(event.data);
  recorder.onstop = () => {
    recorder = null;
    $("webm").textContent = "Record (WebM)";
    $("webm").setAttribute("aria-pressed", "false");
    download(`${stem()}.webm`, new Blob(parts, { type: "video/webm" }));
  };
  recorder.start(250);
  $("webm").textContent = "Stop recording";
  $("webm").setAttribute("aria-pressed", "true");
};
$("copy").onclick = async () => {
  try {
    await navigator.clipboard.writeText($("python").textContent);
    say("The Python was copied.");
  } catch {
    getSelection().selectAllChildren($("python"));
    say("The Python is selected; copy it with the keyboard.");
  }
};

// --- tabs of a narrow page -----------------------------------------------------------------------

function tab(name, narrow = false) {
  if (narrow && document.body.dataset.tab === "graph") return; // the graph stays in view
  document.body.dataset.tab = name;
  for (const button of $("tabs").children) button.setAttribute("aria-pressed", button.dataset.tab === name);
}
for (const button of $("tabs").children) button.onclick = () => tab(button.dataset.tab);

world = connect(on, view.software);
window.studio = { view, graph, plots, panel, get news() { return news; }, ask };

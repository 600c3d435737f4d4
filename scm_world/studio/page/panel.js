// What is known of a variable, and interventions on it.

import { show } from "studio/plots";

const KINDS = { hard: "set to", shift: "add", scale: "multiply by", draw: "draw from" };
const MOST = 12; // components that have a field of their own

function make(tag, fields = {}, ...children) {
  const made = document.createElement(tag);
  for (const [key, value] of Object.entries(fields)) {
    if (key.includes("-") || key === "for" || key === "role" || key === "list") made.setAttribute(key, value);
    else made[key] = value;
  }
  made.append(...children);
  return made;
}

export class Panel {
  /** `actions` has ask, choose, plot, plotted, graph, steps. */
  constructor(element, message, actions) {
    this.element = element;
    this.message = message;
    this.actions = actions;
    this.name = null;
    this.busy = false;
    this.pending = null;
  }

  clear() {
    this.name = null;
    this.element.replaceChildren(make("p", { textContent: "Choose a variable in the graph, or a body in the world." }));
  }

  /** Show a variable, and read its present value, bounds and spaces. */
  async show(variable) {
    this.name = variable.name;
    this.variable = variable;
    this.said("");
    const reply = await this.actions.ask("inspect", { name: variable.name });
    if (this.name !== variable.name) return;
    if (reply.error) return this.said(reply.error);
    this.about = reply.ok;
    this.#draw();
  }

  #draw() {
    const v = this.variable, { graph } = this.actions;
    const unit = v.unit && v.unit !== "1" ? ` ${v.unit}` : "";
    const head = make("div", { className: "head" },
      make("h3", { textContent: v.name, id: "variable-name", tabIndex: -1 }),
      make("p", { textContent: v.doc || "No description." }),
      make("p", { className: "facts", textContent: [v.role, v.kind === "exogenous" ? "root" : v.kind,
        v.shape.length ? `${v.shape.join("×")} numbers` : "one number", unit.trim()].filter(Boolean).join(" · ") }),
      make("p", {}, "now ", this.present = make("output", { className: "now" }), unit));
    const plot = make("button", { type: "button" });
    const label = () => { plot.textContent = this.actions.plotted(v.name) ? "Remove plot" : "Plot"; };
    plot.onclick = async () => { await this.actions.plot(v.name); label(); };
    label();
    const row = make("div", { className: "bar" }, plot);
    const parts = [head, row];
    if (v.settable) parts.push(this.#form(row));
    else if (!v.settable) parts.push(make("p", { textContent: "It cannot be set; intervene on a cause of it." }));
    for (const [title, causes] of [["Causes", true], ["Effects", false]]) {
      const found = graph.neighbours(v.name, causes);
      const list = make("ul", { className: "names" });
      for (const { name, lag, when } of found) {
        const button = make("button", { type: "button", textContent: name });
        button.onclick = () => this.actions.choose(name);
        list.append(make("li", {}, button, make("span", { textContent: [lag ? "next step" : "same step", when].filter(Boolean).join(", ") })));
      }
      parts.push(make("details", { open: found.length < 9 }, make("summary", { textContent: `${title} (${found.length})` }), list));
    }
    this.element.replaceChildren(...parts);
    this.value(this.about.value);
  }

  /** Show a present value. */
  value(value) {
    if (!this.present || value === undefined) return;
    const labels = this.variable.categories;
    const text = labels ? labels[1][labels[0].indexOf(value)] ?? value : [value].flat(9).map(show).join(", ");
    if (this.present.textContent !== String(text)) this.present.textContent = text;
  }

  #scale(index) {
    const at = part => part && !part.members ? [part.low[index % part.low.length], part.high[index % part.high.length]] : null;
    const bounds = at(this.about.bounds?.[0]);
    const spaces = ["a", "b"].map(key => (this.about[key] ?? []).map(at).filter(Boolean));
    const now = [this.about.value].flat(9)[index] ?? 0;
    const ends = spaces.flat(2).filter(Number.isFinite);
    let [low, high] = bounds ?? [null, null];
    const wide = ends.length ? [Math.min(...ends, now), Math.max(...ends, now)] : [now - Math.max(1, Math.abs(now)), now + Math.max(1, Math.abs(now))];
    const span = (wide[1] - wide[0]) || 1;
    const far = ends.length ? 0.4 * span : 0;
    if (!Number.isFinite(low) || (ends.length && low < wide[0] - 4 * span)) low = wide[0] - far;
    if (!Number.isFinite(high) || (ends.length && high > wide[1] + 4 * span)) high = wide[1] + far;
    return { low, high, spaces, now };
  }

  #form(row) {
    const v = this.variable, form = make("form", { className: "do" });
    const kind = make("select", { id: "kind" });
    for (const [key, text] of Object.entries(KINDS)) {
      if (v.categories && key !== "hard" && key !== "draw") continue;
      kind.append(make("option", { value: key, textContent: text }));
    }
    const fields = make("div", { className: "fields" }), size = [this.about.value].flat(9).length;
    const source = make("select", { id: "source" }, ...["A", "B", "A|B"].map(s => make("option", { value: s, textContent: s })));
    const from = make("label", { hidden: true }, "space ", source);
    const inputs = [];
    const colour = v.name.endsWith("color") && (size === 3 || size === 4);
    if (v.categories) {
      const choice = make("select", { id: "category" });
      v.categories[0].forEach((member, i) => choice.append(make("option", { value: member, textContent: v.categories[1][i] })));
      choice.value = this.about.value;
      inputs.push(choice);
      fields.append(make("label", {}, "value ", choice));
    } else if (size <= MOST) {
      if (colour) {
        const hex = x => Math.round(255 * Math.min(1, Math.max(0, x))).toString(16).padStart(2, "0");
        const pick = make("input", { type: "color", id: "colour", value: `#${this.about.value.slice(0, 3).map(hex).join("")}` });
        pick.oninput = () => {
          [1, 3, 5].forEach((k, i) => { inputs[i].value = (parseInt(pick.value.slice(k, k + 2), 16) / 255).toFixed(4); inputs[i].slide(); });
          this.#drag();
        };
        fields.append(make("label", {}, "colour ", pick));
      }
      for (let i = 0; i < size; i++) fields.append(this.#field(i, size, inputs));
    } else {
      const text = make("input", { id: "numbers", value: [this.about.value].flat(9).map(show).join(", ") });
      inputs.push(text);
      fields.append(make("label", {}, `${size} numbers `, text));
    }
    const window_ = make("input", { type: "checkbox", id: "window" });
    const start = make("input", { type: "number", min: 0, step: 1, id: "start" }), stop = make("input", { type: "number", min: 0, step: 1, id: "stop" });
    const times = make("span", { hidden: true }, make("label", {}, " from step ", start), make("label", {}, " to ", stop));
    window_.onchange = () => {
      times.hidden = !window_.checked;
      if (window_.checked && !start.value) { start.value = this.actions.steps(); stop.value = this.actions.steps() + 50; }
    };
    kind.onchange = () => {
      from.hidden = kind.value !== "draw";
      fields.hidden = kind.value === "draw";
      const still = { shift: 0, scale: 1 }[kind.value];
      inputs.forEach((input, i) => {
        if (v.categories || size > MOST) return;
        input.relative(still !== undefined);
        input.value = still ?? show([this.about.value].flat(9)[i]);
        input.slide();
      });
    };
    const apply = make("button", { type: "submit", className: "main", textContent: "do" });
    const twin = make("button", { type: "button", id: "do-twin", textContent: "do in a twin" });
    const dragged = make("input", { type: "checkbox", id: "dragged", checked: true });
    const read = () => {
      const act = { kind: kind.value };
      if (kind.value === "draw") act.source = source.value;
      else if (v.categories) act.value = Number(inputs[0].value);
      else {
        const numbers = size > MOST ? inputs[0].value.split(/[\s,]+/).filter(Boolean).map(Number) : inputs.map(input => input.valueAsNumber);
        act.value = v.shape.length ? numbers : numbers[0];
        if (numbers.some(x => !Number.isFinite(x))) { this.said("Every field needs a number."); return null; }
      }
      if (window_.checked) Object.assign(act, { window: true, start: start.valueAsNumber, stop: Number.isFinite(stop.valueAsNumber) ? stop.valueAsNumber : null });
      return act;
    };
    this.#drag = () => { if (dragged.checked && kind.value === "hard" && !window_.checked && !this.actions.past()) { const act = read(); if (act) this.#later(act); } };
    form.onsubmit = event => { event.preventDefault(); const act = read(); if (act) this.apply(act); };
    twin.onclick = () => { const act = read(); if (act) this.apply(act, true); };
    form.append(make("div", { className: "bar" }, make("label", {}, "kind ", kind), from), fields,
      make("div", { className: "bar" }, make("label", {}, window_, " window"), times),
      make("div", { className: "bar" }, apply, twin, make("label", {}, dragged, " while dragging")));
    return form;
  }

  #drag = () => {};

  #field(i, size, inputs) {
    const { low, high, spaces, now } = this.#scale(i), v = this.variable;
    const whole = v.dtype === "integer", step = whole ? 1 : (high - low) / 500 || 0.001;
    const number = make("input", { type: "number", step: "any", value: show(now) });
    const slider = make("input", { type: "range", min: low, max: high, step, value: now });
    const called = size > 1 ? `${v.name}[${i}]` : v.name;
    number.setAttribute("aria-label", `Value of ${called}`);
    slider.setAttribute("aria-label", `Slider of ${called}`);
    number.slide = () => { slider.value = number.value; };
    number.relative = relative => { slider.disabled = relative; };
    number.oninput = number.slide;
    slider.oninput = () => { number.value = Number(Number(slider.value).toPrecision(6)); this.#drag(); };
    const marks = make("div", { className: "marks", role: "img" }), place = x => 100 * (x - low) / (high - low || 1);
    const words = [];
    spaces.forEach((parts, k) => parts.forEach(([a, b]) => {
      words.push(`${"AB"[k]} from ${show(a)} to ${show(b)}`);
      const left = Math.max(0, place(a)), right = Math.min(100, place(b));
      if (right < left) return;
      const mark = make("i", { className: "ab"[k], textContent: right - left > 8 ? "AB"[k] : "" });
      mark.style.left = `${left}%`;
      mark.style.width = `${Math.max(0.6, right - left)}%`;
      marks.append(mark);
    }));
    marks.setAttribute("aria-label", `${show(low)} to ${show(high)}; ${words.join("; ") || "no spaces A and B"}`);
    inputs.push(number);
    const range = make("div", { className: "range" }, slider, marks);
    return make("div", { className: "field" }, make("span", { textContent: size > 1 ? `[${i}]` : "" }), range, number);
  }

  /** While a slider is dragged: one request at a time, the last value counts. */
  async #later(act) {
    this.pending = act;
    if (this.busy) return;
    this.busy = true;
    while (this.pending) {
      const next = this.pending;
      this.pending = null;
      await this.apply(next);
    }
    this.busy = false;
  }

  /** Intervene; a refusal names the nearest possible value, with a button that takes it. */
  async apply(act, twin = false) {
    const name = this.name, past = this.actions.past();
    const reply = twin || past
      ? await this.actions.ask("split", { do: { [name]: act } })
      : await this.actions.ask("do", { name, act });
    if (!reply.error) {
      this.said("");
      this.actions.done(name, act, reply.ok, twin || past);
      return;
    }
    this.said(reply.error);
    for (const { name: other, value } of reply.nearest ?? []) {
      const shown = [value].flat(9).map(show).join(", ");
      const button = make("button", { type: "button", className: "nearest", textContent: `Take the nearest: ${shown}` });
      button.onclick = async () => {
        if (other !== this.name) await this.actions.choose(other);
        await this.apply({ ...act, kind: "hard", value }, twin);
        const reply = await this.actions.ask("inspect", { name: this.name });
        if (reply.ok && !this.message.textContent) { this.about = reply.ok; this.#draw(); }
      };
      this.message.append(button);
    }
  }

  said(text) {
    this.message.replaceChildren(...(text ? [make("p", { textContent: text })] : []));
  }
}

export { make };

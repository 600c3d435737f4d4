// Outcomes over time: the factual episode, its twin, and their difference.

const HEIGHT = 92;

export class Plots {
  /** Draw into an element; `seek` is called with an instant, `remove` with a name. */
  constructor(element, seek, remove) {
    this.element = element;
    this.seek = seek;
    this.remove = remove;
    this.series = [new Map(), new Map()];
    this.cards = new Map();
    this.step = 0;
    this.twin = null;
    new ResizeObserver(() => this.draw()).observe(element);
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.draw());
  }

  /** Choose what is drawn: variables with name and unit. */
  choose(variables) {
    this.series = [new Map(), new Map()];
    for (const [name, card] of this.cards) if (!variables.some(v => v.name === name)) { card.remove(); this.cards.delete(name); }
    for (const v of variables) if (!this.cards.has(v.name)) this.#card(v);
  }

  #card(v) {
    const card = document.createElement("figure");
    card.innerHTML = `<figcaption><span class="name"></span><span class="value"></span>
      <button type="button">×</button></figcaption><canvas role="img"></canvas>`;
    card.querySelector(".name").textContent = v.name + (v.unit && v.unit !== "1" ? ` [${v.unit}]` : "");
    const button = card.querySelector("button");
    button.setAttribute("aria-label", `Remove the plot of ${v.name}`);
    button.onclick = () => this.remove(v.name);
    const canvas = card.querySelector("canvas");
    canvas.setAttribute("aria-label", `${v.name} over time`);
    canvas.onclick = event => {
      const box = canvas.getBoundingClientRect();
      this.seek(Math.round((event.clientX - box.left) / box.width * Math.max(1, this.count - 1)));
    };
    this.element.append(card);
    this.cards.set(v.name, card);
  }

  /** Take rows that have come: for each lane the first instant, and values by name. */
  add(rows) {
    rows.forEach((lane, number) => {
      for (const [name, values] of Object.entries(lane.values)) {
        if (!this.series[number].has(name)) this.series[number].set(name, []);
        const kept = this.series[number].get(name);
        if (lane.first > kept.length) continue;
        kept.length = lane.first;
        kept.push(...values);
      }
    });
    if (rows.length < 2) this.series[1].clear();
  }

  draw() {
    for (const [name, card] of this.cards) this.#plot(name, card);
  }

  #plot(name, card) {
    const canvas = card.querySelector("canvas"), ratio = devicePixelRatio;
    const width = canvas.clientWidth, height = HEIGHT;
    if (!width) return;
    canvas.width = width * ratio;
    canvas.height = height * ratio;
    const c = canvas.getContext("2d");
    c.scale(ratio, ratio);
    const style = getComputedStyle(document.documentElement), colour = key => style.getPropertyValue(key).trim();
    const one = this.series[0].get(name) ?? [], two = this.series[1].get(name) ?? [];
    this.count = Math.max(one.length, 2);
    const parts = row => row === null || row === undefined ? [] : [row].flat(9);
    const size = Math.min(parts(one[0]).length, 4);
    const finite = [...one, ...two].flatMap(row => parts(row).slice(0, size)).filter(Number.isFinite);
    let low = Infinity, high = -Infinity;
    for (const x of finite) { if (x < low) low = x; if (x > high) high = x; }
    if (!(high > low)) { low = (Number.isFinite(low) ? low : 0) - 0.5; high = low + 1; }
    const gap = two.length ? 24 : 0, top = 6, bottom = height - 6 - gap;
    const x = step => step / (this.count - 1) * (width - 2) + 1;
    const y = value => bottom - (value - low) / (high - low) * (bottom - top);
    const curve = (rows, k, stroke, dash, place = y, first = 0) => {
      c.beginPath();
      c.strokeStyle = stroke;
      c.setLineDash(dash);
      let pen = false;
      rows.forEach((row, i) => {
        const value = parts(row)[k];
        if (i < first || !Number.isFinite(value)) { pen = false; return; }
        c[pen ? "lineTo" : "moveTo"](x(i), place(value));
        pen = true;
      });
      c.stroke();
    };
    c.lineWidth = 1.6;
    const widths = [1.8, 1.3, 1, 0.8];
    for (let k = 0; k < size; k++) {
      c.lineWidth = widths[k];
      curve(one, k, colour("--factual"), []);
      if (two.length) curve(two, k, colour("--twin"), [5, 3], y, this.twin ?? 0);
    }
    if (two.length) {
      const apart = one.map((row, i) => parts(row).map((v, k) => (parts(two[i])[k] ?? NaN) - v));
      let most = 0;
      for (const row of apart) for (const v of row.slice(0, size)) if (Number.isFinite(v)) most = Math.max(most, Math.abs(v));
      const middle = height - 6 - gap / 2 + 4;
      c.lineWidth = 1;
      c.strokeStyle = colour("--line");
      c.setLineDash([]);
      c.beginPath(); c.moveTo(0, middle); c.lineTo(width, middle); c.stroke();
      for (let k = 0; k < size; k++) curve(apart, k, colour("--apart"), [], v => middle - (most ? v / most : 0) * (gap / 2 - 2), this.twin ?? 0);
    }
    c.setLineDash([]);
    c.strokeStyle = colour("--ink");
    c.globalAlpha = 0.6;
    c.beginPath(); c.moveTo(x(this.step), 0); c.lineTo(x(this.step), height); c.stroke();
    c.globalAlpha = 1;
    const text = row => parts(row).slice(0, size).map(show).join(", ");
    let said = text(one[this.step]);
    if (two.length) said += ` | twin ${text(two[this.step])}`;
    card.querySelector(".value").textContent = said;
    canvas.setAttribute("aria-label", `${name} over ${one.length} instants, from ${show(low)} to ${show(high)}; at instant ${this.step}: ${said}`);
  }
}

/** Write a number with four digits. */
export function show(value) {
  if (value === null || value === undefined || !Number.isFinite(value)) return "–";
  const size = Math.abs(value);
  if (size !== 0 && (size < 1e-3 || size >= 1e5)) return value.toExponential(2);
  return String(Number(value.toPrecision(4)));
}

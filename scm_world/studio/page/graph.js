// The causal graph: variables grouped by entity, collapsed by default.

import cytoscape from "cytoscape";

cytoscape.warnings(false); // of edges between nodes that overlap while a group opens

const ROW = 44, WIDE = 170, PAD = 26, READABLE = 0.7;
const MANY = 400; // edges that are drawn thin
const MOST = 1500; // edges that are drawn one by one; of more, those of whole groups
const SHAPES = { parameter: "round-rectangle", state: "ellipse", readout: "octagon", action: "diamond" };

/** Colours of a theme: those of Okabe and Ito, which colour-blind people tell apart. */
function colours() {
  const dark = matchMedia("(prefers-color-scheme: dark)").matches;
  return dark
    ? { ink: "#f2f4f7", line: "#93a1b3", group: "#2b333d", edge: "#66717f", parameter: "#12577f", state: "#7a5200",
        readout: "#005e45", action: "#7d3a63", lit: "#ff8a3d", chosen: "#ffd24d", cause: "#56B4E9", effect: "#ffb000",
        found: "#2ec27e", missed: "#ff6b6b", extra: "#d08be8" }
    : { ink: "#15202b", line: "#5d6b7a", group: "#f1f4f8", edge: "#9aa6b4", parameter: "#cfe6f6", state: "#fbe3b4",
        readout: "#c5ebdc", action: "#f4d7e8", lit: "#D55E00", chosen: "#b8860b", cause: "#0072B2", effect: "#B35900",
        found: "#007a54", missed: "#c0262d", extra: "#8e3fae" };
}

/** Write out the edges of bundles: each cause, with lag and condition, acts on each effect. */
function edgesOf(bundles) {
  const size = bundles.reduce((sum, [causes, effects]) => sum + causes.length * effects.length, 0);
  const made = { cause: new Uint32Array(size), effect: new Uint32Array(size), lag: new Uint8Array(size), when: new Uint8Array(size), conditions: [null] };
  let i = 0;
  for (const [causes, effects] of bundles)
    for (const [cause, lag, when] of causes) {
      if (!made.conditions.includes(when)) made.conditions.push(when);
      const number = made.conditions.indexOf(when);
      for (const effect of effects) { made.cause[i] = cause; made.effect[i] = effect; made.lag[i] = lag; made.when[i++] = number; }
    }
  return made;
}

export class Graph {
  /** Draw into an element; `choose` is called with the name of a variable that was clicked. */
  constructor(element, choose) {
    this.element = element;
    this.choose = choose;
    this.open = new Set();
    this.chosen = null;
    this.lit = new Set();
    this.marks = null;
    this.held = new Set();
    this.cut = new Set();
    this.merged = [];
    this.cy = cytoscape({
      container: element, minZoom: 0.05, maxZoom: 3, boxSelectionEnabled: false,
      autounselectify: true, autoungrabify: true, textureOnViewport: true, pixelRatio: Math.min(devicePixelRatio, 2),
    });
    this.#style();
    this.cy.on("tap", "node", event => {
      const data = event.target.data();
      if (data.group !== undefined) this.toggle(data.group);
      else this.choose(data.id);
    });
    this.cy.on("tap", event => { if (event.target === this.cy) this.choose(null); });
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.#style());
    new ResizeObserver(() => {
      this.cy.resize();
      const shape = element.clientHeight / (element.clientWidth || 1);
      if (Math.abs(Math.log(shape / (this.shape || 1e9))) > 0.3 && element.clientWidth) { this.placed = null; this.draw(); }
      if (!this.touched) this.fit();
    }).observe(element);
    element.addEventListener("pointerdown", () => this.touched = true);
    element.addEventListener("wheel", () => this.touched = true, { passive: true });
  }

  load(hello) {
    const same = this.hello?.variables.map(v => v.name).join() === hello.variables.map(v => v.name).join();
    this.hello = hello;
    this.edges = edgesOf(hello.bundles);
    this.byName = new Map(hello.variables.map((v, i) => [v.name, { ...v, number: i }]));
    this.groups = new Map();
    for (const v of hello.variables) {
      if (!this.groups.has(v.group)) this.groups.set(v.group, []);
      this.groups.get(v.group).push(v.name);
    }
    if (!same) {
      this.open = new Set([...this.groups].filter(([, names]) => names.length === 1 || this.groups.size === 1).map(([name]) => name));
      this.lit.clear();
      this.chosen = null;
      this.touched = false;
    }
    this.numbers = null;
    this.#order();
    clearTimeout(this.later);
    if (this.shown) this.draw();
    else this.later = setTimeout(() => this.draw(), 50); // not in one block with the first picture of the world
  }

  /** Order the groups of each rank by the mean place of their neighbours, so that few edges cross. */
  #order() {
    const groups = [...this.groups.keys()], near = new Map(groups.map(group => [group, new Set()])), ranks = new Map();
    const number = new Map(groups.map((group, i) => [group, i])), of = this.hello.variables.map(v => number.get(v.group));
    const { cause, effect } = this.edges, joined = new Uint8Array(groups.length ** 2);
    for (let i = 0; i < cause.length; i++) joined[of[cause[i]] * groups.length + of[effect[i]]] = 1;
    joined.forEach((is, i) => {
      const a = groups[Math.floor(i / groups.length)], b = groups[i % groups.length];
      if (is && a !== b) near.get(a).add(b), near.get(b).add(a);
    });
    for (const group of near.keys()) {
      const rank = this.hello.ranks[group] ?? Infinity;
      if (!ranks.has(rank)) ranks.set(rank, []);
      ranks.get(rank).push(group);
    }
    this.ranks = [...ranks.keys()].sort((m, n) => m - n).map(rank => ranks.get(rank));
    const x = new Map(), put = row => row.forEach((group, i) => x.set(group, (i + 0.5) / row.length));
    this.ranks.forEach(put);
    for (let sweep = 0; sweep < 12; sweep++)
      for (const row of sweep % 2 ? [...this.ranks].reverse() : this.ranks) {
        const mean = new Map(row.map(group => {
          const others = [...near.get(group)];
          return [group, others.length ? others.reduce((sum, other) => sum + x.get(other), 0) / others.length : x.get(group)];
        }));
        put(row.sort((m, n) => mean.get(m) - mean.get(n)));
      }
  }

  /** Causes or effects of a variable: name, lag, condition. */
  neighbours(name, causes) {
    const { cause, effect, lag, when, conditions } = this.edges, other = causes ? cause : effect;
    return this.#of([name], causes ? effect : cause)
      .map(i => ({ name: this.hello.variables[other[i]].name, lag: lag[i], when: conditions[when[i]] }));
  }

  /** The numbers of the edges whose ends in a column are some variables. */
  #of(names, column) {
    const numbers = new Set(names.map(name => this.byName.get(name)?.number)), found = [];
    for (let i = 0; i < column.length; i++) if (numbers.has(column[i])) found.push(i);
    return found;
  }

  toggle(group, open = !this.open.has(group)) {
    if (open === this.open.has(group)) return;
    this.open[open ? "add" : "delete"](group);
    this.draw();
  }

  all(open) {
    this.open = new Set(open ? this.groups.keys() : [...this.groups].filter(([, n]) => n.length === 1).map(([n]) => n));
    this.touched = false;
    this.draw();
  }

  /** Show all; where names could not be read then, what is chosen and its neighbours. */
  fit() {
    this.touched = false;
    if (!this.placed) return;
    // From the places of the groups: to measure what is drawn takes cytoscape far longer.
    const { rows, at } = this.placed, wide = this.cy.width(), high = this.cy.height();
    const [[x1, x2], [y1, y2]] = [["x", "w"], ["y", "h"]].map(([axis, size]) => {
      const ends = [...at].flatMap(([group, place]) => [-1, 1].map(side => place[axis] + side * rows.get(group)[size] / 2));
      return [Math.min(...ends), Math.max(...ends)];
    });
    const zoom = Math.min(1.5, (wide - 40) / (x2 - x1), (high - 28) / (y2 - y1));
    this.cy.viewport({ zoom, pan: { x: wide / 2 - zoom * (x1 + x2) / 2, y: high / 2 - zoom * (y1 + y2) / 2 } });
    const node = this.chosen && this.cy.getElementById(this.chosen);
    if (node?.nonempty() && this.cy.zoom() < READABLE) {
      this.cy.fit(node.closedNeighborhood(), 30);
      if (this.cy.zoom() > 1.1) this.cy.zoom({ level: 1.1, position: node.position() });
    }
  }

  /** Where each group is: ranks below one another; inside a group, rows. */
  #places() {
    const rows = new Map([...this.groups].map(([group, names]) => {
      const open = this.open.has(group), columns = open ? Math.max(1, Math.round(Math.sqrt(names.length / 3))) : 1;
      const count = open ? Math.ceil(names.length / columns) : 1;
      const alone = names.length === 1;
      return [group, { columns, w: columns * WIDE + (open && !alone ? PAD : 0), h: count * ROW + (open && !alone ? PAD + 8 : 10) }];
    }));
    const key = [...rows].map(([g, r]) => `${g}${r.w},${r.h}`).join();
    if (this.placed?.key === key && this.placed.hello === this.hello) return this.placed;
    const at = this.#wrapped(this.ranks, rows);
    this.placed = { key, hello: this.hello, rows, at };
    return this.placed;
  }

  /** Put ranks under one another, each in as many rows as make the whole largest in its place. */
  #wrapped(ranks, rows) {
    const across = this.element.clientWidth || 1, down = this.element.clientHeight || 1;
    this.shape = down / across;
    const lines = width => ranks.flatMap(rank => {
      const found = [[]];
      let x = 0;
      for (const group of rank) {
        const { w } = rows.get(group);
        if (x && x + w > width) { found.push([]); x = 0; }
        found.at(-1).push(group);
        x += w + 24;
      }
      return found.map((groups, i) => ({ groups, gap: i ? 18 : 50, x: groups.reduce((sum, g) => sum + rows.get(g).w + 24, -24),
        h: Math.max(...groups.map(g => rows.get(g).h)) }));
    });
    const size = all => [Math.max(...all.map(l => l.x)), all.reduce((sum, l) => sum + l.h + l.gap, 0)];
    const widest = Math.max(...[...rows.values()].map(r => r.w));
    let best = null, most = 0;
    for (let width = widest; width <= 40 * widest; width *= 1.15) {
      const all = lines(width), [w, h] = size(all), scale = Math.min(across / w, down / h);
      if (scale > most) { most = scale; best = all; }
    }
    const [, h] = size(best), spare = Math.min(2.2, Math.max(1, down / most / h)), at = new Map();
    let y = 0;
    for (const line of best) {
      let x = -line.x / 2;
      y += line.gap * spare + line.h / 2;
      for (const group of line.groups) {
        const { w } = rows.get(group);
        at.set(group, { x: x + w / 2, y });
        x += w + 24;
      }
      y += line.h / 2;
    }
    return at;
  }

  draw() {
    if (!this.hello) return;
    const { rows, at } = this.#places(), elements = [], shown = [];
    for (const [group, names] of this.groups) {
      const place = at.get(group), open = this.open.has(group), alone = names.length === 1;
      if (!open) {
        elements.push({ data: { id: `g:${group}`, group, label: group.endsWith(")") ? group : `${group} (${names.length})` }, position: { ...place }, classes: "closed" });
        names.forEach(name => shown[this.byName.get(name).number] = `g:${group}`);
        continue;
      }
      if (!alone) elements.push({ data: { id: `g:${group}`, group, label: group }, classes: "open" });
      const { columns } = rows.get(group), count = Math.ceil(names.length / columns);
      names.forEach((name, i) => {
        const v = this.byName.get(name), column = Math.floor(i / count), row = i % count;
        const short = !alone && name.startsWith(`${group}.`) ? name.slice(group.length + 1) : name;
        shown[v.number] = name;
        elements.push({
          data: { id: name, label: short, ...(alone ? {} : { parent: `g:${group}` }) }, classes: v.role,
          position: { x: place.x + (column - (columns - 1) / 2) * WIDE, y: place.y + (row - (count - 1) / 2) * ROW },
        });
      });
    }
    let merged = this.#merged(shown);
    this.bundled = merged.size > MOST;
    if (this.bundled) {
      const parents = new Map(elements.filter(e => e.data.parent).map(e => [e.data.id, e.data.parent]));
      merged = this.#merged(shown.map(id => parents.get(id) ?? id));
    }
    this.shown = shown;
    this.merged = [...merged.values()];
    const places = new Map(elements.filter(e => e.position).map(e => [e.data.id, e.position]));
    const many = merged.size > MANY;
    for (const { id, source, target, lag, contact } of merged.values()) {
      const a = places.get(source), b = places.get(target), far = a && b ? Math.abs(a.y - b.y) : 0;
      const bow = !many && far > 1.5 * ROW && Math.abs(a.x - b.x) < 2; // around what stands between
      elements.push({ data: { id, source, target, bow: 85 + 0.1 * far }, classes: `${bow ? "bow " : ""}${lag ? "lag1" : "lag0"}${contact ? " contact" : ""}${many ? " many" : ""}` });
    }
    this.cy.startBatch();
    this.cy.elements().remove();
    this.cy.add(elements);
    this.cy.endBatch();
    if (!this.touched) this.fit();
    this.lit = new Set();
    this.#highlight();
    if (this.lastLit) this.light(this.lastLit);
    this.hold(this.held, this.cut);
    if (this.marks) this.found(this.marks);
  }

  /** Put the edges between the same two nodes together; `edgesOf` has the place of each edge. */
  #merged(shown) {
    const nodes = [...new Set(shown)], place = new Map(nodes.map((id, i) => [id, i])), at = shown.map(id => place.get(id));
    const merged = new Map();
    const { cause, effect, lag, when, conditions } = this.edges, contact = conditions.indexOf("contact");
    const bodies = this.hello.variables.map(v => v.bodies), isGroup = nodes.map(id => id.startsWith("g:"));
    this.edgesOf = new Int32Array(cause.length).fill(-1);
    for (let i = 0; i < cause.length; i++) {
      const a = at[cause[i]], b = at[effect[i]], key = 2 * (a * nodes.length + b) + (lag[i] ? 1 : 0);
      if (a === b && isGroup[a]) continue;
      let edge = merged.get(key);
      if (!edge) {
        const source = nodes[a], target = nodes[b];
        merged.set(key, edge = { place: merged.size, id: `${source}→${target}→${lag[i] ? 1 : 0}`, source, target, lag: lag[i], contact: true, bodies: new Set() });
      }
      if (when[i] === contact) edge.bodies.add(bodies[cause[i]] * bodies.length + bodies[effect[i]]);
      else edge.contact = false;
      this.edgesOf[i] = edge.place;
    }
    return merged;
  }

  #style() {
    const c = colours();
    const role = name => ({ selector: `node.${name}`, style: { shape: SHAPES[name], "background-color": c[name] } });
    this.cy.style([
      { selector: "node", style: {
        label: "data(label)", "font-size": node => Math.min(11, Math.max(7, 250 / (node.data("label")?.length || 1))), "font-family": "system-ui, sans-serif", color: c.ink, "text-valign": "center",
        "text-halign": "center", width: WIDE - 16, height: 24, "border-width": 1, "border-color": c.line,
        "text-wrap": "ellipsis", "text-max-width": WIDE - 26, "background-color": c.group, "min-zoomed-font-size": 5 } },
      role("parameter"), role("state"), role("readout"), role("action"),
      { selector: "node.closed", style: { shape: "round-rectangle", "border-width": 2, "border-style": "double", "font-weight": 600 } },
      { selector: "node.open", style: { shape: "round-rectangle", "text-valign": "top", "text-margin-y": 14, "font-weight": 600,
        padding: 9, "padding-top": 22, "background-opacity": 0.6 } },
      { selector: "edge", style: {
        width: 1.4, "line-color": c.edge, "target-arrow-color": c.edge, "target-arrow-shape": "triangle", "arrow-scale": 0.8,
        "curve-style": "bezier", "control-point-step-size": 26, opacity: 0.75 } },
      { selector: "edge.bow", style: { "curve-style": "unbundled-bezier", "control-point-distances": "data(bow)", "control-point-weights": 0.5 } },
      { selector: "edge:loop", style: { "loop-direction": "90deg", "loop-sweep": "40deg", "control-point-step-size": 22 } },
      { selector: "edge.lag1", style: { "line-style": "dashed" } },
      { selector: "edge.contact", style: { "line-style": "dotted" } },
      { selector: "edge.many", style: { "curve-style": "straight", "line-style": "solid", width: 1, opacity: 0.16, "target-arrow-shape": "none" } },
      { selector: "edge.cut", style: { "line-color": c.missed, opacity: 0.12 } },
      { selector: "edge.lit", style: { "line-color": c.lit, "target-arrow-color": c.lit, width: 2.4, opacity: 0.9, "z-index": 5 } },
      { selector: "edge.many.lit", style: { opacity: 0.4, width: 1.4 } },
      { selector: "edge.missed", style: { "line-color": c.missed, "target-arrow-color": c.missed, opacity: 0.8 } },
      { selector: "edge.found", style: { "line-color": c.found, "target-arrow-color": c.found, width: 2.6, opacity: 0.95, "z-index": 6 } },
      { selector: "edge.many.found", style: { opacity: 0.6, width: 1.4 } },
      { selector: "edge.extra", style: { "line-color": c.extra, "target-arrow-color": c.extra, width: 3, opacity: 1, "z-index": 7,
        "target-arrow-shape": "triangle" } },
      { selector: "node.held", style: { "border-width": 3, "border-color": c.lit } },
      { selector: ".faded", style: { opacity: 0.12 } },
      { selector: "edge.faded", style: { opacity: 0.04 } },
      { selector: "edge.into", style: { "line-color": c.cause, "target-arrow-color": c.cause, width: 2.4, opacity: 1, "z-index": 9, "target-arrow-shape": "triangle" } },
      { selector: "edge.out", style: { "line-color": c.effect, "target-arrow-color": c.effect, width: 2.4, opacity: 1, "z-index": 9, "target-arrow-shape": "triangle" } },
      { selector: "edge.many.lag1.into, edge.many.lag1.out", style: { "line-style": "dashed" } },
      { selector: "node.cause", style: { "border-width": 3, "border-color": c.cause } },
      { selector: "node.effect", style: { "border-width": 3, "border-color": c.effect } },
      { selector: "node.chosen", style: { "border-width": 4, "border-color": c.chosen, "font-weight": 700 } },
    ]);
  }

  /** Show one variable with its causes and effects; all others fade. */
  select(name) {
    this.chosen = name;
    const group = name && this.byName.get(name)?.group;
    if (group && !this.open.has(group)) this.toggle(group, true);
    else this.#highlight();
    if (!this.touched) return this.fit();
    const node = name && this.cy.getElementById(name);
    if (node?.nonempty()) {
      const { x1, y1, x2, y2 } = this.cy.extent(), p = node.position();
      if (p.x < x1 || p.x > x2 || p.y < y1 || p.y > y2) this.cy.center(node);
    }
  }

  #highlight() {
    this.cy.batch(() => {
      this.cy.elements().removeClass("faded into out cause effect chosen");
      this.cy.edges(".own").remove();
      const node = this.chosen && this.cy.getElementById(this.chosen);
      if (!node?.nonempty()) return;
      if (this.bundled) this.#own(this.byName.get(this.chosen).number);
      const into = node.incomers("edge"), out = node.outgoers("edge");
      const kept = node.union(into).union(out).union(into.sources()).union(out.targets());
      this.cy.elements().difference(kept.union(kept.parents())).not(".open").addClass("faded");
      into.addClass("into").sources().addClass("cause");
      out.addClass("out").targets().addClass("effect");
      node.addClass("chosen");
    });
  }

  /** Draw the edges of one variable, where those of whole groups stand for them. */
  #own(number) {
    const found = new Map(), { cause, effect, lag } = this.edges;
    for (let i = 0; i < cause.length; i++) {
      if (cause[i] !== number && effect[i] !== number) continue;
      const source = this.shown[cause[i]], target = this.shown[effect[i]], late = lag[i] ? 1 : 0, id = `own ${source}→${target}→${late}`;
      found.set(id, { data: { id, source, target }, classes: `own many lag${late}` });
    }
    this.cy.add([...found.values()]);
  }

  /** Give a class to the edges in which some edges of the model are drawn. */
  #mark(numbers, name) {
    this.#put(new Set(numbers.map(number => this.merged[this.edgesOf[number]]?.id).filter(Boolean)), name);
  }

  #put(wanted, name) {
    this.cy.batch(() => {
      this.cy.edges(`.${name}`).forEach(edge => { if (!wanted.has(edge.id())) edge.removeClass(name); });
      for (const id of wanted) this.cy.getElementById(id).addClass(name);
    });
  }

  /** Light the edges by contact between the bodies of these causes and effects. */
  light(pairs) {
    const key = pairs.join();
    if (this.litKey === key && this.litFor === this.edgesOf) return;
    this.litKey = key;
    this.litFor = this.edgesOf;
    this.lastLit = pairs;
    const lit = pairs.map(([a, b]) => a * this.shown.length + b);
    this.#put(new Set(this.merged.filter(edge => lit.some(code => edge.bodies.has(code))).map(edge => edge.id)), "lit");
  }

  /** Mark what interventions hold, and the edges into what they have cut. */
  hold(names, cut) {
    const key = [[...names], [...cut]].join(";");
    if (this.heldKey === key && this.heldFor === this.edgesOf) return;
    this.heldKey = key;
    this.heldFor = this.edgesOf;
    this.held = names;
    this.cut = cut;
    this.cy.batch(() => {
      this.cy.nodes().removeClass("held");
      for (const name of names) {
        const node = this.cy.getElementById(name);
        (node.nonempty() ? node : this.cy.getElementById(`g:${this.byName.get(name)?.group}`)).addClass("held");
      }
    });
    this.#mark(this.#of([...cut], this.edges.effect), "cut");
  }

  /** Mark what experiments have found, missed, or found without an edge. */
  found(marks) {
    this.marks = marks;
    const { cause, effect, lag } = this.edges, size = this.hello.variables.length;
    const code = (a, b, late) => (a * size + b) * 8 + late, number = name => this.byName.get(name)?.number ?? NaN;
    const numbers = this.numbers ??= new Map([...cause].map((a, i) => [code(a, effect[i], lag[i]), i]));
    const numberOf = e => numbers.get(code(number(e[0]), number(e[1]), e[2]));
    const at = edges => edges.map(numberOf).filter(n => n !== undefined);
    this.cy.edges(".new").remove();
    const shown = name => {
      const v = this.byName.get(name);
      return v && (this.open.has(v.group) ? name : `g:${v.group}`);
    };
    const extra = marks.found.filter(e => numberOf(e) === undefined).concat(marks.extra);
    for (const [cause, effect, lag] of extra) {
      const id = `new ${cause} ${effect} ${lag}`, source = shown(cause), target = shown(effect);
      if (source && target && this.cy.getElementById(id).empty())
        this.cy.add({ data: { id, source, target }, classes: `extra new lag${lag ? 1 : 0}` });
    }
    this.#mark(at(marks.found), "found");
    this.#mark(at(marks.missed), "missed");
  }
}

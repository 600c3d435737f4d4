"""Pictures of a declared model: a figure, and a page that answers to the pointer."""

from __future__ import annotations

import io
import textwrap
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from html import escape
from itertools import pairwise
from string import Template
from typing import TYPE_CHECKING, Any, final

import networkx as nx
import numpy as np

from scm_world.discovery.names import Families, by_entity
from scm_world.graph import SCM
from scm_world.graph.exchange import to_digraph
from scm_world.runs.canvas import DPI, INK, WIDTH, blank, save
from scm_world.runs.files import Location

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

LAG_0, LAG_1 = "#5f6b7a", "#9a6fb0"
HUB = "one control step"
BOX, GAP, LANE = 30.0, 8.0, 22.0  # [pixels]: height of a node, between two, of an edge that passes

# --- the layout -----------------------------------------------------------------------------------

Item = Any
"""A node, or ``(cause, effect, column)``: where a long edge passes a column between its ends."""


def forward(graph: nx.DiGraph) -> nx.DiGraph:
    """Return a graph without the edges that close a cycle through time.

    The attribute ``lags`` of each edge is the set of its lags. Of the edges within a strongly
    connected component only contemporaneous ones are kept, if they are acyclic.
    """
    parts = enumerate(nx.strongly_connected_components(graph))
    knot = {name: number for number, part in parts for name in part}
    ahead = nx.DiGraph()
    ahead.add_nodes_from(graph)
    ahead.add_edges_from((c, e) for c, e in graph.edges if knot[c] != knot[e])
    within = [(c, e) for c, e, lags in graph.edges(data="lags") if knot[c] == knot[e] and 0 in lags]
    if nx.is_directed_acyclic_graph(nx.DiGraph(within)):
        ahead.add_edges_from(within)
    return ahead


def columns_of(ahead: nx.DiGraph) -> dict[Any, int]:
    """Return the column of each node of an acyclic graph: the longest way from a root.

    But roots stand right before an effect, and nodes without effects right after their causes.
    """
    layers = enumerate(nx.topological_generations(ahead))
    column = {name: number for number, layer in layers for name in layer}
    for name in ahead:
        effects = list(ahead.successors(name))
        if effects and not ahead.in_degree(name):
            going_on = [effect for effect in effects if ahead.out_degree(effect)]
            column[name] = min(column[effect] for effect in going_on or effects) - 1
    for name in ahead:
        if ahead.in_degree(name) and not ahead.out_degree(name):
            column[name] = 1 + max(column[cause] for cause in ahead.predecessors(name))
    return column


def routes_of(ahead: nx.DiGraph, column: Mapping[Any, int]) -> dict[tuple[Any, Any], list[Item]]:
    """Return what each edge passes: its cause, an item in each column between, its effect."""
    return {
        (cause, effect): [
            cause,
            *((cause, effect, at) for at in range(column[cause] + 1, column[effect])),
            effect,
        ]
        for cause, effect in ahead.edges
    }


def heights_of(
    column: Mapping[Item, int],
    near: nx.Graph,
    height: Callable[[Item], float],
) -> dict[Item, float]:
    """Return the middle of each item, downwards from 0, so that few edges cross and most are short.

    Items, given with their columns, are ordered by the mean of their neighbors in ``near``, and
    then moved as near to it as the heights of the others allow (isotonic regression).

    Source:
        Sugiyama, Tagawa and Toda, *Methods for visual understanding of hierarchical system
        structures*, IEEE Transactions on Systems, Man, and Cybernetics 11, 1981.
    """
    from scipy.optimize import isotonic_regression

    layers: dict[int, list[Item]] = {}
    for item in column:
        layers.setdefault(column[item], []).append(item)
    ordered = [layers[number] for number in sorted(layers)]
    y = {item: (i + 0.5) / len(layer) for layer in ordered for i, item in enumerate(layer)}
    for sweep in range(40):
        for layer in ordered if sweep % 2 == 0 else reversed(ordered):
            wanted = {i: np.mean([y[n] for n in near[i]] or [y[i]]) for i in layer}
            if sweep < 24:
                layer.sort(key=wanted.__getitem__)
                y |= {item: (i + 0.5) / len(layer) for i, item in enumerate(layer)}
                continue
            ends = np.cumsum([height(item) for item in layer])
            middles = ends - [height(item) / 2.0 for item in layer]
            if sweep == 24:  # from parts of a column to lengths
                wanted = {item: middle - ends[-1] / 2.0
                          for item, middle in zip(layer, middles, strict=True)}  # fmt: skip
            moved = isotonic_regression(np.array([wanted[i] for i in layer]) - middles).x + middles
            y |= {item: float(place) for item, place in zip(layer, moved, strict=True)}
    top = min((y[item] - height(item) / 2.0 for item in y), default=0.0)
    return {item: place - top for item, place in y.items()}


FILLS = {
    "exogenous": "#fff1c9",
    "derived": "#d9ecd5",
    "measured": "#d5e5f5",
    "action": "#f7d6d0",
    "fixed": "#e6e6e6",
}


# --- a declared model ---------------------------------------------------------------------------


@final
@dataclass(frozen=True)
class LayeredModel:
    """A model in layers [pixels], y downwards.

    Attributes:
        places: Center of each node.
        kinds: Kind of each node; ``"hub"`` for a node that stands for many edges.
        box: Width and height of a node.
        arrows: Cause, effect, the points between them, the lag, and whether it also points back.
        members: The variables of each node; none of a hub.
        loops: Nodes that affect themselves.
        alone: Variables without any edge, in few words.
        height: Of all of it.
    """

    places: dict[str, tuple[float, float]]
    kinds: dict[str, str]
    box: tuple[float, float]
    arrows: tuple[tuple[str, str, tuple[tuple[float, float], ...], int, bool], ...]
    members: dict[str, tuple[str, ...]]
    loops: tuple[str, ...]
    alone: tuple[str, ...]
    height: float


def lay_out(model: SCM) -> LayeredModel:
    """Return places for families of variables; lagged edges of many causes run through hubs."""
    families = Families(model, (edge.key for edge in model.edges))
    graph = nx.DiGraph()
    for edge in model.edges:
        cause, effect = families.of[edge.cause], families.of[edge.effect]
        lags = graph.get_edge_data(cause, effect, {"lags": set()})["lags"]
        graph.add_edge(cause, effect, lags={edge.lag, *lags})
    hubs = _bundle(graph)
    ahead = forward(graph)
    ahead.add_edges_from((hub, effect) for hub in hubs for effect in graph.successors(hub))
    column = columns_of(ahead)
    routes = routes_of(ahead, column)
    items = column | {item: item[2] for route in routes.values() for item in route[1:-1]}
    near = nx.Graph()
    near.add_nodes_from(items)
    for route in routes.values():
        nx.add_path(near, route)
    y = heights_of(items, near, lambda item: BOX + GAP if isinstance(item, str) else LANE)
    step = WIDTH / (max(column.values(), default=0) + 1)
    half = min(170.0, 0.72 * step) / 2.0
    at = {item: (step * (number + 0.5), y[item]) for item, number in items.items()}
    arrows = []
    for (cause, effect), route in routes.items():
        lanes = [(at[i][0] + side, at[i][1]) for i in route[1:-1] for side in (-half, half)]
        start, end = (at[cause][0] + half, at[cause][1]), (at[effect][0] - half, at[effect][1])
        back = graph.has_edge(effect, cause) and not ahead.has_edge(effect, cause)
        lags = sorted(graph.edges[cause, effect]["lags"])
        for lag in lags:
            aside = (8.0 * lag - 4.0) if len(lags) > 1 else 0.0
            points = tuple((x, height + aside) for x, height in (start, *lanes, end))
            arrows.append((cause, effect, points, lag, back))
    first: dict[str, Any] = {name: model.declared(m[0]) for name, m in families.members.items()}
    return LayeredModel(
        places={name: at[name] for name in graph},
        kinds={name: "hub" if name in hubs else first[name].kind for name in graph},
        box=(2.0 * half, BOX),
        arrows=tuple(arrows),
        members={name: families.members.get(name, ()) for name in graph},
        loops=tuple(name for name in graph if graph.has_edge(name, name)),
        alone=tuple(by_entity(name for name in model if families.of[name] not in graph)),
        height=max(y.values(), default=0.0) + BOX,
    )


def _bundle(graph: nx.DiGraph) -> list[str]:
    """Run the lagged edges of several effects with the same causes through one node each."""
    bundles: dict[frozenset[str], list[str]] = {}
    for name in graph:
        causes = frozenset(c for c, _, lags in graph.in_edges(name, data="lags") if 1 in lags)
        bundles.setdefault(causes, []).append(name)
    hubs: list[str] = []
    for causes, effects in bundles.items():
        if len(causes) > 2 and len(effects) > 1:
            hubs.append(HUB + " " * len(hubs))
            for effect in effects:
                for cause in sorted(causes):
                    lags = graph.edges[cause, effect]["lags"]
                    lags.discard(1)
                    if not lags:
                        graph.remove_edge(cause, effect)
                    graph.add_edge(cause, hubs[-1], lags={1})
                graph.add_edge(hubs[-1], effect, lags={1})
    return hubs


def draw_model(model: SCM, path: Location | str, *, title: str = "") -> None:
    """Draw a model as a layered graph, causes left of effects.

    Variables that differ in numbers only and have the same edges are one node. Where several
    variables have the same causes of one step before, the arrows run through one node.

    Args:
        model: Any model.
        path: Of the PNG, 1600 pixels wide and as high as it takes.
        title: What the model is.
    """
    save(_drawn(model, lay_out(model), title), path)


PAGE = Template("""<!DOCTYPE html>
<html lang="en"><head><meta charset="utf-8">
<title>$title</title><style>
body{margin:0;background:#fff}svg{display:block}
.node{cursor:pointer}text{pointer-events:none}.edge{pointer-events:none}
.on .edge{opacity:.06}.on .edge.hot{opacity:1}
</style></head><body>
$picture
<script>
const svg=document.querySelector("svg");
for(const node of svg.querySelectorAll(".node"))
  for(const [event,on] of [["pointerenter",true],["pointerleave",false]])
    node.addEventListener(event,()=>{svg.classList.toggle("on",on);
      for(const edge of svg.querySelectorAll(".of"+node.id.slice(4)))
        edge.classList.toggle("hot",on)});
</script></body></html>
""")
MOST = 12  # variables of a node, or causes, that are described one by one


def to_html(model: SCM, *, title: str = "Causal graph") -> str:
    """Return the picture of ``draw_model`` as one HTML page that needs no network.

    Where the pointer rests on a node, its variables say what they are, and only its edges are seen.
    """
    from matplotlib import rc_context

    drawing, page = lay_out(model), io.StringIO()
    with rc_context({"svg.fonttype": "none", "svg.hashsalt": "scm_world"}):
        nothing = dict.fromkeys(("Date", "Creator", "Format", "Type"))
        _drawn(model, drawing, title).savefig(page, format="svg", metadata=nothing)
    svg = page.getvalue().partition("<svg")
    picture, graph, at = svg[1] + svg[2], to_digraph(model), list(drawing.places)
    for number, name in enumerate(at):
        members = drawing.members[name]
        about = "\n\n".join(_described(graph, member) for member in members[:MOST])
        if len(members) > MOST:
            about += f"\n\nand {len(members) - MOST} more"
        group = f'<g id="node{number}"'
        picture = picture.replace(
            f"{group}>", f'{group} class="node"><title>{escape(about or HUB)}</title>'
        )
    for number, (cause, effect, *_) in enumerate(drawing.arrows):
        group = f'<g id="edge{number}"'
        ends = f"of{at.index(cause)} of{at.index(effect)}"
        picture = picture.replace(f"{group}>", f'{group} class="edge {ends}">')
    return PAGE.substitute(title=escape(title), picture=picture)


def _described(graph: nx.MultiDiGraph, name: str) -> str:
    """Return what is known of a variable, line by line."""
    data = graph.nodes[name]
    lines = [name, " · ".join(dict.fromkeys((data["kind"], data["role"])))]
    words = {"unit": "unit", "value_shape": "shape", "bounds": "bounds", "a": "A", "b": "B"}
    lines += [f"{word}: {data[fact]}" for fact, word in words.items() if fact in data]
    lines += [data["doc"]] if "doc" in data else []
    for lag in (0, 1):
        when = "one control step ago" if lag else "at the same step"
        into = graph.in_edges(name, keys=True, data="when")
        causes = [c + f" ({w})" * bool(w) for c, _, ago, w in into if ago == lag]
        if causes:
            more = f" and {len(causes) - MOST} more" if len(causes) > MOST else ""
            lines.append(f"causes {when}: {', '.join(causes[:MOST])}{more}")
    return "\n".join(lines)


def _drawn(model: SCM, drawing: LayeredModel, title: str) -> Figure:
    from matplotlib.patches import FancyArrowPatch, FancyBboxPatch
    from matplotlib.path import Path as Line

    alone = textwrap.fill(f"No edge at all: {', '.join(drawing.alone)}", 190)
    below = 22.0 * (alone.count("\n") + 1) + 10.0 if drawing.alone else 10.0
    top, height = 85.0, 85.0 + drawing.height + below
    figure = blank(WIDTH / DPI, height / DPI)
    ax = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    ax.set_xlim(0, WIDTH)
    ax.set_ylim(height - top, -top)
    ax.axis("off")
    for number, (_, _, points, lag, both) in enumerate(drawing.arrows):
        line, codes = [points[0]], [Line.MOVETO]
        for (x0, y0), (x1, y1) in pairwise(points):  # it leaves and arrives horizontally
            bend = 0.5 * (x1 - x0)
            line += [(x0 + bend, y0), (x1 - bend, y1), (x1, y1)]
            codes += [Line.CURVE4] * 3
        style: Any = {"arrowstyle": "<|-|>" if both else "-|>", "mutation_scale": 9, "lw": 1.1}
        style |= {"color": LAG_1 if lag else LAG_0, "ls": (0, (4, 2.5)) if lag else "solid"}
        arrow = FancyArrowPatch(path=Line(line, codes), shrinkA=0, shrinkB=0, **style)
        ax.add_patch(arrow).set_gid(f"edge{number}")
    width, high = drawing.box
    for number, (name, (x, y)) in enumerate(drawing.places.items()):
        hub = drawing.kinds[name] == "hub"
        face, ink = (INK, "white") if hub else (FILLS[drawing.kinds[name]], INK)
        look: Any = {"boxstyle": "round,pad=0,rounding_size=6", "fc": face, "ec": "#6b7686"}
        corner = (x - width / 2, y - high / 2)
        box = FancyBboxPatch(corner, width, high, lw=0.8, zorder=3, **look)
        ax.add_patch(box).set_gid(f"node{number}")
        upper, dot, lower = name.strip().partition(".")
        text = f"{upper}.\n{lower}" if dot else upper
        size = min(9.0, 1.15 * width / max(map(len, text.split("\n"))))
        place: Any = {"ha": "center", "va": "center", "linespacing": 1.05, "zorder": 4}
        ax.text(x, y, text, fontsize=size, color=ink, **place)
        if name in drawing.loops:
            style = {"connectionstyle": "arc3,rad=-1.3", "arrowstyle": "-|>", "mutation_scale": 8}
            style |= {"color": LAG_1, "ls": (0, (3, 2)), "shrinkA": 0, "shrinkB": 0, "zorder": 2}
            ends = ((x - 16, y - high / 2), (x + 16, y - high / 2))
            ax.add_patch(FancyArrowPatch(*ends, **style))
    ax.text(20, 34 - top, title or "causal model", fontsize=17, weight="bold", color=INK)
    counts = f"{len(model)} variables, {len(model.edges)} edges"
    ax.text(20, 62 - top, counts, fontsize=12, color=INK)
    if drawing.alone:
        ax.text(20, height - top - 10, alone, fontsize=10, color=INK, va="bottom")
    _legend(ax, set(drawing.kinds.values()))
    return figure


def _legend(ax: Axes, kinds: set[str]) -> None:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    handles: list[Any] = [
        Patch(fc=fill, ec="#6b7686", label=kind) for kind, fill in FILLS.items() if kind in kinds
    ]
    handles.append(Line2D([], [], color=LAG_0, label="contemporaneous"))
    handles.append(Line2D([], [], color=LAG_1, ls="--", label="one control step later"))
    if "hub" in kinds:
        label = "each arrow in stands for one to every node it points at"
        handles.append(Patch(fc=INK, label=label))
    place: Any = {"loc": "upper right", "bbox_to_anchor": (0.995, 0.995)}
    ax.legend(handles=handles, ncol=4, frameon=False, fontsize=10, **place)

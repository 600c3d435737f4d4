"""A picture of a declared model: layers from left to right, causes before effects."""

from __future__ import annotations

import textwrap
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Any, final

import networkx as nx
import numpy as np

from scm_world.discovery.names import by_entity, families_of
from scm_world.graph import SCM
from scm_world.queries.experiments.effects import EdgeKey
from scm_world.runs.canvas import DPI, INK, WIDTH, blank, save
from scm_world.runs.files import Location

if TYPE_CHECKING:
    from matplotlib.axes import Axes

LAG_0, LAG_1, CONTACT, RIM = "#5f6b7a", "#9a6fb0", "#d98032", "#6b7686"
HUB = "one control step"
FOLDED = (
    "Folded: a node has the variables of one quantity in one kinematic tree, and an arrow stands "
    "for all edges between them."
)
BOX, GAP, LANE = 30.0, 8.0, 22.0  # [pixels]: height of a node, between two, of an edge that passes
MOST = 64  # nodes with edges: where there are more, they are folded
WIDTHS = (-4.0, 0.0), (0.4, 3.2)  # powers of ten of a strength, and the width of its line
TOP = 85.0  # [pixels] of the title and the legend
FILLS = {
    "exogenous": "#fff1c9",
    "derived": "#d9ecd5",
    "measured": "#d5e5f5",
    "action": "#f7d6d0",
    "fixed": "#e6e6e6",
    "hub": INK,
}


@final
@dataclass(frozen=True)
class LayeredModel:
    """A model in layers [pixels], y downwards.

    Attributes:
        graph: Groups of variables. Each node has a ``kind`` (``"hub"`` if it stands for many
            edges) and a center ``at``; each edge has ``lags``, the largest ``strength`` of an edge
            in it, whether all of them act by ``contact``, and the ``points`` between which it runs,
            the ends included.
        acyclic: The part of the graph whose edges lead from layer to layer.
        box: Width and height of a node.
        alone: Variables without any edge, in few words.
        height: Of all of it.
        folded: Whether the nodes are quantities of a tree.
    """

    graph: nx.DiGraph
    acyclic: nx.DiGraph
    box: tuple[float, float]
    alone: tuple[str, ...]
    height: float
    folded: bool


def fold(model: SCM, families: Mapping[str, Sequence[str]]) -> dict[str, tuple[str, ...]]:
    """Return fewer families of variables: those of one quantity in one tree are one.

    A tree is a strongly connected set of states: joints that move one another in every step.
    States that move others and are not moved by them, such as activations, are one tree if they
    move the same ones. Parameters and other variables belong to the trees that they always act on.
    """
    of = {name: family for family, members in families.items() for name in members}
    parents = {name: model[name].all_parents for name in model}
    between = {name: id(causes) for name, causes in parents.items()}  # a tree's states share them
    some = {between[name]: causes for name, causes in parents.items() if causes}
    always = nx.DiGraph()  # with a node between causes and those that have the same ones
    for number, causes in some.items():
        always.add_edges_from((of[p.name], number) for p in causes if p.when != "contact")
    ends = ((number, of[name]) for name, number in between.items() if number in always)
    always.add_edges_from([*ends])
    first: dict[str, Any] = {f: model.declared(members[0]) for f, members in families.items()}
    is_state = {family: one.role == "state" for family, one in first.items()}
    shown = (node for node in always if is_state.get(node, True))
    knots = nx.strongly_connected_components(always.subgraph(shown))
    tree = {family: number for number, knot in enumerate(knots) for family in knot}
    joined: dict[Any, int] = {}
    for family in [one for one, state in is_state.items() if state and one in tree]:
        acts = {tree[name] for n in always.succ[family] for name in always.succ[n] if name in tree}
        beyond = frozenset(acts - {tree[family]})
        if beyond:
            quantity = first[family].name.rpartition(".")[2]
            tree[family] = joined.setdefault((quantity, beyond), tree[family])
    alike: dict[Any, list[str]] = {}
    for family, one in first.items():
        after = always.succ.get(family, ())
        near = {family} if is_state[family] else {name for n in after for name in always.succ[n]}
        trees = frozenset(tree[name] for name in near if name in tree)
        key = one.kind, one.role, one.name.rpartition(".")[2], trees
        alike.setdefault(key if family in {*of.values()} else family, []).append(family)
    found: dict[str, tuple[str, ...]] = {}
    times = Counter(key[2] for key in alike)
    for (_, _, quantity, _), group in alike.items():
        members = tuple(name for family in group for name in families[family])
        among = f": {members[0].partition('.')[0]} …" if times[quantity] > 1 else ""
        label = f"{quantity} ({len(members)}{among})"
        found[label if len(group) > 1 and label not in found else group[0]] = members
    return found


def lay_out(
    model: SCM,
    *,
    folded: bool | None = None,
    strength: Mapping[EdgeKey, float] | None = None,
    at_least: float = 0.0,
) -> LayeredModel:
    """Return places for groups of variables; lagged edges of many causes run through hubs.

    Arguments are those of ``draw_model``.
    """
    sizes, graph = strength or {}, nx.DiGraph()
    edges = [edge for edge in model.edges if sizes.get(edge.key, at_least) >= at_least]
    members = families_of(model, (edge.key for edge in edges))
    if folded is None:
        ends = {name for edge in edges for name in edge.key[:2]}
        folded = sum(ends.isdisjoint(names) is False for names in members.values()) > MOST
    members = fold(model, members) if folded else members
    of = {name: label for label, names in members.items() for name in names}
    for edge in edges:
        cause, effect = of[edge.cause], of[edge.effect]
        size, contact = sizes.get(edge.key, np.nan), edge.when == "contact"
        _join(graph, cause, effect, {edge.lag}, strength=size, contact=contact)
    for name in graph:
        first: Any = model.declared(members[name][0])
        graph.nodes[name]["kind"] = first.kind
    _bundle(graph)
    # Of the edges within a cycle only contemporaneous ones lead on, if they are acyclic.
    parts = enumerate(nx.strongly_connected_components(graph))
    knot = {name: number for number, part in parts for name in part}
    acyclic = nx.DiGraph([(c, e) for c, e in graph.edges if knot[c] != knot[e]])
    acyclic.add_nodes_from(graph)
    within = [(c, e) for c, e, lags in graph.edges(data="lags") if knot[c] == knot[e] and 0 in lags]
    if nx.is_directed_acyclic_graph(nx.DiGraph(within)):
        acyclic.add_edges_from(within)
    hubs = [name for name, kind in graph.nodes(data="kind") if kind == "hub"]
    acyclic.add_edges_from((hub, effect) for hub in hubs for effect in graph.successors(hub))
    column = _columns(acyclic)
    items, near = dict(column), nx.Graph()
    near.add_nodes_from(column)
    for cause, effect in acyclic.edges:  # a long edge takes a lane in each column between its ends
        lanes = [(cause, effect, at) for at in range(column[cause] + 1, column[effect])]
        graph.edges[cause, effect]["lanes"] = lanes
        items |= {lane: lane[2] for lane in lanes}
        nx.add_path(near, [cause, *lanes, effect])
    y = _heights(items, near)
    step = WIDTH / (max(column.values(), default=0) + 1)
    half = min(170.0, 0.72 * step) / 2.0
    at = {item: (step * (number + 0.5), y[item]) for item, number in items.items()}
    for name in graph:
        graph.nodes[name]["at"] = at[name]
    for cause, effect in acyclic.edges:
        between = [
            (at[lane][0] + side, at[lane][1])
            for lane in graph.edges[cause, effect]["lanes"]
            for side in (-half, half)
        ]
        start, end = (at[cause][0] + half, at[cause][1]), (at[effect][0] - half, at[effect][1])
        graph.edges[cause, effect]["points"] = [start, *between, end]
    alone = tuple(by_entity(name for name in model if of[name] not in graph))
    height = max(y.values(), default=0.0) + BOX
    return LayeredModel(graph, acyclic, (2.0 * half, BOX), alone, height, folded)


def _join(
    graph: nx.DiGraph, cause: str, effect: str, lags: set[int], *, strength: float, contact: bool
) -> None:
    """Add an edge to those between two nodes."""
    before = graph.get_edge_data(cause, effect, {})
    lags, contact = lags | before.get("lags", set()), contact and before.get("contact", True)
    size = np.fmax(strength, before.get("strength", np.nan))
    graph.add_edge(cause, effect, lags=lags, strength=size, contact=contact)


def _bundle(graph: nx.DiGraph) -> None:
    """Run the lagged edges of several effects with the same causes through one node each."""
    bundles: dict[frozenset[str], list[str]] = {}
    for name in graph:
        causes = frozenset(c for c, _, lags in graph.in_edges(name, data="lags") if 1 in lags)
        bundles.setdefault(causes, []).append(name)
    for causes, effects in bundles.items():
        if len(causes) <= 2 or len(effects) == 1:
            continue
        hub = HUB
        while hub in graph:
            hub += " "
        graph.add_node(hub, kind="hub")
        for effect in effects:
            for cause in sorted(causes):
                about = graph.edges[cause, effect]
                about["lags"].discard(1)
                if not about["lags"]:
                    graph.remove_edge(cause, effect)
                for ends in ((cause, hub), (hub, effect)):
                    _join(graph, *ends, **{**about, "lags": {1}})


def _columns(acyclic: nx.DiGraph) -> dict[Any, int]:
    """Return the column of each node: the longest way from a root.

    But roots stand right before an effect, and nodes without effects right after their causes.
    """
    layers = enumerate(nx.topological_generations(acyclic))
    column = {name: number for number, layer in layers for name in layer}
    for name in acyclic:
        effects = list(acyclic.successors(name))
        if effects and not acyclic.in_degree(name):
            going_on = [effect for effect in effects if acyclic.out_degree(effect)]
            column[name] = min(column[effect] for effect in going_on or effects) - 1
    for name in acyclic:
        if acyclic.in_degree(name) and not acyclic.out_degree(name):
            column[name] = 1 + max(column[cause] for cause in acyclic.predecessors(name))
    return column


def _heights(column: dict[Any, int], near: nx.Graph) -> dict[Any, float]:
    """Return the middle of each item, downwards from 0, so that few edges cross and most are short.

    Items, given with their columns, are ordered by the mean of their neighbors in ``near``, and
    then moved as near to it as the heights of the others allow (isotonic regression).

    Source:
        Sugiyama, Tagawa and Toda, *Methods for visual understanding of hierarchical system
        structures*, IEEE Transactions on Systems, Man, and Cybernetics 11, 1981.
    """
    from scipy.optimize import isotonic_regression

    height = {item: BOX + GAP if isinstance(item, str) else LANE for item in column}
    numbers = sorted(set(column.values()))
    layers = [[item for item in column if column[item] == number] for number in numbers]
    y = {item: (i + 0.5) / len(layer) for layer in layers for i, item in enumerate(layer)}
    for sweep in range(40):
        for layer in layers if sweep % 2 == 0 else reversed(layers):
            wanted = {i: np.mean([y[n] for n in near[i]] or [y[i]]) for i in layer}
            if sweep < 24:
                layer.sort(key=wanted.__getitem__)
                y |= {item: (i + 0.5) / len(layer) for i, item in enumerate(layer)}
                continue
            ends = np.cumsum([height[item] for item in layer])
            middles = ends - [height[item] / 2.0 for item in layer]
            if sweep == 24:  # from parts of a column to lengths
                wanted = dict(zip(layer, middles - ends[-1] / 2.0, strict=True))
            moved = isotonic_regression(np.array([wanted[i] for i in layer]) - middles).x + middles
            y |= dict(zip(layer, moved.tolist(), strict=True))
    top = min((y[item] - height[item] / 2.0 for item in y), default=0.0)
    return {item: place - top for item, place in y.items()}


def draw_model(
    model: SCM,
    path: Location | str,
    *,
    title: str = "",
    folded: bool | None = None,
    strength: Mapping[EdgeKey, float] | None = None,
    at_least: float = 0.0,
) -> None:
    """Draw a model as a layered graph, causes left of effects.

    Variables that differ in numbers only and have the same edges are one node. Where several
    variables have the same causes of one step before, the arrows run through one node. A folded
    picture has one node for each quantity of a kinematic tree: an arrow says that some of the
    variables on its left act on some on its right.

    Args:
        model: The model.
        path: Path of the PNG, 1600 pixels wide and as high as it takes.
        title: Title of the picture.
        folded: Whether to fold; if None, where there would be more than 64 nodes with edges.
        strength: Strength of edges, such as ``verify(world).strength``: a strong edge is drawn
            thick, one of a ten-thousandth of the spread or less is thin.
        at_least: Edges that are weaker are left out; those without a strength stay.
    """
    from matplotlib.patches import FancyBboxPatch

    drawing = lay_out(model, folded=folded, strength=strength, at_least=at_least)
    graph, (width, high) = drawing.graph, drawing.box
    none = f"No edge of {at_least:g}" if at_least else "No edge at all"
    notes = [f"{none}: {', '.join(drawing.alone)}"] if drawing.alone else []
    notes += [FOLDED] * drawing.folded
    below = "\n".join(textwrap.fill(note, 190) for note in notes)
    height = TOP + drawing.height + 22.0 * (below.count("\n") + bool(below)) + 10.0
    figure = blank(WIDTH / DPI, height / DPI)
    ax = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    ax.set_xlim(0, WIDTH)
    ax.set_ylim(height - TOP, -TOP)
    ax.axis("off")
    for cause, effect in drawing.acyclic.edges:
        back = graph.has_edge(effect, cause) and not drawing.acyclic.has_edge(effect, cause)
        edge = graph.edges[cause, effect]
        for lag in sorted(edge["lags"]):
            aside = (8.0 * lag - 4.0) if len(edge["lags"]) > 1 else 0.0
            points = [(x, y + aside) for x, y in edge["points"]]
            line = [points[0]]
            for (x0, y0), (x1, y1) in pairwise(points):  # it leaves and arrives horizontally
                bend = 0.5 * (x1 - x0)
                line += [(x0 + bend, y0), (x1 - bend, y1), (x1, y1)]
            _arrow(ax, line, lag, edge, both=back)
    beside = {ends for ends in graph.edges if not drawing.acyclic.has_edge(*ends)}
    beside -= {(effect, cause) for cause, effect in drawing.acyclic.edges}
    for cause, effect in sorted(beside):  # within a cycle: an arc on the right
        back = cause != effect and (effect, cause) in beside
        if back and effect < cause:
            continue
        (x0, y0), (x1, y1) = (graph.nodes[name]["at"] for name in (cause, effect))
        y0, y1 = (y0 - 7.0, y0 + 7.0) if cause == effect else (y0, y1)
        edge, x = graph.edges[cause, effect], max(x0, x1) + width / 2.0 + 20.0
        x += min(0.3 * abs(y1 - y0), 60.0)
        line = [(x0 + width / 2.0, y0), (x, y0), (x, y1), (x1 + width / 2.0, y1)]
        _arrow(ax, line, max(edge["lags"]), edge, both=back)
    for name, about in graph.nodes.items():
        x, y = about["at"]
        corner = (x - width / 2, y - high / 2)
        ax.add_patch(
            FancyBboxPatch(
                corner, width, high, "round,pad=0,rounding_size=6", fc=FILLS[about["kind"]],
                ec=RIM, lw=0.8, zorder=3,
            )
        )  # fmt: skip
        upper, dot, lower = name.strip().partition(".")
        text = f"{upper}.\n{lower}" if dot else upper
        size = min(9.0, 1.15 * width / max(map(len, text.split("\n"))))
        color = "white" if about["kind"] == "hub" else INK
        ax.text(
            x, y, text, fontsize=size, color=color, ha="center", va="center", linespacing=1.05,
            zorder=4,
        )  # fmt: skip
    ax.text(20, 34 - TOP, title or "causal model", fontsize=17, weight="bold", color=INK)
    counts = f"{len(model)} variables, {len(model.edges)} edges"
    counts += f", shown from {at_least:g}" * (at_least > 0.0) + ", folded" * drawing.folded
    ax.text(20, 62 - TOP, counts, fontsize=12, color=INK)
    ax.text(20, height - TOP - 10, below, fontsize=10, color=INK, va="bottom")
    contact = any(contact for *_, contact in graph.edges(data="contact"))
    _legend(ax, {kind for _, kind in graph.nodes(data="kind")}, contact=contact)
    save(figure, path)


def _arrow(
    ax: Axes, line: list[tuple[float, float]], lag: int, edge: Mapping[str, Any], *, both: bool
) -> None:
    """Draw an edge along cubic curves."""
    from matplotlib.patches import FancyArrowPatch
    from matplotlib.path import Path

    style: dict[str, Any] = {"arrowstyle": "<|-|>" if both else "-|>", "mutation_scale": 9}
    size = edge["strength"]
    style["lw"] = 1.1 if np.isnan(size) else np.interp(np.log10(max(size, 1e-9)), *WIDTHS)
    style["color"] = CONTACT if edge["contact"] else LAG_1 if lag else LAG_0
    style["ls"] = (0, (4, 2.5)) if lag else "solid"
    path = Path(line, [Path.MOVETO, *[Path.CURVE4] * (len(line) - 1)])
    ax.add_patch(FancyArrowPatch(path=path, shrinkA=0, shrinkB=0, **style))


def _legend(ax: Axes, kinds: set[str], *, contact: bool) -> None:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    handles: list[Any] = [
        Patch(fc=fill, ec=RIM, label=kind)
        for kind, fill in FILLS.items()
        if kind in kinds - {"hub"}
    ]
    handles.append(Line2D([], [], color=LAG_0, label="contemporaneous"))
    handles.append(Line2D([], [], color=LAG_1, ls="--", label="one control step later"))
    if contact:
        label = "later, only where bodies touch"
        handles.append(Line2D([], [], color=CONTACT, ls="--", label=label))
    if "hub" in kinds:
        label = "each arrow in stands for one to every node it points at"
        handles.append(Patch(fc=INK, label=label))
    ax.legend(
        handles=handles, ncol=4, frameon=False, fontsize=10, loc="upper right",
        bbox_to_anchor=(0.995, 0.995),
    )  # fmt: skip

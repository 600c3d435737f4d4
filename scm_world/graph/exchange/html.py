"""A picture of a graph as one HTML file, without any network."""

from __future__ import annotations

from collections.abc import Iterable
from html import escape

from scm_world.graph.exchange.layout import HEAD, PAD, Layout, Place, lay_out
from scm_world.graph.exchange.model import CausalGraph, Node
from scm_world.graph.structure import Edge

FILLS = {
    "exogenous": "#fff1c9",
    "derived": "#d9ecd5",
    "measured": "#d5e5f5",
    "action": "#f7d6d0",
    "fixed": "#e6e6e6",
}
FACTS = ("unit", "value_shape", "bounds", "a", "b", "doc")
WORDS = {"value_shape": "shape", "a": "A", "b": "B", "doc": ""}
MOST = 12  # names in one line of a title
FEW = 1500  # edges: of more than these, only those of the node under the pointer are seen

STYLE = """
body{margin:0;font:13px sans-serif;color:#222;background:#fff}
header{padding:10px 14px 0}header h1{font-size:17px;margin:0 12px 0 0;display:inline}
header i{display:inline-block;width:11px;height:11px;border:1px solid #6b7686;margin:0 4px 0 14px}
svg{display:block}text{font:11px "DejaVu Sans Mono",Menlo,Consolas,monospace;fill:#222}
text.t{font-weight:bold;fill:#4a5568}.b{fill:#5a6b8c;fill-opacity:.07;stroke:#c9ced6}
.n rect{stroke:#6b7686;stroke-width:.7}.n{cursor:pointer}
.e{fill:none;stroke:#5f6b7a;stroke-width:1;opacity:.28}.l{stroke:#9a6fb0;stroke-dasharray:4 2.5}
.many .e{visibility:hidden}.on .e{opacity:.05}.on .n{opacity:.3}
.on .e.in,.on .e.out{visibility:visible;opacity:1;stroke-width:1.7}
.e.in{stroke:#1f6fb4}.e.out{stroke:#d9660a}.on .n.hot{opacity:1}
"""

SCRIPT = """
const svg=document.querySelector("svg"),nodes=[...svg.querySelectorAll(".n")],of=nodes.map(()=>[]);
for(const e of svg.querySelectorAll(".e")){of[e.dataset.c].push(e);
  if(e.dataset.c!==e.dataset.e)of[e.dataset.e].push(e)}
function show(i,on){svg.classList.toggle("on",on);nodes[i].classList.toggle("hot",on);
  for(const e of of[i]){const out=e.dataset.c==i;e.classList.toggle(out?"out":"in",on);
    nodes[out?e.dataset.e:e.dataset.c].classList.toggle("hot",on)}}
nodes.forEach((n,i)=>{n.addEventListener("pointerenter",()=>show(i,true));
  n.addEventListener("pointerleave",()=>show(i,false))});
"""


def to_html(graph: CausalGraph, *, title: str = "Causal graph") -> str:
    """Draw a graph: a box per entity, causes left of effects.

    A node shows its kind, unit, spaces, causes and meaning when the pointer rests on it, and its
    edges: blue into it, orange out of it. Dashed edges take a control step. Of a graph with very
    many edges only these are shown.

    Args:
        graph: Any graph.
        title: What it is.

    Returns:
        One page that needs no other file and no network.

    Example:
        >>> page = to_html(CausalGraph((Node("block.mass", unit="kg"),), ()))
        >>> page.count('class="n"'), "http" in page.replace("http://www.w3.org/2000/svg", "")
        (1, False)
    """
    made = lay_out(graph)
    size = f"{len(graph.nodes)} variables, {len(graph.edges)} edges"
    kinds = [kind for kind in FILLS if any(node.kind == kind for node in graph.nodes)]
    legend = "".join(f'<i style="background:{FILLS[kind]}"></i>{kind}' for kind in kinds)
    return "\n".join(
        [
            '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">',
            f"<title>{escape(title)}</title><style>{STYLE}</style></head><body>",
            f"<header><h1>{escape(title)}</h1>{size} {legend} &nbsp; dashed: one control step "
            "later; point at a variable: <b style='color:#1f6fb4'>causes</b>, "
            "<b style='color:#d9660a'>effects</b></header>",
            _picture(graph, made),
            f"<script>{SCRIPT}</script></body></html>",
        ]
    )


def _picture(graph: CausalGraph, made: Layout) -> str:
    many = ' class="many"' if len(graph.edges) > FEW else ""
    size = f'width="{made.width:.0f}" height="{made.height:.0f}"'
    frame = f'viewBox="0 0 {made.width:.0f} {made.height:.0f}"'
    return "\n".join(
        [
            f'<svg xmlns="http://www.w3.org/2000/svg"{many} {size} {frame}>',
            '<defs><marker id="tip" viewBox="0 0 8 8" refX="7" refY="4" markerWidth="6" '
            'markerHeight="6" markerUnits="userSpaceOnUse" orient="auto">'
            '<path d="M0 0 8 4 0 8z" fill="#5f6b7a"/></marker></defs>',
            *(_box(title, place) for title, place in made.boxes.items()),
            *_edges(graph, made),
            *(_node(graph, made, i, node) for i, node in enumerate(graph.nodes)),
            "</svg>",
        ]
    )


def _rect(place: Place, about: str) -> str:
    corner = f'x="{place.x:.1f}" y="{place.y:.1f}"'
    return f'<rect {corner} width="{place.width:.1f}" height="{place.height:.1f}" rx="4" {about}/>'


def _box(title: str, place: Place) -> str:
    text = f'<text class="t" x="{place.x + PAD:.1f}" y="{place.y + HEAD - 9:.1f}">{escape(title)}'
    return _rect(place, 'class="b"') + text + "</text>"


def _edges(graph: CausalGraph, made: Layout) -> Iterable[str]:
    at = {name: i for i, name in enumerate(graph.names)}
    for edge in graph.edges:
        if edge.cause != edge.effect:
            line = _line(made.nodes[edge.cause], made.nodes[edge.effect])
            kind = "e l" if edge.lag else "e"
            ends = f'data-c="{at[edge.cause]}" data-e="{at[edge.effect]}"'
            yield f'<path class="{kind}" {ends} d="{line}" marker-end="url(#tip)"/>'


def _line(cause: Place, effect: Place) -> str:
    """Lead a curve from a side of one node to a side of the other."""
    if effect.x > cause.right:
        start, end, bend = cause.right, effect.x, max(40.0, (effect.x - cause.right) / 2)
        one, two = start + bend, end - bend
    elif effect.right < cause.x:
        start, end, bend = cause.x, effect.right, max(40.0, (cause.x - effect.right) / 2)
        one, two = start - bend, end + bend
    else:
        start, end = cause.right, effect.right
        one = two = max(start, end) + 24.0 + min(36.0, abs(effect.y - cause.y) / 8)
    points = (start, cause.middle, one, cause.middle, two, effect.middle, end, effect.middle)
    numbers = [f"{number:.0f}" for number in points]
    return f"M{' '.join(numbers[:2])}C{' '.join(numbers[2:])}"


def _node(graph: CausalGraph, made: Layout, number: int, node: Node) -> str:
    place = made.nodes[node.name]
    fill = f'fill="{FILLS.get(node.kind, "#ffffff")}"'
    label = f'<text x="{place.x + PAD:.1f}" y="{place.middle + 4:.1f}">'
    return (
        f'<g class="n" data-i="{number}"><title>{escape(describe(graph, node))}</title>'
        f"{_rect(place, fill)}{label}{escape(made.labels[node.name])}</text></g>"
    )


def describe(graph: CausalGraph, node: Node) -> str:
    """Write down what is known of a node, line by line.

    Example:
        >>> graph = CausalGraph((Node("x", unit="kg"), Node("y")), (Edge("y", "x", 1, "contact"),))
        >>> print(describe(graph, graph.nodes[0]))
        x
        unit: kg
        causes one control step ago: y (contact)
    """
    lines = [node.name, " · ".join(dict.fromkeys(filter(None, (node.kind, node.role))))]
    for fact in FACTS:
        text = getattr(node, fact)
        word = WORDS.get(fact, fact)
        lines.append(f"{word}: {text}" if word and text else text)
    for lag in sorted({edge.lag for edge in graph.parents(node.name)}):
        when = {0: "at once", 1: "one control step ago"}.get(lag, f"{lag} control steps ago")
        lines.append(f"causes {when}: {_causes(graph.parents(node.name), lag)}")
    return "\n".join(filter(None, lines))


def _causes(edges: Iterable[Edge], lag: int) -> str:
    names = [e.cause + (f" ({e.when})" if e.when else "") for e in edges if e.lag == lag]
    more = f" and {len(names) - MOST} more" if len(names) > MOST else ""
    return ", ".join(names[:MOST]) + more

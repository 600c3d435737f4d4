"""Graphs in and out: the formats of other programs, and a picture.

``docs/graphs.md`` says what each format holds. Mechanisms stay here; ``scm_world.graph.to_json``
writes a whole model. Sliced formats know no time: variables get one node per time slice, ``name``
and ``name@-1``, and reading folds them back. A parameter keeps its value, which is an edge from
``name@=-1`` to ``name``; that it is a parameter is read back, too. With ``view="summary"`` lags are
lost; of several conditions on one pair ``"contact or set"`` is left, or none if an edge always
holds.
"""

from scm_world.graph.exchange.formats import (
    FORMATS,
    from_digraph,
    read_graph,
    to_digraph,
    write_graph,
)
from scm_world.graph.exchange.html import to_html
from scm_world.graph.exchange.libraries import (
    TigramiteGraph,
    to_causal_learn,
    to_dowhy,
    to_pgmpy,
    to_tigramite,
)
from scm_world.graph.exchange.model import (
    VIEWS,
    CausalGraph,
    Node,
    Slice,
    View,
    causal_graph,
    read_as,
    seen_as,
    space_lines,
)

__all__ = [
    "FORMATS",
    "VIEWS",
    "CausalGraph",
    "Node",
    "Slice",
    "TigramiteGraph",
    "View",
    "causal_graph",
    "from_digraph",
    "read_as",
    "read_graph",
    "seen_as",
    "space_lines",
    "to_causal_learn",
    "to_digraph",
    "to_dowhy",
    "to_html",
    "to_pgmpy",
    "to_tigramite",
    "write_graph",
]

"""Graphs in and out: the formats of other programs, and a picture.

Mechanisms stay here; ``scm_world.graph.to_json`` writes a whole model.

============  ========  ==============================  ==========================================
format        view      holds                           loses
============  ========  ==============================  ==========================================
dot           lagged    names, lags, ``when``, kind,    nothing that a ``CausalGraph`` has
                        role, unit, bounds, A, B, doc
gml           lagged    the same                        nothing
graphml       lagged    the same                        nothing
node-link     lagged    the same                        nothing
dagitty       sliced    names, lags                     ``when`` and attributes; names with ``"``
                                                        or a backslash are refused
csv           sliced    names, lags                     ``when`` and attributes
tigramite     lagged    names, lags                     ``when`` and attributes
causal-learn  sliced    names, lags                     ``when`` and attributes
pgmpy         sliced    names, lags                     ``when`` and attributes
DoWhy         sliced    names, lags                     ``when`` and attributes
html          lagged    everything, for people          cannot be read back
============  ========  ==============================  ==========================================

Sliced formats know no time: variables get one node per time slice, ``name`` and ``name@-1``, and
reading folds them back. A parameter keeps its value, which is an edge from ``name@=-1`` to
``name``; that it is a parameter is read back, too. With ``view="summary"`` lags are lost as
well, in any format; of several conditions on one pair ``"contact or set"`` is left, or none if an
edge always holds.
"""

from scm_world.graph.exchange.html import to_html
from scm_world.graph.exchange.libraries import (
    TigramiteGraph,
    from_causal_learn,
    from_dowhy,
    from_pgmpy,
    from_tigramite,
    to_causal_learn,
    to_dowhy,
    to_pgmpy,
    to_tigramite,
)
from scm_world.graph.exchange.model import CausalGraph, Node, causal_graph
from scm_world.graph.exchange.networks import from_digraph, to_digraph
from scm_world.graph.exchange.registry import FORMATS, read_graph, write_graph
from scm_world.graph.exchange.slices import VIEWS, Slice, View, read_as, seen_as
from scm_world.graph.exchange.spaces import space_lines

__all__ = [
    "FORMATS",
    "VIEWS",
    "CausalGraph",
    "Node",
    "Slice",
    "TigramiteGraph",
    "View",
    "causal_graph",
    "from_causal_learn",
    "from_digraph",
    "from_dowhy",
    "from_pgmpy",
    "from_tigramite",
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

"""Facts about graphs of models: views through time and d-separation."""

from __future__ import annotations

import networkx as nx
import pytest

from scm_world.graph import SCM, to_dag, unrolled
from scm_world.variables import Derived, Exogenous, Linear, Measured, Normal, Parent


def graph(*edges: str) -> SCM:
    """Build a linear model from edges such as ``"a>b"``; ``"a-1>b"`` has a lag."""
    parents: dict[str, list[Parent]] = {}
    for edge in edges:
        cause, effect = edge.split(">")
        name, _, lag = cause.partition("-")
        parents.setdefault(name, [])
        parents.setdefault(effect, []).append(Parent(name, int(lag or 0)))
    return SCM(
        [
            Derived(name=name, parents=tuple(p), mechanism=Linear(weights=(1.0,) * len(p)))
            if p
            else Exogenous(name=name)
            for name, p in parents.items()
        ]
    )


def separated_by(model: SCM, x: str, y: str, *given: str) -> bool:
    """Return what networkx says of the acyclic graph of a model."""
    return bool(nx.is_d_separator(to_dag(model), {x}, {y}, {*given}))


@pytest.mark.parametrize(
    ("edges", "x", "y", "given", "separated"),
    [
        (("a>b", "b>c"), "a", "c", (), False),
        (("a>b", "b>c"), "a", "c", "b", True),
        (("b>a", "b>c"), "a", "c", (), False),
        (("b>a", "b>c"), "a", "c", "b", True),
        (("a>b", "c>b"), "a", "c", (), True),
        (("a>b", "c>b"), "a", "c", "b", False),
        (("a>b", "c>b", "b>d"), "a", "c", "d", False),
        (("a>b", "c>b", "b>d"), "a", "c", "bd", False),
        # M-bias: adjusting for the collider m opens a path between treatment and outcome.
        (("u>t", "u>m", "v>m", "v>o"), "t", "o", (), True),
        (("u>t", "u>m", "v>m", "v>o"), "t", "o", "m", False),
        (("u>t", "u>m", "v>m", "v>o"), "t", "o", "mv", True),
    ],
)
def test_d_separation_of_known_graphs(
    edges: tuple[str, ...], x: str, y: str, given: str, separated: bool
) -> None:
    """Chains and forks are blocked by their middle, colliders are opened by it."""
    assert separated_by(graph(*edges), x, y, *given) is separated


def test_d_separation_through_time() -> None:
    """Plain names mean now, others the step before."""
    process = graph("x-1>x", "x-1>y", "y-1>y")
    assert not separated_by(process, "x", "y")
    assert separated_by(process, "x", "y", "x@-1", "y@-1")
    assert not separated_by(process, "x@-1", "y", "y@-1")


def test_d_separation_after_do_is_that_of_the_mutilated_graph() -> None:
    """A cut variable no longer carries what its causes say."""
    chain = graph("a>b", "b>c")
    assert not separated_by(chain, "a", "c")
    assert separated_by(chain.do({"b": 1.0}), "a", "c")


def conditional() -> SCM:
    """Build a model with conditions and parallel edges."""
    return SCM(
        [
            Exogenous(name="size", unit="m"),
            Derived(name="half", parents=("size",), mechanism=Linear(weights=(0.5,))),
            Measured(
                name="pose",
                parents=(
                    Parent("pose", 1),
                    Parent("size", 1, "contact"),
                    Parent("size", 0, "set"),
                ),
                settable_state=True,
            ),
            Measured(name="far", parents=("pose",), mechanism=Linear(weights=(1.0,))),
        ]
    )


def test_two_slices_are_a_directed_acyclic_graph() -> None:
    """Edges within an instant appear twice, lagged ones once; parameters persist."""
    view = unrolled(conditional(), 2)
    assert nx.is_directed_acyclic_graph(view)
    assert set(view.edges) == {
        (("size", -1), ("half", -1)),
        (("size", 0), ("half", 0)),
        (("size", -1), ("pose", -1)),
        (("size", 0), ("pose", 0)),
        (("pose", -1), ("far", -1)),
        (("pose", 0), ("far", 0)),
        (("pose", -1), ("pose", 0)),
        (("size", -1), ("pose", 0)),
        (("size", -1), ("size", 0)),
    }
    assert view.edges[("size", -1), ("size", 0)]["persists"]


def test_the_graph_of_an_instant_has_no_lagged_edges() -> None:
    """Only what acts at once is in it; edges that do has cut are not."""
    assert {(c, e) for (c, _), (e, _) in unrolled(conditional(), 1).edges} == {
        ("size", "half"),
        ("size", "pose"),
        ("pose", "far"),
    }
    cut = unrolled(conditional().do({"half": 0.1}), 1)
    assert (("size", 0), ("half", 0)) not in cut.edges


def test_a_common_past_connects_the_previous_slice() -> None:
    """Two variables of the slice before, driven by one cause long ago, are not independent."""
    model = SCM(
        [
            Derived(
                name="a",
                parents=(Parent("a", 1),),
                mechanism=Linear(weights=(0.5,)),
                noise=Normal(),
            ),
            Derived(name="b", parents=(Parent("a", 1),), mechanism=Linear(weights=(1.0,))),
            Derived(name="c", parents=(Parent("a", 1),), mechanism=Linear(weights=(1.0,))),
        ]
    )
    assert not separated_by(model, "b@-1", "c@-1")
    assert separated_by(model, "b", "c", "a@-1")
    assert {slice_ for _, slice_ in unrolled(model, 3)} == {-2, -1, 0}


def test_a_common_past_is_found_however_long_ago_it_was() -> None:
    """Loops of three and of four steps that one cause drives meet again eleven steps ago."""
    loops = [("a0", "a1"), ("a1", "a2"), ("a2", "a0"), ("b0", "b1"), ("b1", "b2"), ("b2", "b3")]
    loops += [("b3", "b0"), ("u", "a0"), ("u", "b3")]
    weights = {name: [c for c, e in loops if e == name] for name in sorted({e for _, e in loops})}
    model = SCM(
        [
            Exogenous(name="u", distribution=Normal(), per="step"),
            *(
                Derived(
                    name=name,
                    parents=tuple(Parent(cause, 1) for cause in causes),
                    mechanism=Linear(weights=(0.9,) * len(causes)),
                )
                for name, causes in weights.items()
            ),
        ]
    )
    apart = [separated_by(model, f"a{i}", f"b{j}") for i in range(3) for j in range(4)]
    assert not any(apart)

"""A kind of intervention and a kind of variable are each one class; the example has one of each."""

from __future__ import annotations

import importlib.util
import json
import sys
from pathlib import Path
from types import ModuleType
from typing import Any, Literal, final

import numpy as np
import pytest
from pydantic import TypeAdapter, ValidationError

import scm_world as sw
from scm_world.cli.options import parse_value
from scm_world.discovery.data import Design, collect
from scm_world.errors import InterventionError, ModelError, NotIntervenable, UnknownOption
from scm_world.graph import from_json, to_json
from scm_world.queries import Plan
from scm_world.variables import (
    Box,
    Categories,
    Distribution,
    Draw,
    Function,
    Hard,
    Intervention,
    Linear,
    Natural,
    Normal,
    Scale,
    Shift,
    Variable,
    bundle,
)

ROOT = Path(__file__).parent.parent.parent
EXAMPLE = ROOT / "examples" / "own_kinds.py"
BACKENDS = ["mujoco", "bullet"]


def _load(name: str) -> ModuleType:
    """Import the example under a name, as a package of the user's would be."""
    spec = importlib.util.spec_from_file_location(name, EXAMPLE)
    assert spec is not None
    assert spec.loader is not None
    module = sys.modules[name] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


example = _load("own_kinds_of_the_documents")
Clip, Backlash, PENDULUM = example.Clip, example.Backlash, example.PENDULUM


def equations() -> sw.SCM:
    """Return ``b = 2 a + noise`` and ``c = b - a``, without time."""
    return sw.SCM(
        [
            sw.Exogenous(name="a", distribution=Normal(), bounds=Box(-9.0, 9.0)),
            sw.Derived(
                name="b", parents=("a",), mechanism=Linear(weights=(2.0,)), noise=Normal(0.0, 0.5)
            ),
            sw.Derived(name="c", parents=("b", "a"), mechanism=Linear(weights=(1.0, -1.0))),
        ]
    )


def moved(parameters: Any, state: Any, action: Any, noise: Any) -> Any:
    """Step a tank with a leak."""
    rate = parameters["leak"] * state["level"]
    return {"level": state["level"] + 0.1 * (action["inflow"] - rate)}


def tank(**options: Any) -> sw.World:
    """Return a world of a step function."""
    return sw.World(
        moved,
        parameters=[sw.Exogenous(name="leak", default=0.5, bounds=Box(0.0, 2.0), a=Box(0.1, 1.0))],
        states=[sw.Measured(name="level", default=1.0, parents=("level", "leak", "inflow"))],
        actions=[sw.Action(name="inflow", bounds=Box(-1.0, 1.0))],
        control_dt=0.1,
        **options,
    )


def pendulum(backend: str = "mujoco", **options: Any) -> sw.World:
    """Return the world of the example."""
    return sw.World(PENDULUM, backend=backend, control_dt=0.05, **options)


def test_the_document_shows_the_example() -> None:
    """The text of the file stands in the document, word for word."""
    assert EXAMPLE.read_text() in (ROOT / "docs" / "extending.md").read_text()


# --- a kind of intervention -----------------------------------------------------------------------


def test_it_acts_on_a_draw_and_on_a_mechanism() -> None:
    """It limits what nature draws, or what a function gives, and the effects follow."""
    model = equations()
    was = model.draw(50, seed=3)
    over_a = model.do({"a": Clip(-0.5, 0.5)}).draw(50, seed=3)
    a = np.clip(was["a"], -0.5, 0.5)
    assert (over_a["a"] == a).all()
    assert over_a["b"] == pytest.approx(was["b"] + 2.0 * (a - was["a"]))
    over_b = model.do({"b": Clip(0.0, 1.0)}).draw(50, seed=3)
    assert (over_b["a"] == was["a"]).all()
    assert (over_b["b"] == np.clip(was["b"], 0.0, 1.0)).all()
    assert over_b["c"] == pytest.approx(np.clip(was["b"], 0.0, 1.0) - was["a"])
    assert model.do({"b": Clip(0.0, 1.0)}).parents("b") == ("a",)


def test_layers_compose_with_it() -> None:
    """It acts on a context, and another intervention on it as context."""
    model = equations()
    given = model.given({"a": Draw(Box(0.0, 4.0))})
    drawn = given.draw(50, seed=1)["a"]
    assert (given.do({"a": Clip(1.0, 2.0)}).draw(50, seed=1)["a"] == np.clip(drawn, 1, 2)).all()
    limited = model.given({"a": Clip(-0.5, 0.5)}).do({"a": Shift(1.0)}).draw(50, seed=1)["a"]
    assert (limited == np.clip(model.draw(50, seed=1)["a"], -0.5, 0.5) + 1.0).all()
    fixed = model.given({"a": Hard(3.0)}).do({"a": Clip(-0.5, 0.5)})
    assert float(fixed.solve()["a"]) == 0.5
    assert fixed["a"].is_constant
    assert fixed.do({"a": Natural()}).solve()["a"] == 3.0


def test_it_is_divided_among_the_parts_of_a_bundle() -> None:
    """Each part is limited."""
    parts = [sw.Exogenous(name=name, distribution=Normal()) for name in "xy"]
    model = sw.SCM([*parts, bundle("both", parts)])
    was, now = model.draw(20, seed=0), model.do({"both": Clip(0.0, 0.5)}).draw(20, seed=0)
    assert (now["both"] == np.clip(was["both"], 0.0, 0.5)).all()


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_world_takes_it(backend: str) -> None:
    """Of a parameter that nature drew, of a state, and with undoing."""
    if backend == "bullet":
        pytest.importorskip("pybullet")
    world = pendulum(backend).given({"pole.mass": Draw(Box(0.05, 0.2))})
    world.reset(seed=1)
    mass = float(world["pole.mass"])
    assert mass > 0.07
    audit = world.do({"pole.mass": Clip(0.06, 0.07), "hinge.position": 0.3})
    assert float(world["pole.mass"]) == 0.07
    assert audit.targets["pole.mass"].requested == Clip(0.06, 0.07)
    world.step(np.zeros(1))
    world.do({"pole.mass": Natural()})
    assert float(world["pole.mass"]) == mass
    before = float(world["hinge.position"])
    world.do({"hinge.position": Clip(0.0, 0.1)})
    assert before > 0.1
    assert float(world["hinge.position"]) == 0.1


def test_many_worlds_take_it() -> None:
    """Each limits its own draw, as it does alone, in one call."""
    worlds = pendulum(num_worlds=4, start={"pole.mass": Box(0.05, 0.2)})
    worlds.reset(seed=1)
    was = worlds["pole.mass"].copy()
    assert len(set(was.ravel().tolist())) == 4
    worlds.do({"pole.mass": Clip(0.08, 0.12)})
    assert (worlds["pole.mass"] == np.clip(was, 0.08, 0.12)).all()
    assert (worlds["pole.mass"] != was).any()


def polar(place: Any) -> Any:
    """Return radius and angle."""
    return np.stack(
        [np.hypot(place[..., 0], place[..., 1]), np.arctan2(place[..., 1], place[..., 0])], -1
    )


def cartesian(found: Any) -> Any:
    """Return the place at a radius and an angle."""
    return found[..., :1] * np.stack([np.cos(found[..., 1]), np.sin(found[..., 1])], -1)


def test_coordinates_of_a_quantity_take_it() -> None:
    """It limits the numbers of the coordinates that are named; the quantity follows."""
    model = sw.SCM(
        [
            sw.Exogenous(name="place", shape=(2,), default=(3.0, 4.0)),
            sw.Derived(
                name="polar", shape=(2,), parents=("place",), mechanism=polar, inverse=cartesian
            ),
        ]
    )
    values = model.do({"polar": Clip(-1.0, 2.5)}).solve()
    assert values["place"] == pytest.approx([1.5, 2.0])
    assert (model.do({"polar": Clip(-9.0, 9.0)}).solve()["place"] == [3.0, 4.0]).all()


def test_a_step_function_takes_it_in_a_plan() -> None:
    """An action is limited within a window: the trajectory is that of the limited actions."""
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, (10, 1))
    limited = actions.copy()
    limited[2:6] = np.clip(limited[2:6], -0.2, 0.2)
    done = tank().rollout(actions, steps=10, do={"inflow": Clip(-0.2, 0.2, during=(2, 6))})
    direct = tank().rollout(limited, steps=10)
    assert (done["level"] == direct["level"]).all()
    later = (
        tank().rollout(actions, steps=10).counterfactual({"inflow": Clip(-0.2, 0.2, during=(2, 6))})
    )
    assert (later["level"] == direct["level"]).all()


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_window_of_a_parameter_ends(backend: str) -> None:
    """Before and after the window the mass is what nature drew."""
    if backend == "bullet":
        pytest.importorskip("pybullet")
    nature = {"pole.mass": Draw(Box(0.05, 0.2))}
    do = {"pole.mass": Clip(0.06, 0.07, during=(2, 4))}
    episode = pendulum(backend).given(nature).rollout(None, steps=6, seed=1, do=do)
    plain = pendulum(backend).given(nature).rollout(None, steps=6, seed=1)
    mass = plain["pole.mass"].ravel()
    wanted = mass.copy()
    wanted[2:4] = np.clip(mass[2:4], 0.06, 0.07)
    assert episode["pole.mass"].ravel().tolist() == wanted.tolist()
    assert wanted[3] != mass[3]


def test_its_effect_is_that_of_the_limited_values() -> None:
    """Paired units of equations: the mean difference follows from the drawn values."""
    world = sw.World(equations())
    found = world.effect("b", do={"a": Clip(-0.5, 0.5)}, n=40, seed=2)
    a = np.array([world.sample(n=40, seed=2)["a"]]).ravel()
    assert found.mean == pytest.approx(2.0 * (np.clip(a, -0.5, 0.5) - a).mean())


def test_tables_have_it() -> None:
    """Rows under it are limited, and its target still follows its causes."""
    design = Design("single", ("b",), values=Clip(0.0, 1.0), observational_fraction=0.5)
    table = collect(equations(), design, 40, seed=0)
    acted = table.targeted.any(axis=1)
    assert 0 < acted.sum() < 40
    values = table["b"].ravel()
    assert ((values[acted] >= 0.0) & (values[acted] <= 1.0)).all()
    assert not ((values[~acted] >= 0.0) & (values[~acted] <= 1.0)).all()
    softly = {name for regime in table.regimes for name in regime.softly}
    assert softly == {"b"}


def test_files_keep_it() -> None:
    """A plan, a model and an intervention are equal after a JSON round trip."""
    act = Clip(0.5, 1.5, at=3)
    adapter: TypeAdapter[Any] = TypeAdapter(Intervention)
    again = adapter.validate_json(adapter.dump_json(act))
    assert again == act
    assert type(again) is Clip
    plan = Plan({"a": (act, Hard(1.0, at=5))})
    assert Plan.from_json(plan.to_json()) == plan
    model = equations().given({"a": Scale(2.0)}).do({"b": Clip(0.0, 1.0)})
    read = from_json(to_json(model))
    assert read == model
    assert (read.draw(5, seed=0)["b"] == model.draw(5, seed=0)["b"]).all()


def test_commands_read_it() -> None:
    """A text names the kind; those of the package have spellings of their own."""
    assert parse_value("clip:0.1,0.5") == Clip(0.1, 0.5)
    assert parse_value("natural:0.1") == "natural:0.1"


def test_a_kind_that_is_not_known_is_refused_by_name() -> None:
    """A file with it says which kinds there are."""
    data = json.loads(Plan({"a": Clip(0.0, 1.0)}).to_json().replace('"clip"', '"clap"'))
    with pytest.raises(ModelError, match="the kind 'clap' is not known; import the module"):
        Plan.from_dict(data)
    with pytest.raises(ValidationError, match="there are 'exogenous', "):
        TypeAdapter(Variable).validate_python({"name": "a"})


def test_two_classes_of_one_kind_are_refused() -> None:
    """Else a file would mean either of them."""
    with pytest.raises(ModelError, match="Mine: Clip has the kind 'clip' already"):

        class Mine(Intervention):
            kind: Literal["clip"] = "clip"

    assert Intervention.kinds["clip"] is Clip


def test_what_does_not_fit_is_refused() -> None:
    """A time needs a plan; a unit that was observed under it does not tell its own value."""
    with pytest.raises(InterventionError, match="in the plan of an episode"):
        equations().do({"a": Clip(0.0, 1.0, at=2)})
    colour = sw.Exogenous(name="c", dtype="categorical", bounds=Categories((0, 1)))
    with pytest.raises(InterventionError, match="categories have no order"):
        sw.SCM([colour]).do({"c": Clip(0.0, 1.0)})
    seen = {"a": 0.5, "b": 1.0, "c": 0.5}
    with pytest.raises(ModelError, match="leave it out, or give NaN"):
        equations().do({"a": Clip(-0.5, 0.5)}).counterfactual(seen, do={"b": 0.0})
    found = equations().counterfactual({"a": 2.0, "b": 5.0, "c": 3.0}, do={"a": Clip(-0.5, 0.5)})
    assert found["b"] == pytest.approx(2.0)  # 2 · 0.5 and its own noise, 1


# --- a kind of intervention that replaces ---------------------------------------------------------


def doubled(other: Any) -> Any:
    """Return twice a value."""
    return 2.0 * other


@final
class Twice(Intervention):
    """Follow another variable, twice as much."""

    kind: Literal["twice"] = "twice"
    other: str

    def follows(self, variable: Variable) -> tuple[sw.Parent, ...]:
        """Return the other variable."""
        return (sw.Parent(self.other),)

    @property
    def equation(self) -> Function:
        """Return the function."""
        return Function(doubled)


def test_one_that_replaces_a_mechanism_has_edges() -> None:
    """It cuts the causes and adds its own; unknown ones and cycles are refused."""
    model = equations().do({"b": Twice(other="a")})
    assert model.parents("b") == ("a",)
    values = model.draw(9, seed=0)
    assert (values["b"] == 2.0 * values["a"]).all()
    with pytest.raises(InterventionError, match="cycle"):
        equations().do({"a": Twice(other="c")})
    with pytest.raises(InterventionError, match="no variable is named 'd'"):
        equations().do({"a": Twice(other="d")})
    with pytest.raises(InterventionError, match="cannot follow itself"):
        equations().do({"a": Twice(other="a")})
    world = pendulum()
    world.reset(seed=0)
    world.do({"hinge.damping": Twice(other="pole.mass")})
    world.do({"pole.mass": 0.3})
    assert float(world["hinge.damping"]) == 0.6
    assert from_json(to_json(model)) == model


# --- a kind of variable ---------------------------------------------------------------------------


def hysteresis(drive: Any, width: float, start: float = 0.0) -> np.ndarray:
    """Compute the output of a gear with play, by hand."""
    found, now = [], start
    for value in np.ravel(drive):
        now = min(max(now, value - width / 2), value + width / 2)
        found.append(now)
    return np.array(found)


def test_equations_compute_it() -> None:
    """Each unit follows its own input, and an intervention on the input is felt later."""
    model = sw.SCM(
        [
            sw.Exogenous(name="drive", distribution=Normal(), per="step"),
            Backlash(name="gear", drive="drive", width=1.0),
        ]
    )
    assert {(edge.cause, edge.lag) for edge in model.edges} == {("drive", 0), ("gear", 1)}
    values = model.draw(4, seed=0, steps=12)
    first = model.draw(4, seed=0, steps=1)
    assert (values["gear"][:, 0] == first["gear"][:, 0]).all()
    for drive, gear in zip(values["drive"], values["gear"], strict=True):
        assert gear[1:] == pytest.approx(hysteresis(drive[1:], 1.0, gear[0]))
    held = model.do({"gear": 0.25}).draw(2, seed=0, steps=3)
    assert (held["gear"] == 0.25).all()
    assert from_json(to_json(model)) == model


def test_rows_of_equations_have_both() -> None:
    """Several worlds without an engine have the values of the draws, step by step."""
    model = sw.SCM(
        [
            sw.Exogenous(name="drive", distribution=Normal(), per="step"),
            Backlash(name="gear", drive="drive", width=1.0),
        ]
    ).do({"drive": Clip(-1.0, 1.0)})
    worlds = sw.World(model, num_worlds=3)
    worlds.reset(seed=[5, 6, 7])
    alone = [model.draw(1, seed=seed, steps=4) for seed in (5, 6, 7)]
    wanted = {name: np.concatenate([one[name] for one in alone]) for name in model}
    assert np.abs(wanted["drive"]).max() == 1.0
    for step in range(4):
        worlds.step(np.zeros((3, 0)))
        for name in ("drive", "gear"):
            assert (worlds[name] == wanted[name][:, step]).all()


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_world_computes_it(backend: str) -> None:
    """In each control step from the state there; two worlds alike, and after a snapshot."""
    if backend == "bullet":
        pytest.importorskip("pybullet")
    gear = Backlash(name="gear", drive="hinge.position", width=0.2)
    world = pendulum(backend, outcomes=[gear])
    episode = world.rollout("random", steps=20, seed=1)
    drive = episode["hinge.position"].ravel()
    assert np.abs(drive).max() > 0.1
    assert episode["gear"].ravel() == pytest.approx(hysteresis(drive, 0.2))
    world.reset(seed=1)
    with pytest.raises(NotIntervenable, match=r"computed in every step; .*: hinge\.position$"):
        world.do({"gear": 0.1})
    for _ in range(5):
        world.step(np.ones(1))
    saved, known = world.snapshot(), []
    for _ in range(2):
        world.restore(saved)
        for _ in range(5):
            world.step(-np.ones(1))
        known.append(float(world["gear"]))
    assert known[0] == known[1]
    several = pendulum(backend, outcomes=[gear], num_worlds=2)
    several.reset(seed=1)
    for command in (*(1.0,) * 5, *(-1.0,) * 5):
        several.step(np.full((2, 1), command))
    assert several["gear"].tolist()[0] == known[0]


def test_a_step_function_has_it_as_outcome() -> None:
    """It follows the state of the function, and is part of the graph."""
    world = tank(outcomes=[Backlash(name="gauge", drive="level", width=0.1)])
    episode = world.rollout("random", steps=15, seed=0)
    level = episode["level"].ravel()
    assert episode["gauge"].ravel() == pytest.approx(
        hysteresis(level, 0.1, float(episode["gauge"].ravel()[0]))
    )
    assert set(world.model.parents("gauge")) == {"level", "gauge"}


def test_a_kind_without_a_function_is_no_outcome() -> None:
    """The error says what is wanted."""
    with pytest.raises(UnknownOption, match="outcomes"):
        tank(outcomes=[sw.Exogenous(name="x")])


@final
class Drift(Variable):
    """A number that returns to zero, and is pushed at random: an AR(1) process."""

    kind: Literal["drift"] = "drift"
    keeps: float
    std: float

    @property
    def all_parents(self) -> tuple[sw.Parent, ...]:
        """Return itself, one control step ago."""
        return (sw.Parent(self.name, 1),)

    @property
    def equation(self) -> Linear:
        """Return what is kept."""
        return Linear(weights=(self.keeps,))

    @property
    def own_noise(self) -> Distribution:
        """Return the distribution of the pushes."""
        return Normal(0.0, self.std)

    @property
    def noise_inverse(self) -> Literal["additive"]:
        """Return how the push follows from the next value."""
        return "additive"


def test_one_with_noise_is_drawn_and_abducted() -> None:
    """Its noise is that of its name, and a counterfactual keeps it."""
    model = sw.SCM(
        [
            Drift(name="wind", keeps=0.5, std=2.0),
            sw.Derived(name="speed", parents=("wind",), mechanism=Linear(weights=(3.0,))),
        ]
    )
    seen = model.draw(3, seed=0, steps=6)
    pushes = seen["wind"][:, 1:] - 0.5 * seen["wind"][:, :-1]
    usual = sw.SCM(
        [
            sw.Derived(
                name="wind",
                parents=(sw.Parent("wind", 1),),
                mechanism=Linear(weights=(0.5,)),
                noise=Normal(0.0, 2.0),
            )
        ]
    )
    assert (usual.draw(3, seed=0, steps=6)["wind"] == seen["wind"]).all()
    found = model.counterfactual(seen, do={"wind": Hard(1.0, during=(2, 3))})
    wind = seen["wind"].copy()
    wind[:, 2] = 1.0
    for step in range(3, 6):
        wind[:, step] = 0.5 * wind[:, step - 1] + pushes[:, step - 1]
    assert found["wind"] == pytest.approx(wind)
    assert found["speed"] == pytest.approx(3.0 * wind)

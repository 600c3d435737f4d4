"""Facts about protocols of one's own: one line makes them, and what is wrong is refused."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest

from scm_world.curricula import resample, stages, timed, together
from scm_world.env import ScmWorldEnv
from scm_world.errors import EvaluationError, ModelError, ScmWorldError, UnknownOption
from scm_world.evaluation import Protocol, evaluate, protocols_of
from scm_world.evaluation.episodes import Hook, scored_episode, under
from scm_world.evaluation.protocols import ROLES, ROWS, chosen
from scm_world.policies.agents import as_agent
from scm_world.tasks import TASKS
from scm_world.variables import Box, Mechanism, Normal, Subset

T = "tool_block"


def test_one_line_makes_a_protocol() -> None:
    """With a pattern, a box, a subset, a distribution, or whatever a curriculum can do."""
    mass = f"{T}.mass"
    mine = [
        Protocol("pattern", "*block.mass", "B"),
        Protocol("box", mass, Box(0.05, 0.06)),
        Protocol(
            "subset", [mass, "floor_friction"], Subset({mass: Box(0.02, 0.03), "floor_*": "B"})
        ),
        Protocol("normal", mass, Normal(0.05, 0.001)),
        Protocol("part", act=together({"floor_friction": 0.7}, resample(mass, "A"))),
        Protocol("fixed", act={T: {"mass": 0.03}}),
    ]
    here = ScmWorldEnv(backend="fake")
    found = {}
    for protocol in mine:
        under(here, protocol).reset(seed=0)
        found[protocol.name] = here.world.values()
    assert 0.045 < found["pattern"][mass] <= 0.1
    assert 0.05 <= found["box"][mass] <= 0.06
    assert 0.02 <= found["subset"][mass] <= 0.03
    assert 0.6 < found["subset"]["floor_friction"] <= 0.8
    assert 0.04 < found["normal"][mass] < 0.06
    assert found["part"]["floor_friction"] == 0.7
    assert found["fixed"][mass] == 0.03
    assert all(Protocol.from_dict(json.loads(json.dumps(p.as_dict()))) == p for p in mine)


class Masses(Hook):
    """Keeps the mass of the block at every instant."""

    def begin(self, env: ScmWorldEnv, observation: Any) -> None:
        """See the reset."""
        self.env, self.seen = env, [float(env.world[f"{T}.mass"])]

    def after(self, observation: Any, reward: float, info: Any) -> bool:
        """See a control step."""
        self.seen.append(float(self.env.world[f"{T}.mass"]))
        return False


def test_within_the_episode_it_acts_at_its_step() -> None:
    """``P2@3`` changes the mass after three control steps, in every episode, and not before."""
    here = ScmWorldEnv(backend="fake", max_episode_length=6)
    (late,) = chosen("P2@3", protocols_of("pushing"))
    for episode in range(3):
        masses = Masses()
        row = scored_episode(
            here,
            as_agent("still"),
            late,
            seed=0,
            episode=episode,
            hooks=[masses],
        )
        assert masses.seen[:3] == [0.02] * 3
        assert masses.seen[3:] == [row[f"drawn {T}.mass"]] * 4
        assert masses.seen[3] > 0.045


def test_names_and_patterns_choose() -> None:
    """Names with commas, patterns, protocols, and mixtures of them."""
    known = protocols_of("pushing")
    assert [p.name for p in chosen("P1*", known)] == ["P1", "P10", "P11"]
    own = Protocol("mine", "*.mass")
    assert [p.name for p in chosen(["P0", own, "P[45]@2"], known)] == ["P0", "mine", "P4@2", "P5@2"]
    assert chosen(own, known) == (own,)
    assert chosen(None, known) == known
    assert len(ROWS) == 12
    assert set(ROLES) == set(TASKS)


def by_function(**parents: Any) -> float:
    """Stand for a function of a user's."""
    return 0.05


BAD: list[tuple[Any, str]] = [
    ("P13", "protocol"),
    ("", "protocol"),
    ([], "protocols"),
    ("P1,P1", "'P1' once"),
    ("P1@", "P1@100"),
    ("P1@-3", "P1@100"),
    ("P1@²", "P1@100"),
    ([Protocol("P1", "*.mass"), "P1"], "'P1' once"),
    ([3], "3"),
    (Protocol("mine", "tool_blok.mass"), "protocol mine.*did you mean 'tool_block.mass'"),
    (Protocol("mine", "*.weight"), r"protocol mine.*\*\.weight"),
    (Protocol("mine", "@nothing"), "protocol mine.*@everything"),
    (Protocol("mine", f"{T}.mass", Box(-1.0, 0.5)), f"protocol mine.*{T}.mass"),
    (Protocol("mine", "floor_friction", Box(0.1, 50.0)), "protocol mine.*floor_friction"),
    (Protocol("mine", f"{T}.mass", Box([0.1] * 2, [0.2] * 2)), f"protocol mine.*{T}.mass"),
    (Protocol("mine", f"{T}.linear_velocity"), f"protocol mine.*{T}.linear_velocity"),
    (Protocol("mine", "*.mass", Subset({"tool_blok.mass": "A"})), "protocol mine.*tool_blok"),
    (Protocol("mine", act={f"{T}.mass": -1.0}), f"protocol mine.*{T}.mass"),
    (Protocol("mine", act={f"{T}.speed": 1.0}), f"protocol mine.*{T}.speed"),
    (Protocol("mine", act=stages({}, {f"{T}.mass": 0.05})), "protocol mine.*stages"),
    (Protocol("mine", "*.mass").at(40), "step of protocol mine@40"),
    (
        Protocol("mine", act={f"{T}.cartesian_position": [0.0, 0.0, 0.01]}),
        "protocol mine.*episode 0",
    ),
    (
        Protocol("mine", act={f"{T}.mass": Mechanism(lambda: 0.05, parents=())}),
        "cannot be found|top level",
    ),
]


@pytest.mark.parametrize(("protocols", "said"), BAD, ids=lambda value: repr(value)[:40])
def test_bad_protocols_are_refused_before_any_episode(
    protocols: Any, said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The error names the protocol and the variable; no episode has been played."""

    def play(*_: Any, **__: Any) -> None:
        pytest.fail("an episode was played")

    monkeypatch.setattr("scm_world.evaluation.pipeline.scored_episode", play)
    with pytest.raises(ScmWorldError, match=said):
        evaluate("still", protocols, n=2, backend="fake", env={"max_episode_length": 40})


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("a/b",), "name of a protocol"),
        (("",), "name of a protocol"),
        ((3,), "name of a protocol"),
        (("a,b",), "name of a protocol"),
        (("a\nb",), "name of a protocol"),
        ((" a",), "name of a protocol"),
        (("a", 5), "varies of protocol a"),
        (("a", ["x", 5]), r"Protocol\.varies"),
        (("a", "x", "C"), "space of protocol a"),
        (("a", "x", [0.1, 0.2]), "space of protocol a"),
        (("a", "x", np.array([0.1, 0.2])), "space of protocol a"),
    ],
)
def test_what_is_no_protocol_is_refused(arguments: Any, said: str) -> None:
    """Names that cannot stand in files and lists, and what is no name and no space."""
    with pytest.raises((UnknownOption, ModelError), match=said):
        Protocol(*arguments)


@pytest.mark.parametrize("step", [-1, 1.5, "3", True])
def test_steps_are_whole_numbers(step: Any) -> None:
    """Neither fractions nor negative numbers nor words."""
    with pytest.raises(UnknownOption, match="step"):
        Protocol("a", "*.mass", step=step)
    with pytest.raises(UnknownOption, match="step"):
        Protocol("a", "*.mass").at(step)


def test_two_ways_to_say_what_is_done_exclude_one_another() -> None:
    """Either variables and a space, or a part of a curriculum."""
    with pytest.raises(UnknownOption, match="beside act"):
        Protocol("a", "*.mass", act={"floor_friction": 0.4})


@pytest.mark.parametrize(
    "data",
    [
        None,
        [],
        {},
        {"format": "scm_world/protocol/2"},
        {"format": "scm_world/protocol/1"},
        {"format": "scm_world/protocol/1", "name": 3},
        {"format": "scm_world/protocol/1", "name": "a", "space": "C"},
        {"format": "scm_world/protocol/1", "name": "a", "space": {"kind": "ball"}},
        {"format": "scm_world/protocol/1", "name": "a", "act": {"kind": "explode"}},
        {"format": "scm_world/protocol/1", "name": "a", "unknown": 1},
    ],
)
def test_what_is_no_protocol_is_not_read(data: Any) -> None:
    """The error is one of this package, and says that it is no protocol."""
    with pytest.raises(ModelError, match="not a protocol"):
        Protocol.from_dict(data)


def test_functions_in_files_have_to_be_trusted() -> None:
    """A file cannot make a program call what its reader does not know."""
    given = Protocol("a", act={f"{T}.mass": Mechanism(by_function, parents=())})
    data = given.as_dict()
    with pytest.raises(ModelError, match=r"by_function.*trusted"):
        Protocol.from_dict(data)
    assert Protocol.from_dict(data, trusted=(by_function.__module__,)) == given


def test_d11_every_step_of_an_episode_can_be_acted_at() -> None:
    """The control step counts, not the episode: a part that acts every second step does."""
    here = ScmWorldEnv(backend="fake", max_episode_length=6)
    often = Protocol("often", act=timed({"every": 2, "at": 2}, resample("floor_friction", "B")))
    for episode in range(3):
        scored_episode(here, as_agent("still"), often, seed=0, episode=episode)
        assert [step for step, _ in here.interventions] == [2, 4]


def test_refusals_within_an_episode_name_the_step() -> None:
    """Agent, engine, protocol, seed, episode and control step."""
    under = Protocol("under", act={f"{T}.cartesian_position": [0.0, 0.0, 0.01]}, step=2)
    with pytest.raises(EvaluationError, match=T) as caught:
        evaluate("still", under, n=1, seeds=5, backend="fake", env={"max_episode_length": 4})
    assert caught.value.place == {
        "agent": "still",
        "run": 0,
        "engine": "fake",
        "protocol": "under",
        "seed": 5,
        "episode": 0,
        "control step": 2,
    }

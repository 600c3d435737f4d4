"""Facts about laboratories: certified questions, tools that refuse, scores and replays."""

from __future__ import annotations

import base64
import json
import subprocess
import sys
import zlib
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
import pytest

from scm_world import lab
from scm_world.errors import ScmWorldError
from scm_world.lab import worlds
from scm_world.lab.agents import DESIGNS, ROUNDS, _confounded, _Known, _Seen
from scm_world.lab.expressions import evaluate
from scm_world.lab.questions import LevelView, build


def test_a_question_is_answered_by_the_solver_and_by_no_trivial_answer() -> None:
    """The certificate is repeated by the same tools at another level."""
    asked = lab.question("effect", "equations", seed=3, level="L4")
    assert asked.certificate is not None
    assert asked.certificate["solver"] >= 0.95 > 0.2 >= max(asked.certificate["trivial"].values())
    room = lab.play("ideal", asked)
    assert room.score is not None
    assert room.score["score"] >= 0.95
    assert lab.Question.of(asked.spec).digest == asked.digest


HOSTILE: tuple[tuple[str, Any], ...] = (
    ("observe", {"n": 0}),
    ("observe", {"n": -5}),
    ("observe", {"n": 10**9}),
    ("observe", {"n": 2.5}),
    ("observe", {"n": "all"}),
    ("observe", {"n": True}),
    ("observe", {"n": None}),
    ("observe", {"m": 3}),
    ("observe", [3]),
    ("experiment", {}),
    ("experiment", {"do": {}}),
    ("experiment", {"do": None}),
    ("experiment", {"do": "x0 = 1"}),
    ("experiment", {"do": {"no_such": 1.0}}),
    ("experiment", {"do": {"x0": float("nan")}}),
    ("experiment", {"do": {"x0": float("inf")}}),
    ("experiment", {"do": {"x0": 1e300}}),
    ("experiment", {"do": {"x0": "1"}}),
    ("experiment", {"do": {"x0": True}}),
    ("experiment", {"do": {"x0": None}}),
    ("experiment", {"do": {"x0": [1.0, 0.0]}}),
    ("experiment", {"do": {"x0": [0.0, 0.5, 1.0]}}),
    ("experiment", {"do": {"x0": []}}),
    ("experiment", {"do": {"x0": {"a": 1}}}),
    ("experiment", {"do": {"h0": 1.0}}),
    ("experiment", {"do": {"x0": 1.0}, "n": -1}),
    ("experiment", {"do": {"x0": 1.0}, "n": 100_000}),
    ("experiment", {"do": {"x0": 1.0}, "at": -1}),
    ("experiment", {"do": {"x0": 1.0}, "at": 10**6}),
    ("experiment", {"do": {"x0": 1.0}, "seed": 1}),
    ("submit", {}),
    ("submit", {"answer": "__import__('os').getcwd()"}),
    ("submit", {"answer": "__import__('os').system('true')", "confidence": 0.5}),
    ("submit", {"answer": "9**9**9", "confidence": 0.5}),
    ("submit", {"answer": "x0.__class__", "confidence": 0.5}),
    ("submit", {"answer": "(" * 500 + ")" * 500, "confidence": 0.5}),
    ("submit", {"answer": "1", "confidence": 1.5}),
    ("submit", {"answer": "1", "confidence": float("nan")}),
    ("submit", {"answer": 1.0, "confidence": 0.5}),
    ("submit", {"answer": ["1"] * 10**5, "confidence": 0.5}),
    ("look", {"episode": 0}),
    ("note", {"text": "x" * 10**6}),
    ("note", {"text": 3}),
    ("__init__", {"question": None}),
    ("_run", {"do": {}, "at": 0, "n": 1}),
    ("save", {"path": "anything"}),
    ("no_such_tool", {}),
)


@pytest.fixture(scope="module")
def law() -> lab.Question:
    """A question about a law of equations."""
    return lab.question("law", "equations", seed=1)


def test_hostile_calls_cost_and_change_nothing(law: lab.Question) -> None:
    """Each is refused with a reason; afterwards the run is that of a new laboratory."""
    room, fresh = lab.Laboratory(law), lab.Laboratory(law)
    for tool, arguments in HOSTILE:
        said = room.call(tool, arguments)
        assert [*said] == ["refused"], (tool, arguments)
        assert said["refused"]
    assert (room.spent, room.calls, room.score) == (0, [], None)
    assert room.observe(3) == fresh.observe(3)


def test_calls_of_many_threads_do_not_spend_more_than_the_budget(law: lab.Question) -> None:
    """Of many calls at once as many are answered as the budget has."""
    from concurrent.futures import ThreadPoolExecutor

    room = lab.Laboratory(law)
    with ThreadPoolExecutor(8) as pool:
        said = [*pool.map(lambda _: room.call("observe", {"n": 150}), range(20))]
    answered = sum("columns" in one for one in said)
    assert answered == law.budget // 150
    assert room.spent == 150 * answered


@pytest.mark.parametrize(
    "text",
    [
        "__import__('os')",
        "9**9**9",
        "x.real",
        "[x]",
        "x if x else 1",
        "lambda: 1",
        "x**y",
        "f(x)",
        "'a'",
        "True",
        "x == 1",
        "sin()",
        "sin(x, x)",
        "exp(x=1)",
        "x" + "+x" * 400,
        "",
        "x;x",
    ],
)
def test_expressions_are_arithmetic_only(text: str) -> None:
    """Everything else is refused."""
    with pytest.raises(ScmWorldError):
        evaluate(text, {"x": [1.0]})


def test_expressions_have_the_values_of_python() -> None:
    """Also with names that have dots."""
    x = np.array([0.5, 2.0])
    found = evaluate("2 * a.b ** 3 - max(a.b, 1) / exp(-a.b)", {"a.b": x})
    np.testing.assert_allclose(found, 2 * x**3 - np.maximum(x, 1.0) / np.exp(-x))


def test_a_saved_run_is_repeated_to_the_bit_and_a_changed_one_is_found(
    law: lab.Question, tmp_path: Path
) -> None:
    """A replay says which call differs."""
    path = lab.play("ideal", law).save(tmp_path / "run.json")
    assert lab.replay(path) == []
    run = json.loads(path.read_text())
    run["calls"][1]["result"]["remaining"] += 1
    path.write_text(json.dumps(run))
    assert lab.replay(path)[0].startswith("call 1")


class Tools:
    """The tools of a laboratory, and nothing else of it but what is left of the budget."""

    def __init__(self, room: lab.Laboratory) -> None:
        self._room = room

    def __getattr__(self, name: str) -> Any:
        assert name in ("describe", "observe", "experiment", "submit", "remaining"), name
        return getattr(self._room, name)


@pytest.mark.parametrize(
    ("agent", "kind"),
    [*zip(DESIGNS, ("graph", "control", "law", "graph", "prediction"), strict=True)],
)
def test_agents_need_the_tools_only(agent: str, kind: str) -> None:
    """Through other hands each does the same; it spends the budget."""
    asked = build(kind, "equations", 1, "L2", lab.Knobs(), 0, None)
    room = lab.Laboratory(asked)
    lab.AGENTS[agent](Tools(room))  # type: ignore[arg-type]
    assert room.record() == lab.play(agent, asked).record()
    assert room.remaining == 0


@pytest.mark.parametrize("agent", DESIGNS)
def test_agents_answer_where_selection_keeps_no_observation(agent: str) -> None:
    """The first experiment of a small budget may have no row."""

    class Blind(Tools):
        def observe(self, n: int) -> dict[str, Any]:
            found = self._room.observe(n)
            return {**found, "columns": {name: [] for name in found["columns"]}}

    room = lab.Laboratory(build("effect", "springs", 1, "L2", lab.Knobs(), 0, None))
    lab.AGENTS[agent](Blind(room))  # type: ignore[arg-type]
    assert room.finished


def test_the_information_that_a_question_asks_for_is_about_its_cause() -> None:
    """Greedy information sets the cause much more often than chance, and then in one experiment."""
    asked = build("effect", "equations", 3, "L2", lab.Knobs(), 0, None)
    shares = {}
    for agent in ("random", "information"):
        sets = [one["arguments"].get("do", {}) for one in lab.play(agent, asked).calls]
        shares[agent] = sum(asked.query["cause"] in do for do in sets) / ROUNDS
    assert shares["information"] > 0.8 > 0.4 > shares["random"]


@pytest.mark.parametrize("names", [("a",), ("b",), ("a", "b")])
def test_estimates_are_those_of_the_equations(names: tuple[str, ...]) -> None:
    """Of b = 2a + noise and y = 3b - a + noise, from rows in which one, or both, were set."""
    rng = np.random.default_rng(0)
    variables = [{"name": n, "readable": True, "settable": [-1.0, 1.0]} for n in "aby"]
    about = {"kind": "effect", "query": None, "remaining": 0, "variables": variables}
    about["settable_variables_act_on_one_another"] = True

    def experiment(do: dict[str, Any], n: int) -> dict[str, Any]:
        found = {}
        for name, mean in (("a", lambda f: 0.0), ("b", lambda f: 2 * f["a"]),
                           ("y", lambda f: 3 * f["b"] - f["a"])):  # fmt: skip
            noise = 0.3 * rng.normal(size=n)
            found[name] = rng.uniform(*do[name], n) if name in do else mean(found) + noise
        return {"columns": found}

    room: Any = SimpleNamespace(describe=lambda: about, observe=lambda n: experiment({}, n))
    room.experiment = experiment
    seen = _Seen(_Known(room), rng)
    for do in ({}, *({name: [-1.0, 1.0]} for name in names), {n: [-1.0, 1.0] for n in names}):
        seen.experiment(do, 200)
    slopes = {"a": 5.0, "b": 3.0}
    for name in names:
        ends = seen.predict("y", [{name: 1.0}, {name: -1.0}])
        assert ends[0] - ends[1] == pytest.approx(2.0 * slopes[name], abs=0.6)


def test_equal_residuals_share_a_cause() -> None:
    """A correlation of one is no division by zero."""
    same = np.random.default_rng(0).normal(size=40)
    table = {"a": same, "b": -same, "c": np.random.default_rng(1).normal(size=40)}
    with np.errstate(all="raise"):
        found = _confounded(table)
    assert found == [["a", "b"]]


def test_two_processes_make_the_same_questions_and_a_key_makes_others() -> None:
    """Digests cover the description and the answer."""
    program = (
        "import scm_world as sw\n"
        "print(sw.lab.question('effect', 'equations', 5).digest)\n"
        "print(sw.lab.question('effect', 'equations', 5, key='a secret of a test').digest)\n"
    )
    runs = [
        subprocess.run(  # noqa: S603 # our own text
            [sys.executable, "-c", program], capture_output=True, text=True, check=True
        ).stdout.split()
        for _ in range(2)
    ]
    assert runs[0] == runs[1]
    assert len({*runs[0]}) == 2


def test_the_command_runs_replays_and_plays(tmp_path: Path) -> None:
    """A saved run is repeated; a person types calls of tools."""
    from typer.testing import CliRunner

    from scm_world.cli.app import app

    path, run = str(tmp_path / "run.json"), CliRunner()
    done = run.invoke(app, ["lab", "run", "--seed", "3", "--agent", "ideal", "--out", path])
    assert done.exit_code == 0, done.output
    assert '"score": 1.0' in done.output
    assert "identical" in run.invoke(app, ["lab", "replay", path]).output
    typed = 'observe {"n": 2}\nobserve {\nsubmit {"answer": 0, "confidence": 0.1}\n'
    played = run.invoke(app, ["lab", "play", "--seed", "3"], input=typed)
    assert played.exit_code == 0, played.output
    assert "not JSON" in played.output
    assert '"brier"' in played.output
    (secret := tmp_path / "key.txt").write_text("a secret of a test\n")
    asked = ["lab", "run", "--seed", "3", "--out", path]
    private = run.invoke(app, [*asked, "--key", str(secret)])
    assert private.exit_code == 0, private.output
    in_room = {"SCM_LAB_KEY": "a secret of a test"}
    assert "identical" in run.invoke(app, ["lab", "replay", path], env=in_room).output
    assert run.invoke(app, ["lab", "replay", path]).exit_code == 1
    assert "counterfactual" in run.invoke(app, ["lab", "list"]).output
    assert run.invoke(app, ["lab", "replay"]).exit_code == 2


def test_a_strike_moves_the_block_as_in_plain_mujoco() -> None:
    """The mean under an intervention is what the engine gives for these numbers."""
    rng, names = np.random.default_rng(3), [*worlds.RIGS["pushing"].causes]
    view = LevelView(worlds.testbed("pushing", rng, lab.Knobs()), "L2", lab.Knobs(), 3)
    do = {name: 0.3 * view.ends(name)[0] + 0.7 * view.ends(name)[1] for name in names}
    xml = worlds.RIGS["pushing"].xml("plain", np.random.default_rng(3).uniform(0.7, 1.4, 3))
    model = mujoco.MjModel.from_xml_string(xml)
    data = mujoco.MjData(model)
    for body in ("pusher", "block"):
        model.body(body).mass = do[f"{body}.mass"]
    model.geom("block").friction[0] = do["block.friction"]
    model.joint("pusher").damping[0] = do["pusher.damping"]
    data.joint("offset").qpos, data.joint("pusher").qvel = (
        do["offset.position"],
        do["pusher.velocity"],
    )
    mujoco.mj_setConst(model, mujoco.MjData(model))
    mujoco.mj_step(model, data, nstep=240)
    found = view.means({**do, "lamp0.brightness": 0.5})
    assert data.joint("block_x").qpos > 0.03
    for joint in ("block_x", "block_turn"):
        assert found[f"{joint}.position.final"] == pytest.approx(
            float(data.joint(joint).qpos[0]), abs=1e-9
        )


def test_an_episode_that_was_run_is_looked_at_and_it_is_the_same_episode() -> None:
    """Its readings are repeated, the red box goes to the right, and masked levels are refused."""
    asked = build("effect", "boxes", 1, "L2", lab.Knobs(noise=0.0, selection=True), 0, None)
    room = lab.Laboratory(asked)
    refused = room.call("look", {"episode": 0})
    assert "before any was run" in refused["refused"]
    rows = len(room.observe(6)["columns"]["first.position.final"])
    far = room.experiment({"first.velocity": 2.4}, n=2)["columns"]
    assert rows < 6  # those that are not shown have no number
    assert "refused" in room.call("look", {"episode": rows + 2})
    assert "refused" in room.call("look", {"episode": 0, "frames": 9})
    again = asked.view.fresh().episode({"first.velocity": 2.4}, 0, 7)
    for name in ("first", "second"):
        assert again.final(f"{name}.position") == far[f"{name}.position.final"][1]
    seen = room.look(rows + 1)
    assert room.spent == 8
    assert seen["steps"] == [0, 2, 4]
    places = []
    for one in seen["pictures"]:
        data = base64.b64decode(one)
        assert data[:8] == b"\x89PNG\r\n\x1a\n"
        pixels = np.frombuffer(zlib.decompress(data[41:-16]), np.uint8).reshape(240, -1)[:, 1:]
        red = pixels.reshape(240, 320, 3).astype(int)
        places.append(np.nonzero(red[..., 0] > red[..., 2] + 50)[1].mean())
    assert places[0] < places[1] < places[2]
    masked = lab.Laboratory(build("effect", "boxes", 1, "L3", lab.Knobs(), 0, None))
    masked.observe()
    assert "level L3" in masked.call("look", {"episode": 0})["refused"]


def test_speeds_act_on_other_boxes_where_plain_mujoco_says_so_and_only_by_contact(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Finite differences of the engine around the run have the same edges; without contact none."""
    files, real = list[str](), worlds._model
    monkeypatch.setattr(worlds, "_model", lambda *of: files.append(real(*of)) or files[-1])
    asked = build("graph", "row", 6, "L2", lab.Knobs(), 1, None)
    given = {name: value for name, value in asked.query["set"].items() if "box" in name}

    def final(speeds: dict[str, float], *, contact: bool) -> dict[str, float]:
        model = mujoco.MjModel.from_xml_string(files[-1])
        if not contact:
            model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
        data = mujoco.MjData(model)
        for name, value in speeds.items():
            data.joint(name.partition(".")[0]).qvel = value
        mujoco.mj_step(model, data, nstep=240)
        return {name: float(data.joint(name.partition(".")[0]).qpos[0]) for name in speeds}

    def edges(*, contact: bool) -> list[list[str]]:
        found = []
        for cause, value in given.items():
            low, high = (
                final({**given, cause: value + apart}, contact=contact) for apart in (-0.02, 0.02)
            )
            found += [
                [cause, name.replace("velocity", "position.final")]
                for name in given
                if name != cause and abs(high[name] - low[name]) > 1e-9
            ]
        return sorted(found)

    assert len(asked.answer["edges"]) == 5  # one pair in one direction only
    assert edges(contact=True) == asked.answer["edges"]
    assert edges(contact=False) == []
    assert asked.grade({"edges": asked.answer["edges"]}) == 1.0

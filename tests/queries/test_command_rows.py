"""Row k of every table of control steps has the command of step k, which acts on row k + 1."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest

from scm_world import SCM, Action, Box, Derived, Hard, Measured, Outcome, StepTask, World
from scm_world.discovery.data import Dataset, Design, collect, from_frame, load, save
from scm_world.errors import ModelError, UnknownOption
from scm_world.evaluation.recording import record
from scm_world.fit.recordings import read_recording
from scm_world.queries import load_episode, save_episode
from scm_world.studio.worker import _LaneState
from scm_world.variables import Draw, Linear, Mechanism, Parent

GAIN = 0.02
STEPS = 40


def pushed(parameters: Any, state: Any, action: Any, noise: Any) -> dict[str, Any]:
    """Add a part of the command to the speed."""
    return {"v": state["v"] + GAIN * action["u"]}


def effort(v: Any, u: Any) -> Any:
    """Reward speed, and charge for the command that led to it."""
    return v - u * u


class Cart(StepTask):
    """A cart whose speed is the sum of its commands."""

    states = (Measured(name="v", parents=("v", "u")),)
    actions = (Action(name="u", bounds=Box(-1.0, 1.0)),)
    outcomes = (Derived(name="cost", parents=("u",), mechanism=np.square),)
    reward = (effort, "v", "u")
    step = staticmethod(pushed)


def equations() -> SCM:
    """Return the cart as equations, with a cost within the instant, and its sum one step later."""
    return SCM(
        [
            Action(name="u", bounds=Box(-1.0, 1.0)),
            Derived(
                name="v",
                parents=(Parent("v", 1), Parent("u", 1)),
                mechanism=Linear(weights=(1.0, GAIN)),
            ),
            Derived(name="cost", parents=("u",), mechanism=np.square),
            Derived(
                name="spent",
                parents=(Parent("spent", 1), Parent("cost", 1)),
                mechanism=Linear(weights=(1.0, 1.0)),
            ),
        ]
    )


def fits_graph(u: Any, v: Any) -> None:
    """Check a table against the closed form: the next speed is this one and the gained command."""
    u, v = np.ravel(u)[: len(v) - 1], np.ravel(v)
    assert np.ptp(u) > 0.5
    np.testing.assert_allclose(v[1:], v[0] + GAIN * np.cumsum(u), atol=1e-6)
    assert np.polyfit(u, np.diff(v), 1)[0] == pytest.approx(GAIN, abs=1e-6)


@pytest.mark.parametrize("make", [lambda: World(Cart()), lambda: World(equations())])
def test_a_row_of_an_episode_has_the_command_chosen_there(make: Any, tmp_path: Path) -> None:
    """Alone, live, in a counterfactual, from a file; the last row repeats the last command."""
    world = make()
    episode = world.rollout("random", seed=3, steps=STEPS)
    fits_graph(episode["u"], episode["v"])
    np.testing.assert_array_equal(episode["u"][:-1, None], episode.actions.clip(-1.0, 1.0))
    assert episode["u"][-1] == episode["u"][-2]
    other = episode.counterfactual({"u": Hard(0.5, during=(5, 9))})
    fits_graph(other["u"], other["v"])
    assert (other["u"] == 0.5).nonzero()[0].tolist() == [5, 6, 7, 8]
    read = load_episode(save_episode(other, tmp_path / "one"), world=world)
    fits_graph(read["u"], read["v"])
    live = world.live("random", seed=3)
    for _ in range(STEPS):
        live.step()
    np.testing.assert_array_equal(live["u"], episode["u"][:-1])
    np.testing.assert_array_equal(live.episode()["u"], episode["u"])


@pytest.mark.parametrize("make", [lambda: World(Cart()), lambda: World(equations())])
def test_a_row_of_the_studio_has_the_command_chosen_there(make: Any) -> None:
    """Also when an instant is looked at twice, after an intervention."""
    live = make().live("random", seed=3)
    lane = _LaneState(live)
    for step in range(20):
        live.step()
        lane.look()
        if step == 9:
            live.do({"v": Hard(0.5, during=(10, 11))})
            lane.look()
    u, v = ([float(row[name]) for row in lane.rows] for name in "uv")
    np.testing.assert_allclose(v[1:10], GAIN * np.cumsum(u[:9]), atol=1e-12)
    np.testing.assert_allclose(v[11:], 0.5 + GAIN * np.cumsum(u[10:-1]), atol=1e-12)


def test_a_policy_within_the_model_reads_the_row_of_its_command() -> None:
    """A mechanism of the command is an edge without lag, and true of the rows."""
    for world in (World(Cart()), World(equations())):
        given = {"u": Mechanism(lambda v: 0.5 - 2.0 * v, ["v"])}
        episode = world.rollout(None, seed=0, steps=30, do=given)
        np.testing.assert_allclose(episode["u"][:-1], 0.5 - 2.0 * episode["v"][:-1], atol=1e-12)


def test_a_readout_of_a_command_has_that_of_the_step_before() -> None:
    """It is computed when the next command is not chosen: the graph says lag 1."""
    world = World(Cart())
    keys = {edge.key for edge in world.graph.edges}
    assert {("u", "cost", 1), ("u", "reward", 1), ("v", "reward", 0)} <= keys
    episode = world.rollout("random", seed=3, steps=STEPS)
    np.testing.assert_array_equal(episode["cost"][1:], episode["u"][:-1] ** 2)
    np.testing.assert_array_equal(episode["reward"], episode["v"] - episode["cost"])


def test_what_follows_from_a_command_of_equations_is_in_its_row() -> None:
    """Within the instant, and what remembers it one step later."""
    for episode in (equations().rollout("random", seed=3, steps=STEPS), *_together(equations())):
        cost = episode["u"] ** 2  # the instant before the first step has the declared start
        np.testing.assert_array_equal(episode["cost"][1:-1], cost[1:-1])
        np.testing.assert_allclose(episode["spent"][2:], np.cumsum(cost[1:-1]), atol=1e-12)


def _together(model: SCM) -> Any:
    world = World(model)
    return world.rollout("random", seed=3, steps=4).worlds([{"v": 1.0}, {"v": 2.0}])


@pytest.mark.parametrize("workers", [None, 1])
@pytest.mark.parametrize("make", [lambda: World(Cart()), lambda: World(equations())])
def test_a_path_has_the_rows_of_an_episode(make: Any, workers: Any) -> None:
    """Other summaries of a command are over the commands, each of them once."""
    hows = ("path", "mean", "sum", "first", "final", "change")
    outcomes = [Outcome("v", "path"), *(Outcome("u", how) for how in hows)]
    setting = {"policy": "random", "steps": STEPS, "workers": workers}
    found = make().sample(70, {}, outcomes=outcomes, **setting)
    for u, v in zip(found["path u"], found["path v"], strict=True):
        fits_graph(u, v)
    sent = found["path u"][:, :-1]
    np.testing.assert_allclose(found["mean u"], sent.mean(axis=1))
    np.testing.assert_allclose(found["sum u"], sent.sum(axis=1))
    np.testing.assert_array_equal(found["first u"], sent[:, 0])
    np.testing.assert_array_equal(found["u"], sent[:, -1])
    np.testing.assert_array_equal(found["change u"], sent[:, -1] - sent[:, 0])


@pytest.mark.parametrize("make", [lambda: World(Cart()), equations])
def test_a_collected_table_follows_its_graph(make: Any) -> None:
    """A regression with the lags of the graph gives the weights of the step function."""
    drawn = Design("all", ("u",), Draw(Box(-1.0, 1.0)), observational_fraction=0.0)
    design = drawn if make is equations else Design()
    found = collect(make(), design, 3, seed=0, steps=STEPS, **_rows(make))
    assert found.about["commands"] == "a row has the command that is chosen there"
    assert (found.step == np.tile(np.arange(STEPS), 3)).all()
    assert ("u", "v", 1) in found.truth.edges
    for number in range(3):
        part = found.rows(found.episode == number)
        fits_graph(part["u"], part["v"])
    if make is equations:
        np.testing.assert_array_equal(found["cost"], found["u"] ** 2)


def _rows(make: Any) -> dict[str, Any]:
    return {} if make is equations else {"every_step": True, "causes": []}


def test_a_table_of_the_old_rows_is_refused(tmp_path: Path) -> None:
    """One of equations had the command of the step before; the error says what to do."""
    drawn = Design("all", ("u",), Draw(Box(-1.0, 1.0)), observational_fraction=0.0)
    table = collect(equations(), drawn, 2, seed=0, steps=5)
    about = {name: value for name, value in table.about.items() if name != "commands"}
    old = Dataset(table.values, table.columns, table.regimes, table.regime, table.episode,
                  table.step, about)  # fmt: skip
    from scm_world.discovery.data import as_frame

    frame = as_frame(old)
    save(old, tmp_path / "old")
    for read in (lambda: from_frame(frame), lambda: load(tmp_path / "old")):
        with pytest.raises(ModelError, match=r"command of the step before.*collect it again"):
            read()
    assert load(save(table, tmp_path / "new")) == from_frame(as_frame(table)) == table


def test_recordings_for_a_fit_have_the_commands_that_acted() -> None:
    """Those of an episode are after its interventions; those of a table are its rows."""
    world = World(Cart())
    done = {"u": Hard(0.5, during=(5, 9))}
    episode = world.rollout("random", seed=3, steps=STEPS, do=done)
    table = collect(world, Design(), 2, seed=0, steps=STEPS, every_step=True, causes=[])
    for given in (episode, table):
        for run in read_recording(world, given).runs:
            fits_graph(run.commands, run.values[:, 0])


CART = """
import scm_world as sw

def pushed(parameters, state, action, noise):
    return {"v": state["v"] + 0.02 * action["u"]}

class Cart(sw.StepTask):
    states = (sw.Measured(name="v", parents=("v", "u")),)
    actions = (sw.Action(name="u", bounds=sw.Box(-1.0, 1.0)),)
    reward = (abs, "v")
    step = staticmethod(pushed)
"""


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_recordings_of_environments_and_their_datasets(tmp_path: Path, monkeypatch: Any) -> None:
    """Episodes, pairs for cloning and Minari: the action of row k leads to row k + 1."""
    pytest.importorskip("minari")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    monkeypatch.syspath_prepend(str(tmp_path))
    (tmp_path / "command_rows_cart.py").write_text(CART)
    units = {"normalize_actions": False, "normalize_observations": False}
    options: dict[str, Any] = {"task": "command_rows_cart:Cart", "max_episode_length": STEPS}
    about = {"author": "A", "author_email": "a@b.org", "code_permalink": "https://e.org"}
    world = World("command_rows_cart:Cart")
    for number, scale in enumerate((units, {})):
        recorded = record("random", gymnasium.make("scm_world/Model-v0", **options, **scale), 1)
        fits_graph(recorded[0].actions, np.array(recorded[0].observations)[:, 0])
        seen, sent = recorded.pairs()
        fits_graph(sent[:-1], seen[:, 0])
        dataset = recorded.to_minari(f"cart/rows-v{number}", data_format="arrow", **about)
        fits_graph(dataset[0].actions, dataset[0].observations[:, 0])
        if scale:
            (run,) = read_recording(world, dataset).runs
            fits_graph(run.commands, run.values[:, 0])
            continue
        with pytest.raises(UnknownOption, match=r"in \[-1, 1\].*normalize_actions=False"):
            read_recording(world, dataset)

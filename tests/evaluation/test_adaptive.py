"""Facts about agents that fit parameters to their own episode."""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from adaptation_samples import FORM, MASS, MEASURES, TOLD, Cart, Shaking, adaptive

from scm_world.env import ScmWorldEnv
from scm_world.errors import NotIntervenable, UnknownOption, UnknownVariable
from scm_world.evaluation import Adaptive, evaluate, inferred, play
from scm_world.evaluation.adaptive import posterior
from scm_world.policies import as_agent
from scm_world.policies.planning import CrossEntropy

FILE = Path(__file__).parent / "adaptation_samples.py"
STEADY = {"hinge.position": 0.3}


def cart(**options: Any) -> ScmWorldEnv:
    """Return the cart, with the mass of its pole in the observation."""
    return ScmWorldEnv(Cart(), **{"include": [MASS], **FORM, **options})


def acted(agent: Any, env: ScmWorldEnv, mass: float, steps: int, shown: Any = ()) -> Any:
    """Return the observations and the actions of an episode; observations may be given."""
    observation, _ = env.reset(seed=0, options={"do": {**STEADY, MASS: mass}})
    agent.start(env)
    seen, actions = [], []
    for step in range(steps):
        seen.append(np.array(observation))
        if len(shown):
            own = observation[4:]
            observation = np.array(shown[step])
            observation[4:] = own  # what the environment shows of the parameters
        actions.append(np.array(agent.act(observation)))
        observation = env.step(actions[-1].astype(np.float32))[0]
    return np.array(seen), np.array(actions)


def test_it_acts_as_one_that_is_told_after_its_fit() -> None:
    """Before, as one that is told the default; the size of the action is that of the mass."""
    agent = Adaptive(TOLD, MASS, after=15, measures=MEASURES)
    actions = np.abs(acted(as_agent(agent), cart(), 0.3, 30)[1]).ravel() / 3.0
    np.testing.assert_allclose(actions[:15], 0.1)
    np.testing.assert_allclose(actions[15:], 0.3, rtol=1e-3)
    (known,) = agent.history
    assert (known["step"], known["reason"]) == (15, "")
    assert known["values"][MASS] == pytest.approx(0.3, rel=1e-3)


@pytest.mark.parametrize("context", ["none", "observation", "privileged"])
def test_true_values_do_not_leak(context: str) -> None:
    """The same recording gives the same actions in worlds with other parameters."""

    def largest(seen: Any) -> Any:
        """Depend on everything that is shown."""
        seen = {"all": seen} if isinstance(seen, np.ndarray) else seen
        return np.array([np.tanh(sum(np.sin(7.0 * part).sum() for part in seen.values()))])

    include = [MASS, "pole.inertia"] if context == "none" else []
    policy = as_agent(largest, env={**FORM, "include": include, "context": context})
    agent = as_agent(Adaptive(policy, MASS, after=12, measures=MEASURES))
    found = []
    light = cart(context=context, include=include)
    recorded: list[Any] = []
    for mass in (0.3, 0.05):
        observation, _ = light.reset(seed=0, options={"do": {**STEADY, MASS: mass}})
        agent.start(light)
        actions = []
        for step in range(20):
            if mass == 0.3:
                recorded.append(observation)
            main = observation["observation"] if context == "privileged" else observation
            past = recorded[step]["observation"] if context == "privileged" else recorded[step]
            main = np.array(main)
            main[:4] = past[:4]  # what is measured
            given = {**observation, "observation": main} if context == "privileged" else main
            actions.append(agent.act(given))
            observation = light.step(np.asarray(actions[-1], np.float32))[0]
        found.append(np.array(actions))
    np.testing.assert_array_equal(*found)
    assert len(np.unique(found[0])) > 10


def test_a_history_shows_what_is_believed() -> None:
    """In the pairs of the past, too."""
    shown: list[Any] = []

    def keep(seen: Any) -> Any:
        shown.append(np.array(seen))
        return np.array([np.sin(len(shown))])

    form = {**FORM, "include": [MASS], "history": 3}
    agent = Adaptive(as_agent(keep, env=form), MASS, after=12, measures=MEASURES)
    env = cart(history=3)
    acted(as_agent(agent), env, 0.3, 14)
    places = [env.layout[name] for name in (MASS, *(f"{MASS}@-{lag}" for lag in (1, 2, 3)))]
    table = np.array([[float(seen[place][0]) for place in places] for seen in shown])
    np.testing.assert_allclose(table[1], [0.1, 0.1, 0.0, 0.0])
    np.testing.assert_allclose(table[11], 0.1)
    np.testing.assert_allclose(table[12], 0.3, rtol=1e-2)


def test_a_fit_that_does_not_determine_keeps_what_was_believed() -> None:
    """It says so: at rest nothing shows the mass, nor do too few measurements."""
    still = as_agent(lambda seen: 0.0 * seen[4:], env={**FORM, "include": [MASS]})
    agent = Adaptive(still, MASS, after=10, every=10, measures=MEASURES)
    env = cart()
    play(env, as_agent(agent), {"hinge.position": 0.0, MASS: 0.3}, seed=0)
    assert [one["step"] for one in agent.history] == [10, 20, 30]
    assert {one["reason"] for one in agent.history} == {f"not determined: {MASS}"}
    assert all(one["values"][MASS] == 0.1 for one in agent.history)
    few = Adaptive(TOLD, MASS, after=1, measures={"slider.position": 1e-3})
    play(env, as_agent(few), {MASS: 0.3}, seed=0)
    assert "measurements" in few.history[0]["reason"]


def test_draws_are_of_what_the_fit_leaves_open() -> None:
    """They are of the noise of the episode, and spread as the interval says."""
    agent = Adaptive(TOLD, MASS, after=25, measures=dict.fromkeys(MEASURES, 3e-3), use="draw")
    env, found = cart(), []
    for seed in (*range(6), 0):
        play(env, as_agent(agent), {**STEADY, MASS: 0.3}, seed=seed)
        found.append(float(agent.history[0]["values"][MASS]))
    assert len({*found}) == 6
    assert found[0] == found[-1]
    assert 1e-4 < np.std(np.log(found)) < 0.25
    assert abs(np.mean(found) - 0.3) < 0.05


def test_it_keeps_what_it_believes_in_the_next_episode_if_asked() -> None:
    """Until it forgets; an evaluation does so before each draw."""
    agent, env = as_agent(Adaptive(TOLD, MASS, 15, measures=MEASURES, keeps=True)), cart()
    first = [float(acted(agent, env, 0.3, 20)[1][0, 0]) for _ in range(2)]
    agent.forget()
    first.append(float(acted(agent, env, 0.3, 5)[1][0, 0]))
    np.testing.assert_allclose(first, [0.3, 0.9, 0.3], rtol=1e-3)
    assert agent.keeps
    assert not as_agent(adaptive).keeps
    found = evaluate({"mine": agent, "told": TOLD}, f"A:{MASS}", task=Cart(), n=4, repeats=2)
    *_, gain = found.attempts(f"A:{MASS}", agent="mine")
    regret = [
        one.groupby(one["episode"] % 2)["return"].mean().to_numpy()
        for one in (found.only(agent=name).frame for name in ("told", "mine"))
    ]
    lost = np.abs(regret[0] - regret[1])
    assert lost[1] < 0.05 * lost[0]
    assert gain.n == 2


def test_a_planner_plans_with_what_is_believed() -> None:
    """First with the declared value, then with the fitted one; the given beliefs stay."""
    planner = CrossEntropy(samples=4, horizon=6, spread=1.0, every=1, do={"slider.damping": 0.4})
    agent = Adaptive(planner, MASS, after=12, measures=MEASURES)
    env = cart(include=[])
    true = acted(as_agent(agent), env, 0.3, 10)[1]
    believed = agent._planner
    assert believed is not None
    assert believed.do.keys() == {"slider.damping", MASS}
    assert believed.do[MASS] == 0.1
    assert planner.do == {"slider.damping": 0.4}
    play(env, as_agent(agent), {**STEADY, MASS: 0.3}, seed=0)
    assert believed.do[MASS] == pytest.approx(0.3, rel=1e-2)
    again = CrossEntropy(samples=4, horizon=6, spread=1.0, every=1, do={**planner.do, MASS: 0.1})
    from scm_world.policies import WorldPolicy

    np.testing.assert_array_equal(acted(as_agent(WorldPolicy(again)), env, 0.3, 10)[1], true)


def test_it_is_evaluated_and_named(tmp_path: Path) -> None:
    """By its name on the command line, beside others, in any process, and resumed."""
    agents = {"adaptive": f"{FILE.stem}:adaptive", "told": TOLD, "default": "still"}
    how: dict[str, Any] = {"task": f"{FILE}:Cart", "n": 2, "out": tmp_path}
    found = evaluate(agents, f"A:{MASS}", **how)
    assert evaluate({**agents, "adaptive": adaptive}, f"A:{MASS}", **{**how, "out": None}) == found
    stamps = {path: path.stat().st_mtime_ns for path in (tmp_path / "parts").iterdir()}
    assert evaluate(agents, f"A:{MASS}", **how) == found
    assert stamps == {path: path.stat().st_mtime_ns for path in (tmp_path / "parts").iterdir()}
    assert found.about["agents"][0]["env"] == {**FORM, "include": [MASS]}
    again = pickle.loads(pickle.dumps(as_agent(adaptive)))  # noqa: S301 # ours
    env = cart()
    both = [acted(one, env, 0.3, 30)[1] for one in (as_agent(adaptive), again)]
    np.testing.assert_array_equal(*both)


def test_what_cannot_be_fitted_or_shown_is_refused() -> None:
    """At the beginning of an episode, with what is allowed."""
    env = cart(include=[])
    env.reset(seed=0)
    blind = as_agent(Shaking, env=FORM)
    with pytest.raises(UnknownOption, match=r"does not observe 'pole.mass'.*context"):
        as_agent(Adaptive(blind, MASS, measures=MEASURES)).start(env)
    shown = cart()
    shown.reset(seed=0)
    form = as_agent(lambda seen: seen[:1], env={**FORM, "include": ["hinge.damping"]})
    damped = as_agent(Adaptive(form, "hinge.damping", measures=MEASURES, prior="A"))
    env = cart(include=["hinge.damping"])
    env.reset(seed=0)
    with pytest.raises(UnknownOption, match=r"a space that one of hinge.damping has"):
        damped.start(env)
    for error, parameters, measures in (
        (UnknownVariable, MASS, {"hinge.angle": 0.1}),
        (UnknownVariable, MASS, {"motor.force": 0.1}),
        (UnknownVariable, "pole.weight", MEASURES),
        (NotIntervenable, "hinge.position", MEASURES),
        (UnknownOption, MASS, {"hinge.position": 0.0}),
        (UnknownOption, "delay", MEASURES),
        (UnknownOption, [], MEASURES),
        (UnknownOption, MASS, {}),
    ):
        with pytest.raises(error):
            as_agent(Adaptive(TOLD, parameters, measures=measures)).start(shown)
    for wrong in (
        {"after": 0},
        {"every": 0},
        {"iterations": 0},
        {"last": 1},
        {"use": "mode"},
        {"prior": "C"},
    ):
        with pytest.raises(UnknownOption):
            Adaptive(TOLD, MASS, measures=MEASURES, **wrong)


def test_what_it_believes_is_its_hidden_state() -> None:
    """The fitted mass; the true one, which is observed but not told to it, is no control."""
    agent = Adaptive(TOLD, MASS, after=15, measures=MEASURES)
    env = {"max_episode_length": 18}
    first, end = inferred(agent, MASS, task=Cart(), steps=(0,), at=0, n=12, env=env).probes
    assert first.verdict == "no"
    assert first.scores["observation"]["linear"].value < 0.5
    assert end.scores["hidden"]["linear"].low > 0.9


def test_a_prior_is_that_of_bayes() -> None:
    """Of a normal prior and errors, by precisions; what has no prior is left out."""
    random = np.random.default_rng(0)
    roots = random.normal(size=(2, 3, 3))
    prior, spread = roots @ roots.transpose(0, 2, 1) + 0.1 * np.eye(3)
    center, found = random.normal(size=3), random.normal(size=3)
    precision = np.linalg.inv(prior) + np.linalg.inv(spread)
    direct = np.linalg.solve(
        precision, np.linalg.solve(prior, center) + np.linalg.solve(spread, found)
    )
    mean, left = posterior(np.insert(center, 1, np.nan), prior, found, spread)
    np.testing.assert_allclose(mean, direct)
    np.testing.assert_allclose(left, np.linalg.inv(precision), atol=1e-12)
    blind = posterior(center, prior, found, 1e20 * np.eye(3))[0]
    np.testing.assert_allclose(blind, center, atol=1e-6)


def test_with_a_prior_it_believes_the_mean_of_the_space_until_it_sees_more() -> None:
    """At rest nothing shows the mass; a swing does, also of a mass outside of the space."""
    still = as_agent(lambda seen: 0.0 * seen[4:], env={**FORM, "include": [MASS]})
    agent = Adaptive(still, MASS, after=15, measures=MEASURES, prior="A")
    env = cart()
    space = env.world.model[MASS].a
    low, high = np.ravel(space.low)[0], np.ravel(space.high)[0]
    middle = np.exp(np.log(np.linspace(low, high, 100_001)).mean())
    play(env, as_agent(agent), {"hinge.position": 0.0, MASS: 0.3}, seed=0)
    assert agent.history[0]["values"][MASS] == pytest.approx(middle, rel=0.05)
    seeing = Adaptive(TOLD, MASS, after=15, measures=MEASURES, prior="A")
    for mass, near in ((0.3, 0.02), (1.5 * high, 0.1)):  # the prior draws the second one to itself
        play(env, as_agent(seeing), {**STEADY, MASS: mass}, seed=0)
        assert seeing.history[0]["values"][MASS] == pytest.approx(mass, rel=near)

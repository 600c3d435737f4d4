"""Facts about repeated draws, rewards by step, and agents that are compared with a reference."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pandas
import pytest
from adaptation_samples import AGENTS, STEPS, Aim
from typer.testing import CliRunner

from scm_world.cli.app import app
from scm_world.env import ScmWorldEnv
from scm_world.errors import UnknownOption, UnreadableFile
from scm_world.evaluation import Evaluation, Protocol, Recorder, evaluate, why
from scm_world.evaluation.statistics import crossed_interval
from scm_world.evaluation.statistics.intervals import student
from scm_world.policies import as_agent

FILE = Path(__file__).parent / "adaptation_samples.py"


def aimed(agents: Any = AGENTS, protocols: Any = "A:offset", **options: Any) -> Evaluation:
    """Evaluate twelve episodes of a few control steps."""
    return evaluate(agents, protocols, task=Aim(), **{"n": 12, **options})


def test_a_draw_that_is_repeated_has_the_same_parameters_and_other_noise() -> None:
    """Also those that nature draws; draw d is that of episode d without repeats."""
    once, found = aimed("still"), aimed("still", repeats=3)
    for name in ("drawn offset", "drawn color"):
        repeated = found.frame[name].to_numpy().reshape(4, 3)
        assert (repeated == once.frame[name].to_numpy()[:4, None]).all()
    assert found.frame["drawn x.start"].nunique() == 12
    assert found.frame["hash"].nunique() == 12
    assert found.about["protocols"][0]["repeats"] == 3
    assert "repeats" not in once.about["protocols"][0]


def test_draws_that_are_refused_change_nothing() -> None:
    """The world goes on in its own episode, with its own noise."""
    env, same = ScmWorldEnv(Aim()), ScmWorldEnv(Aim())
    for one in (env, same):
        one.reset(seed=3)
    with pytest.raises(UnknownOption, match="draws"):
        env.world.reset(seed=4, episode=7, draws=-1)
    seen = [one.step(np.zeros(1, np.float32))[0] for one in (env, same)]
    np.testing.assert_array_equal(*seen)
    assert env.world.episode == 0


def test_what_is_drawn_within_an_episode_is_the_same_in_each_repeat() -> None:
    """And a world that is restored before it draws it again, too."""
    found = aimed("still", "A:offset@2", repeats=3, steps=True)
    assert found.rewards is not None
    rewards = found.rewards.reshape(4, 3, STEPS)
    assert (rewards[:, :, 2:] == rewards[:, :1, 2:]).all()
    assert len(np.unique(rewards[:, 0, 2])) == 4
    env = ScmWorldEnv(Aim(), start={"offset": "A"})
    values, winds = set(), set()
    for episode in (4, 5):
        env.reset(seed=3, options={"episode": episode, "draws": 1, "do": {}})
        before = env.snapshot()
        env.do({"offset": "A"})
        values.add(env.world["offset"].item())
        env.step(np.zeros(1, np.float32))
        winds.add(env.world["y"].item())
        env.reset(seed=0)
        env.restore(before)
        env.do({"offset": "A"})
        values.add(env.world["offset"].item())
    assert (len(values), len(winds)) == (1, 2)


def test_an_agent_that_remembers_improves_and_the_regret_is_known() -> None:
    """In its first control step of a draw it misses by the offset, and nowhere else."""
    found = aimed(repeats=3)
    offsets = np.abs(found.by_draw.only(agent="told").frame["drawn offset"].to_numpy())
    first, second, third, gain = found.attempts("A:offset", agent="learner")
    assert first.value == pytest.approx(-offsets.mean())
    assert (second.value, third.value) == pytest.approx((0.0, 0.0), abs=1e-6)  # of 32 bits
    assert gain.value == pytest.approx(offsets.mean(), abs=1e-6)
    low, high = student(offsets, None, 0.95)
    assert (gain.low, gain.high) == pytest.approx((float(low), float(high)), abs=1e-6)
    regret = found.regret("learner", "told", "A:offset")
    assert regret.value == pytest.approx(offsets.mean() / 3, abs=1e-6)
    assert found.regret("nothing", "told", "A:offset").value == pytest.approx(
        STEPS * offsets.mean()
    )
    assert found.score("A:offset", agent="learner").n == 4  # draws, not episodes
    better = found.probability_of_improvement("learner", "nothing", "A:offset")
    assert (better.value, better.high) == (1.0, 1.0)
    assert found.probability_of_improvement("told", "told", "A:offset").value == 0.5
    assert len(found.scores(agent="told")[0, 0]) == 4


def test_no_episode_depends_on_workers_and_shards(tmp_path: Path) -> None:
    """A draw is played by one worker; folders resume, with rewards, too."""
    learner = {"learner": as_agent("adaptation_samples:Learner")}
    how: dict[str, Any] = {"task": f"{FILE}:Aim", "n": 35, "repeats": 7, "steps": True}
    form = {"normalize_observations": False, "normalize_actions": False}
    found = evaluate(learner, "A:offset", env=form, out=tmp_path, **how)
    stamps = {path: path.stat().st_mtime_ns for path in (tmp_path / "parts").iterdir()}
    assert len(stamps) == 2
    again = evaluate(learner, "A:offset", env=form, out=tmp_path, **how)
    assert again == found == evaluate(learner, "A:offset", env=form, workers=2, **how)
    assert stamps == {path: path.stat().st_mtime_ns for path in (tmp_path / "parts").iterdir()}
    np.testing.assert_array_equal(again.rewards, found.rewards)
    np.testing.assert_allclose(np.nansum(found.rewards, axis=1), found.frame["return"])
    found.save(tmp_path / "results")
    loaded = Evaluation.load(tmp_path / "results")
    np.testing.assert_array_equal(loaded.rewards, found.rewards)
    (tmp_path / "results" / "steps.parquet").unlink()
    with pytest.raises(UnreadableFile):
        Evaluation.load(tmp_path / "results")


def test_rewards_are_known_by_step_since_an_intervention() -> None:
    """Before it all is well; after it the reward is minus the offset."""
    found = aimed("still", "A:offset@2,P0", steps=True)
    here = found.only(protocol="A:offset@2")
    offsets = np.abs(here.frame["drawn offset"].to_numpy())
    table = found.since("A:offset@2")
    assert table["step"].tolist() == [-2, -1, 0, 1]
    np.testing.assert_allclose(table["reward"], [0.0, 0.0, *[-offsets.mean()] * 2])
    low, high = student(-offsets, None, 0.95)
    np.testing.assert_allclose(table.loc[2, ["low", "high"]].astype(float), [low, high])
    coarse = found.since("A:offset@2", every=3)
    assert coarse["step"].tolist() == [-3, 0][-len(coarse) :]
    assert found.since("P0")["step"].tolist() == [0, 1, 2, 3]
    with pytest.raises(UnknownOption, match="steps=True"):
        aimed("still", n=1).since("A:offset")


def test_regret_counts_training_runs_and_draws() -> None:
    """It is the brute-force mean over pairs of runs; its interval has the spread of both."""
    rng = np.random.default_rng(0)
    rows = [
        {"agent": agent, "run": run, "engine": "step", "protocol": "A", "seed": 0, "episode": i,
         "steps": 1, "return": score, "hash": f"{agent}{run}{i}"}
        for agent, runs in (("a", 3), ("b", 2))
        for run in range(runs)
        for i, score in enumerate(rng.normal(size=6).round(1))
    ]  # fmt: skip
    found = Evaluation({"protocols": []}, pandas.DataFrame(rows))
    a, b = (found.scores(agent=name)[:, 0] for name in ("a", "b"))
    wins = [np.sign(x - y) * 0.5 + 0.5 for x in a for y in b]
    assert found.probability_of_improvement("a", "b", "A").value == pytest.approx(np.mean(wins))
    regret = found.regret("a", "b", "A")
    assert regret.value == pytest.approx(b.mean() - a.mean())
    unpaired = Evaluation(found.about, found.frame.drop(index=3))
    with pytest.raises(UnknownOption, match="every run of both"):
        unpaired.regret("a", "b", "A")
    parts = [a.mean(1), b.mean(1), b.mean(0) - a.mean(0)]
    shares = np.array([part.var(ddof=1) / len(part) for part in parts])
    free = shares.sum() ** 2 / sum(s**2 / (len(p) - 1) for s, p in zip(shares, parts, strict=True))
    from scipy.stats import t

    assert regret.high - regret.value == pytest.approx(t.ppf(0.975, free) * shares.sum() ** 0.5)
    with pytest.raises(UnknownOption, match="draws"):
        Evaluation({}, found.frame.iloc[:-1]).regret("a", "b", "A")


def test_crossed_intervals_hold() -> None:
    """Of runs and draws that both are random; with bounds a failure that was not seen counts."""
    rng, n, hits = np.random.default_rng(1), 400, 0
    for _ in range(n):
        runs, draws = rng.normal(size=(5, 1)), rng.normal(size=(1, 20))
        found = crossed_interval(runs + draws + rng.normal(size=(5, 20)))
        hits += found.low <= 0.0 <= found.high
    assert 0.93 * n < hits < n
    alone = crossed_interval(np.ones((1, 9)), bounds=(0.0, 1.0))
    assert (alone.value, alone.high) == (1.0, 1.0)
    assert 0.5 < alone.low < 1.0
    assert np.isnan(crossed_interval(np.ones((2, 3))).width)


def test_what_does_not_fit_repeats_is_refused() -> None:
    """Numbers of episodes, protocols without repeats, and episodes that follow others."""
    with pytest.raises(UnknownOption, match="a multiple of 5, the repeats of each draw"):
        aimed("still", repeats=5)
    with pytest.raises(UnknownOption, match="repeats"):
        Protocol("A", repeats=0)
    found = aimed({"learner": AGENTS["learner"]}, repeats=3)
    with pytest.raises(UnknownOption, match="3, the first of its draw: 'learner' remembers"):
        why(found, "A:offset", 4)
    assert why(found, "A:offset", 3).others[0].would_score <= 0.0
    with pytest.raises(UnknownOption, match="repeats=2 or more"):
        aimed("still", n=1).attempts("A:offset")
    with pytest.raises(UnknownOption, match="draws of a recorded episode"):
        Recorder(ScmWorldEnv(Aim())).reset(seed=0, options={"draws": 1})
    with pytest.raises(UnknownOption, match="draws"):
        ScmWorldEnv(Aim()).reset(seed=0, options={"draws": -1})
    five = Protocol("five", "offset", repeats=5)
    assert Protocol.from_dict(five.as_dict()) == five


def test_the_command_line_prints_what_was_learned(tmp_path: Path) -> None:
    """Regret, first and last episodes, and rewards by step."""
    words = ["evaluate", "mine=adaptation_samples:Learner,still", f"{FILE}:Aim", "-n", "2"]
    words += ["--protocols", "A:offset@1", "--repeats", "2", "--steps", "--reference", "still"]
    found = CliRunner().invoke(app, [*words, "--out", str(tmp_path)], env={"COLUMNS": "200"})
    assert found.exit_code == 0, found.output
    for said in ("regret to still", "last - first", "since the intervention"):
        assert said in found.output
    assert (tmp_path / "steps.parquet").exists()


def test_what_is_drawn_anew_within_a_draw_has_its_mean() -> None:
    """So the slope of a mean score is that of a score; a value that holds keeps its bits."""
    rng, held = np.random.default_rng(0), [0.1, 0.7]
    start = rng.normal(size=(2, 3))
    rows = [
        {"agent": "a", "run": 0, "engine": "step", "protocol": "A", "seed": 0, "episode": 3 * i + k,
         "steps": 1, "return": start[i, k], "hash": "", "drawn start": start[i, k],
         "drawn mass": held[i]}
        for i in range(2) for k in range(3)
    ]  # fmt: skip
    found = Evaluation({"protocols": [{"name": "A", "repeats": 3}]}, pandas.DataFrame(rows))
    frame = found.by_draw.frame
    np.testing.assert_allclose(frame["drawn start"], start.mean(axis=1))
    np.testing.assert_allclose(frame["return"], frame["drawn start"])
    assert frame["drawn mass"].tolist() == held

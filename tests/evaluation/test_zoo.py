"""Facts about the zoo: policies with cards, and how they get there."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from evaluation_samples import played_again
from policy_samples import RELATIVE, tensors, trained

from benchmarks.baselines import publish as publishing
from benchmarks.baselines.cards import card_text, page_text
from benchmarks.baselines.publish import command_of, publish
from scm_world.env import ScmWorldEnv
from scm_world.errors import ModelError, UnknownOption, UnreadableFile
from scm_world.evaluation import evaluate, in_world
from scm_world.policies import file_of, load_policy, save_policy
from scm_world.policies import zoo as zoo_module
from scm_world.policies.agents import agent_from, as_agent
from scm_world.policies.cards import FORM
from scm_world.policies.zoo import best_known, zoo
from scm_world.queries import World
from scm_world.training.recipe import recipe

PAGE = Path(__file__).parents[2] / "docs" / "zoo.md"
CARD = {
    "recipe": recipe("pushing", steps=1_000_000).as_dict(),
    "seed": 4,
    "backend": "mujoco",
    "steps": 1024,
    "cpu_s": 12.345678,
    "versions": {"numpy": "2.0", "mujoco": "3.3"},
    "trial": {"steps": 512, "scores": {"P0": 0.5}},
}
COMMAND = "scm-world train pushing --algo ppo --backend mujoco --seed 4 --steps 1000000"


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Have an empty zoo in a folder of its own."""
    made = tmp_path / "zoo"
    made.mkdir()
    monkeypatch.setattr(zoo_module, "FOLDER", made)
    return made


def evaluated(path: Path, out: Path, protocols: str = "P0,P5", **options: Any) -> Path:
    """Evaluate a policy in short episodes without physics, and give the folder."""
    env = {"max_episode_length": 5}
    made: Any = {"n": 1, "seeds": range(4), "backend": "fake", "env": env, **options}
    evaluate({"a": str(path), "still": "still"}, protocols, **made).save(out)
    return out


@pytest.fixture
def published(folder: Path, tmp_path: Path) -> str:
    """Publish a policy, and give its name."""
    path = trained(tmp_path / "run" / "policy.safetensors", card=CARD)
    results = evaluated(path, tmp_path / "results")
    publish(path.parent, "small", [results], page=tmp_path / "zoo.md", limits=["It does nothing."])
    return "zoo:small"


def test_a_published_policy_acts_by_its_name(published: str) -> None:
    """Wherever a policy is named; results name it, and it is made again from them."""
    about = as_agent(published).about
    assert (about["kind"], about["name"]) == ("zoo", "zoo:small")
    assert agent_from(about).about == about
    found = evaluate(published, "P0", n=2, backend="fake", env={"max_episode_length": 5})
    assert found.agents == ("small",)
    assert not played_again(found)
    file_of(published).write_bytes(
        trained(zoo_module.FOLDER / "other.safetensors", seed=1).read_bytes()
    )
    with pytest.raises(UnreadableFile, match="another file"):
        agent_from(about)


def test_the_card_says_how_it_was_made_and_how_well_it_does(published: str, tmp_path: Path) -> None:
    """As data, as text, in one line, and on the page of all of them."""
    about = load_policy(published).about
    assert zoo() == {published: about}
    assert about.card["command"] == COMMAND
    scores: Any = about.card["scores"]
    assert [(row["engine"], row["protocol"], row["n"]) for row in scores] == [
        ("fake", "P0", 4),
        ("fake", "P5", 4),
    ]
    assert scores[1]["last_fractional_success"]["n"] == 4
    text = card_text(about, published)
    for part in (
        "# zoo:small\n",
        COMMAND,
        "| seed | 4 |",
        "| steps | 1,024 |",
        "| cpu_s | 12.35 |",
        "numpy 2.0, mujoco 3.3",
        "| last fractional success, fake | success, fake | published overlap, fake | episodes |",
        "| P5 | goal from A |",
        " | 4 × 1 |",
        "scm-world evaluate zoo:small --protocols P0,P5 -n 1 --seeds 0,1,2,3 --backend fake\n",
        "- It does nothing.",
        "<summary>recipe</summary>",
        '| trial | `{"steps": 512, "scores": {"P0": 0.5}}` |',
        "`delta_scale=0.1`",
    ):
        assert part in text
    assert best_known(about).startswith("P0 0.")
    assert (tmp_path / "zoo.md").read_text() == page_text(zoo())
    assert "## zoo:small" in page_text(zoo())


def test_seeds_and_a_ceiling_stand_beside_the_scores(folder: Path, tmp_path: Path) -> None:
    """Of the same evaluation: other runs of the agent, and one that sees the whole world."""
    paths = [trained(tmp_path / f"{seed}.safetensors", seed=seed, card=CARD) for seed in (0, 1)]
    made: Any = {"n": 1, "seeds": range(4), "backend": "fake", "env": {"max_episode_length": 5}}
    agents: Any = {"a": [str(path) for path in paths], "still": "still"}
    found = evaluate(agents, "P5", **made)
    found.save(tmp_path / "results")
    page = tmp_path / "zoo.md"
    publish(paths[0], "small", [tmp_path / "results"], page=page, ceiling="still")
    scores: Any = load_policy("zoo:small").about.card["scores"]
    each = found.scores("last_fractional_success", agent="a")[:, 0].mean(axis=1)
    assert scores[0]["seeds"] == pytest.approx(each.tolist())
    assert scores[0]["ceiling"]["name"] == "still"
    assert "| published overlap, fake | seeds, fake | `still`, fake |" in page.read_text()


def test_the_page_shows_the_zoo_of_the_package() -> None:
    """It was written with the policies that are there."""
    assert PAGE.read_text(encoding="utf-8") == page_text(zoo())


def test_every_policy_of_the_package_is_small_and_has_a_card() -> None:
    """With command, scores on both engines, and a task in whose environment it can act."""
    for name, about in zoo().items():
        assert file_of(name).stat().st_size < 1_000_000
        assert about.card["command"]
        rows: Any = about.card["scores"]
        assert {"mujoco", "bullet"} >= {row["engine"] for row in rows} >= {"mujoco"}
        assert evaluate(name, "P0", n=1, backend="fake", env={"max_episode_length": 2}).task


def replayed(name: str, protocol: str) -> None:
    """Compare a policy's scores with those of its card, episode for episode the same ones."""
    rows: Any = zoo()[name].card["scores"]
    for row in (row for row in rows if row["protocol"] == protocol and "draws" in row):
        draws = row["draws"]
        n = 1 if protocol == "P0" else row["n"] // len(draws)
        found = evaluate(name, protocol, n=n, seeds=draws, backend=row["engine"])
        for metric in row.keys() & {"last_fractional_success", "success", "published_overlap"}:
            score = found.score(protocol, metric).value
            assert score == pytest.approx(row[metric]["value"], abs=1e-4), (row["engine"], metric)


@pytest.mark.parametrize("name", sorted(zoo()))
def test_a_policy_scores_what_its_card_says(name: str) -> None:
    """In the default task, on both engines, with nothing drawn."""
    replayed(name, "P0")


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(zoo()))
def test_a_policy_scores_what_its_card_says_for_other_goals(name: str) -> None:
    """In each of the 160 episodes whose goals were drawn."""
    replayed(name, "P5")


def test_names_that_are_not_there_are_refused(published: str) -> None:
    """The error lists those that are."""
    with pytest.raises(UnknownOption, match="did you mean 'zoo:small'"):
        as_agent("zoo:smal")
    with pytest.raises(UnknownOption, match="name in the zoo"):
        publish(Path("any"), "../out", [])


def test_results_of_another_policy_are_not_published(folder: Path, tmp_path: Path) -> None:
    """Nor the same scores twice, one seed of draws, no command; nothing is written."""
    path = trained(tmp_path / "a.safetensors", card=CARD)
    results = evaluated(path, tmp_path / "results")
    page_path = tmp_path / "zoo.md"
    with pytest.raises(ModelError, match="P0 on fake is there twice"):
        publish(path, "small", [results, results], page=page_path)
    few = evaluated(path, tmp_path / "few", seeds=range(3))
    with pytest.raises(UnknownOption, match=r"seeds of draws .*--seeds 0,1,2,3"):
        publish(path, "small", [few], page=page_path)
    with pytest.raises(UnreadableFile, match="no evaluation of this policy"):
        publish(trained(path, seed=9, card=CARD), "small", [results], page=page_path)
    with pytest.raises(UnknownOption, match="--command"):
        command_of({})
    assert not page_path.exists()
    assert not list(folder.iterdir())


@pytest.mark.parametrize(
    "other",
    [
        {"recipe": recipe("pushing", n_steps=31).as_dict()},
        {"recipe": recipe("pushing", curriculum=2).as_dict()},
        {"recipe": {"task": "pushing", "algo": "ppo"}},
        {"start": "5f52"},
    ],
    ids=["settings", "curriculum", "part", "start"],
)
def test_a_command_that_would_train_something_else_is_not_made_up(other: dict[str, Any]) -> None:
    """Where a recipe is none of the presets the command has to be given."""
    assert command_of(CARD) == COMMAND
    with pytest.raises(UnknownOption, match="--command"):
        command_of({**CARD, **other})


def test_large_policies_are_not_published(folder: Path, tmp_path: Path) -> None:
    """A value network is left out; what is then still too large is refused."""
    given = {**tensors(56, 8, 9), **tensors(56, 500, 500, 1, prefix="value.layers")}
    about = {"task": "pushing", "env": RELATIVE, "card": CARD}
    path = save_policy(tmp_path / "a.safetensors", given, about)
    page_path = tmp_path / "zoo.md"
    results = [evaluated(Path(str(path)), tmp_path / "results", "P0")]
    small = publish(Path(str(path)), "small", results, page=page_path)
    assert small.stat().st_size < 20_000
    assert load_policy(small).value == ()
    publishing_limit = publishing.LARGEST
    assert publishing_limit == 1_000_000
    wide = save_policy(tmp_path / "b.safetensors", tensors(56, 4000, 9), about)
    results = [evaluated(Path(str(wide)), tmp_path / "wide", "P0")]
    with pytest.raises(UnknownOption, match="size of a policy"):
        publish(Path(str(wide)), "wide", results, page=page_path)
    assert [one.name for one in folder.iterdir()] == ["small.safetensors"]


def test_the_command_line_lists_the_zoo(published: str, capsys: pytest.CaptureFixture[str]) -> None:
    """Name, task, seed, scores and command."""
    from scm_world.cli.systems import list_

    list_(zoo=True)
    shown = " ".join(capsys.readouterr().out.split())
    for part in ("zoo:small", "pushing", " 4 ", "P0 0."):
        assert part in shown


def test_a_policy_of_the_zoo_acts_in_a_world_as_in_an_environment() -> None:
    """Its episode is that of the environment that it was trained in, bit for bit."""
    player = as_agent("zoo:pushing")
    assert player.card is not None
    env = ScmWorldEnv("pushing", **player.card.unusual(FORM))
    observation, _ = env.reset(seed=3)
    player.start(env)
    with World("pushing") as world:
        policy = in_world("zoo:pushing", world)
        for seed in (5, 3):  # it begins anew in every episode
            episode = world.rollout(policy, seed=seed, steps=12)
        assert episode.counterfactual({}, at=4, actions=policy) == episode
    for _ in range(12):
        observation, *_ = env.step(player.act(observation))
    assert env.world.vector.tobytes() == episode.vectors[-1].tobytes()

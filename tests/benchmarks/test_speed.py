"""The benchmark of speed measures what it says, and writes it down. No times are asserted."""

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT))  # the scripts are no part of the package

from benchmarks.speed import __main__ as command  # noqa: E402 # from there
from benchmarks.speed import goals, history, tables  # noqa: E402
from benchmarks.speed.batches import beside_the_engine, living, over_worlds  # noqa: E402
from benchmarks.speed.growth import line  # noqa: E402
from benchmarks.speed.memory import resets, resident  # noqa: E402
from benchmarks.speed.parts import PARTS, split, split_batch  # noqa: E402
from benchmarks.speed.scenes import CASES, GROWING, PUSHING, actions, bare, commands  # noqa: E402
from benchmarks.speed.stopwatch import Stopwatch  # noqa: E402
from benchmarks.speed.timing import Settings, in_turns, medians, ratio  # noqa: E402

QUICK = Settings(quick=True)
COSTS = {
    "step": ("env.step [µs]", "raw physics [µs]", "share of raw", "with the log [µs]"),
    "changes": ("reset [µs]", "do: mass [µs]", "do: size [µs]", "snapshot [µs]", "restore [µs]"),
}
PAGE = f"before\n{tables.BEGIN}\nwhat stood here\n{tables.END}\nafter\n"


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder and the page that a quick run of some sections writes."""
    out = tmp_path_factory.mktemp("speed")
    page = out / "page.md"
    page.write_text(PAGE, encoding="utf-8")
    options = ["--quick", "--no-predecessor", "--out", str(out), "--page", str(page)]
    command.main([*options, "--only", "step,changes"])
    command.main([*options, "--only", "growth"])
    return out


def test_sections_measured_apart_are_merged(written: Path) -> None:
    """A second run keeps what the first one measured, with how it was measured."""
    document = json.loads((written / "results.json").read_text(encoding="utf-8"))

    assert set(document["results"]) == {"step", "changes", "growth"} == set(document["when"])
    assert all(how["quick"] for how in document["when"].values())
    assert document["about"]["seed"] == 0
    assert "mujoco" in document["about"]["versions"]


def test_page_is_written_between_its_marks(written: Path) -> None:
    """What stands around the marks stays, what stood between them goes."""
    page = (written / "page.md").read_text(encoding="utf-8")

    assert page.startswith("before\n" + tables.BEGIN)
    assert page.endswith(tables.END + "\nafter\n")
    assert "what stood here" not in page
    assert "## Goals" in page
    assert "cost over steps is a straight line: R², pushing" in page


def test_page_without_marks_is_left_alone(tmp_path: Path) -> None:
    """A page that has no place for tables is an error, not a place for them."""
    page = tmp_path / "page.md"
    page.write_text("nothing", encoding="utf-8")

    with pytest.raises(ValueError, match="needs the lines"):
        tables.put("text", page)
    assert page.read_text(encoding="utf-8") == "nothing"


def test_picture_is_written(written: Path) -> None:
    """The plot is a picture."""
    assert (written / "speed.png").read_bytes().startswith(b"\x89PNG")


def test_every_figure_of_a_scene_is_there(written: Path) -> None:
    """Both engines have every cost of a scene, each a positive number."""
    results = json.loads((written / "results.json").read_text(encoding="utf-8"))["results"]

    for engine in ("mujoco", "bullet"):
        for section, wanted in COSTS.items():
            row = results[section][engine]["pushing"]
            assert all(row[figure] > 0.0 for figure in wanted)


def test_goals_are_judged() -> None:
    """A goal is met, missed or not measured."""
    share = {"blocks": 1, goals.SHARE: 0.91, goals.LOGGED: 0.8}
    late = {"blocks": 35, goals.SHARE: 0.1, goals.LOGGED: 0.1}
    lines = tables.goals({"step": {"mujoco": {"a": share, "b": late}}})
    rows = {text.split("|")[1].strip(): text for text in lines if "|" in text}

    assert any("0.910 | met" in text for text in rows.values())
    assert any("0.800 | **missed**" in text for text in rows.values())
    assert sum("not measured" in text for text in rows.values()) == len(goals.GOALS) - 2


def test_every_goal_reads_one_bound() -> None:
    """A goal has a least or a most, never both."""
    for goal in goals.GOALS:
        assert (goal.least is None) != (goal.most is None)
        assert goal.measured({}) is None
    assert len({goal.title for goal in goals.GOALS}) == len(goals.GOALS)


def test_scenes_have_the_blocks_that_they_name() -> None:
    """1, 2, 5, 10 and 35 blocks are in the worlds."""
    assert [case.blocks for case in GROWING] == [1, 2, 5, 10, 35]
    for case in CASES:
        env = case.env("fake")
        assert len(env.world.composition.blocks) == case.blocks
        env.close()


@pytest.mark.parametrize("engine", ["mujoco", "bullet"])
def test_engine_alone_lives_the_same_episode(engine: str) -> None:
    """What is compared with a step is the same physics, bit for bit."""
    env = PUSHING.env(engine)
    given = actions(20)
    for action in given:
        env.step(action)
    whole = env.world.backend.read().vector.copy()
    told, alone = commands(env, given), bare(env)
    env.reset(seed=0)
    for one in told:
        alone(one)

    np.testing.assert_array_equal(env.world.backend.read().vector, whole)
    env.close()


def test_sides_take_turns() -> None:
    """Every side is asked once in each round, in order, after a round that does not count."""
    seen: list[str] = []

    def side(name: str, value: float) -> Any:
        return lambda: seen.append(name) or value  # type: ignore[func-returns-value]

    rows = in_turns({"a": side("a", 3.0), "b": side("b", 2.0)}, 2)

    assert seen == ["a", "b"] * 3
    assert rows == {"a": [3.0, 3.0], "b": [2.0, 2.0]}
    assert medians(rows)["a"] == 3.0
    assert ratio(rows, "a", "b") == 1.5


def test_stopwatch_gives_time_to_the_part_that_takes_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """A part has the time of its own, not that of the parts that it calls."""
    now = [0.0]
    monkeypatch.setattr("benchmarks.speed.stopwatch.time.process_time", lambda: now[0])
    watch = Stopwatch()

    def wait(seconds: float) -> None:
        now[0] += seconds

    inner = watch.timed("inner", wait)

    def both() -> None:
        inner(3.0)
        wait(1.0)
        inner(2.0)

    watch.timed("outer", both)()

    assert watch.spent() == {"inner": 5.0, "outer": 1.0}


def test_profile_of_a_batch_has_every_part() -> None:
    """What the engine, the mechanisms, the reading and the loop take is told apart."""
    found = split_batch(PUSHING, 4, QUICK)

    assert tuple(found) == PARTS
    assert all(found[part] > 0.0 for part in ("physics", "mechanisms", "observation", "the rest"))


def test_batch_and_plain_loop_live_the_same_episodes() -> None:
    """A batch is compared with single worlds of the same seeds and actions."""
    found = beside_the_engine(PUSHING, 3, QUICK)

    assert found["step of a world [µs]"] > 0.0 < found["raw physics [µs]"]
    assert set(over_worlds(PUSHING, QUICK)) >= {"1 [µs]", "8 [µs]", "R²"}


def test_every_world_begins_anew_once() -> None:
    """Control steps are counted with the resets that fall due."""
    assert living(PUSHING, 3, QUICK)["episodes that ended"] == 3.0


def test_profile_has_every_part() -> None:
    """Physics and everything around it are told apart, and physics is the largest."""
    found = split(PUSHING, "mujoco", QUICK)

    assert tuple(found) == PARTS
    assert max(found, key=found.__getitem__) == "physics"


def test_memory_is_read(monkeypatch: pytest.MonkeyPatch) -> None:
    """A process has megabytes, and resets are counted."""
    monkeypatch.setattr("benchmarks.speed.memory.LOOKS", 4)  # each collects all garbage
    before = resident()
    found = resets(PUSHING, "fake", 40)

    assert before > 1e6
    assert found["resets"] == 40


def test_line_is_fitted() -> None:
    """Slope, offset and what they leave, in the units that are named."""
    found = line([1, 2, 3], [2e-3, 3e-3, 4e-3], "each [µs]", 1e6)

    assert found["each [µs]"] == pytest.approx(1000.0)
    assert found["at zero [ms]"] == pytest.approx(1.0)
    assert found["R²"] == pytest.approx(1.0)


def test_unknown_section_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    """The message lists what there is."""
    with pytest.raises(SystemExit):
        command.arguments(["--only", "stepp"])
    assert "there is no 'stepp'; there are step, predecessor" in capsys.readouterr().err


def test_a_broken_section_does_not_take_the_others(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """What else was asked is measured and written; the exit says what broke."""

    def breaks(_: Settings) -> dict[str, Any]:
        raise RuntimeError("no room")

    monkeypatch.setitem(command.SECTIONS, "step", breaks)
    monkeypatch.setitem(command.SECTIONS, "growth", lambda _: {})
    monkeypatch.setitem(command.SECTIONS, "import", lambda _: {"scm_world [s]": 0.1})
    with pytest.raises(SystemExit, match="these broke: step"):
        command.main(["--only", "step,growth,import", "--out", str(tmp_path)])

    document = json.loads((tmp_path / "results.json").read_text(encoding="utf-8"))
    assert document["results"] == {"import": {"scm_world [s]": 0.1}}
    assert "no room" in capsys.readouterr().err


ABOUT = {
    "processor": "Some processor",
    "cores": 2,
    "system": "Linux x86_64",
    "versions": {"scm-world": "0.3.0"},
}


def test_history_has_a_line_for_each_release_and_machine(tmp_path: Path) -> None:
    """A second run of a release replaces the first; other releases and machines stay."""
    path, title = (
        tmp_path / "history.jsonl",
        "64 pushing worlds on two threads: times as fast as on one, wall",
    )
    measured = {"batch": {"mujoco": {"pushing": {"2 threads to 1: ratio": 1.5}}}}
    newer = {**ABOUT, "versions": {"scm-world": "0.4.0"}}
    for about in (ABOUT, newer, {**newer, "cores": 8}):
        history.record(about, measured, quick=True, path=path)
    measured["batch"]["mujoco"]["pushing"]["2 threads to 1: ratio"] = 1.75
    history.record(newer, measured, quick=False, path=path)

    rows = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
    assert rows == history.read(path)
    found = [(row["version"], row["machine"], row["quick"], row["figures"]) for row in rows]
    assert found == [
        ("0.3.0", "Some processor, 2 cores, Linux x86_64", True, {title: 1.5}),
        ("0.4.0", "Some processor, 8 cores, Linux x86_64", True, {title: 1.5}),
        ("0.4.0", "Some processor, 2 cores, Linux x86_64", False, {title: 1.75}),
    ]
    assert rows[0]["commit"]

    page, picture = tmp_path / "speed.md", tmp_path / "history.png"
    page.write_text("a\n<!-- history: begin -->\nold\n<!-- history: end -->\nb\n", encoding="utf-8")
    history.publish(rows, page, picture)
    assert "(../images/history.png)" in page.read_text(encoding="utf-8")
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_a_busy_machine_is_not_recorded(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """It is refused before anything is measured; rough figures never replace the others."""
    monkeypatch.setattr(command.os, "getloadavg", lambda: (8.0, 8.0, 8.0))
    monkeypatch.setattr(command.os, "cpu_count", lambda: 4)
    with pytest.raises(SystemExit):
        command.arguments(["--quick", "--record"])
    assert "the load is 2.00 a core" in capsys.readouterr().err
    quick = command.arguments(["--quick"])
    quick.out.rmdir()
    assert (quick.out == command.HERE, quick.page) == (False, None)
    assert command.arguments([]).out == command.HERE
    monkeypatch.setattr(command.os, "getloadavg", lambda: (0.9, 8.0, 8.0))
    assert command.arguments(["--record"]).record

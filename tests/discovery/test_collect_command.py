"""``scm-world collect``: what it writes, says and refuses."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from typer.testing import CliRunner

from scm_world.cli.app import app
from scm_world.discovery.data import load

pytest.importorskip("pyarrow")

COMMAND = ["collect", "pushing", "--backend", "fake", "--steps", "2", "--shard", "5"]


def test_the_command_collects(tmp_path: Path) -> None:
    """It says how often each target was one, and where the files are."""
    arguments = ["--n", "12", "--target", "tool_block.*ss", "--outcome", "max:reward"]
    more = ["--cause", "gravity", "--nature", "sensor_noise=0.01", "--out", str(tmp_path)]
    done = CliRunner().invoke(app, [*COMMAND, *arguments, *more])
    assert done.exit_code == 0, done.output
    assert "do(tool_block.mass)" in done.output
    found = load(tmp_path)
    assert found.variables == ("gravity", "tool_block.mass", "max reward")
    assert len(found) == 12
    assert CliRunner().invoke(app, [*COMMAND, *arguments, *more]).exit_code == 0


def test_the_command_refuses_in_one_line(tmp_path: Path) -> None:
    """A typo gives exit code 2 and no folder."""
    for wrong in (["--values", "C"], ["--design", "sigle"], ["--target", "tool_blok.*"]):
        done = CliRunner().invoke(app, [*COMMAND, *wrong, "--out", str(tmp_path / "new")])
        assert done.exit_code == 2, done.output
    assert not (tmp_path / "new").exists()


def test_ctrl_c_on_the_command_line(tmp_path: Path) -> None:
    """It exits 130, says how many files are safe, and the same command goes on."""
    command = [sys.executable, "-m", "scm_world", *COMMAND, "--n", "3000", "--out"]
    with subprocess.Popen(  # noqa: S603 # our own text
        [*command, str(tmp_path)], stdout=subprocess.PIPE, text=True
    ) as process:
        while process.poll() is None and len(list(tmp_path.glob("shard-*"))) < 2:
            time.sleep(0.001)
        process.send_signal(signal.SIGINT)
        text = process.communicate()[0]
    assert process.returncode == 130
    there = len(list(tmp_path.glob("shard-*")))
    assert f"interrupted: {there} of 600 files are safe" in text
    assert len(load(tmp_path, partial=True)) == 5 * there


def test_the_command_writes_pairs_of_pictures(tmp_path: Path) -> None:
    """With a description; what is no factor is refused, and Ctrl-C is resumed as in Python."""
    command = [
        "triplets",
        "pushing",
        "--backend",
        "fake",
        "-n",
        "5",
        "--shard",
        "3",
        "--size",
        "16",
    ]
    given = ["--factor", "tool_block.color", "--factor", "light_*", "--camera", "60"]
    out = ["--do", "gravity=[0,0,-5]", "--croissant", "--out", str(tmp_path / "pairs")]
    for _ in range(2):
        done = CliRunner().invoke(app, [*command, *given, *out])
        assert done.exit_code == 0, done.output
    assert "5 pairs of pictures with 3 factors, in 2 files" in done.output
    assert {path.name for path in (tmp_path / "pairs").iterdir()} == {
        "README.md", "croissant.json", "study.json",
        *(f"triplets-{i:05d}-of-00002.parquet" for i in range(2)),
    }  # fmt: skip
    for wrong in (["--factor", "tool_blok.*"], ["--camera", "61"]):
        done = CliRunner().invoke(app, [*command, *wrong, "--out", str(tmp_path / "new")])
        assert done.exit_code == 2, done.output


def test_the_command_collects_pictures(tmp_path: Path) -> None:
    """Beside the rows; of the goals only where asked."""
    parquet = pytest.importorskip("pyarrow.parquet")
    given = ["--n", "2", "--picture", "usual", "--picture-size", "16", "--out", str(tmp_path)]
    done = CliRunner().invoke(app, [*COMMAND, *given])
    assert done.exit_code == 0, done.output
    names = parquet.read_schema(tmp_path / "pictures-00000.parquet").names
    assert names == ["episode", "step", "first_image", "image"]

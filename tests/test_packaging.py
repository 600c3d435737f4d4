"""Facts about what is released."""

from __future__ import annotations

import json
import re
import tomllib
from pathlib import Path

import yaml

import scm_world

ROOT = Path(__file__).parent.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())


def test_the_version_is_said_once_and_quoted_alike() -> None:
    """The package has it; what cites, deposits, packs or lists the package says the same."""
    assert PROJECT["project"]["dynamic"] == ["version"]
    assert PROJECT["tool"]["hatch"]["version"]["path"] == "scm_world/__init__.py"
    heads = re.findall(r"^## (\S+)", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    said = {
        yaml.safe_load((ROOT / "CITATION.cff").read_text())["version"],
        json.loads((ROOT / ".zenodo.json").read_text())["version"],
        yaml.safe_load((ROOT / "recipe" / "recipe.yaml").read_text())["context"]["version"],
        heads[0],
    }
    assert said == {scm_world.__version__}


def test_conda_gets_the_same_libraries_as_pip() -> None:
    """Every library but Bullet is in the recipe, in a version that is allowed here."""
    needed = {line.partition(";")[0].strip() for line in PROJECT["project"]["dependencies"]}
    needed -= {"pybullet==3.2.7", "numpy>=1.26,!=2.0.0"}  # it takes the stricter one, of Windows
    recipe = yaml.safe_load((ROOT / "recipe" / "recipe.yaml").read_text())
    listed = {line.replace(" ", "") for line in recipe["requirements"]["run"]}
    other = {"mujoco-python": "mujoco", "matplotlib-base": "matplotlib"}
    renamed = {re.sub(r"^[\w-]+", lambda name: other.get(name[0], name[0]), one) for one in listed}
    assert renamed == needed | {"python>=${{python_min}}"}


def test_all_has_every_extra_for_users() -> None:
    """It leaves out tools of developers, and the platform of the robot with its old libraries."""
    extras = PROJECT["project"]["optional-dependencies"]
    listed = re.findall(r"[\w-]+", extras["all"][0].partition("[")[2])
    assert set(listed) == set(extras) - {"all", "test", "dev", "trifinger"}

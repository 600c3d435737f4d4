"""``scm-world list``."""

from __future__ import annotations

from rich.text import Text

from scm_world.backends import backends, make_backend
from scm_world.cli.console import console, table
from scm_world.discovery.learners import Learner, learners
from scm_world.discovery.problems import FAMILIES
from scm_world.env import IDS
from scm_world.errors import EngineError
from scm_world.evaluation import protocols_of
from scm_world.policies import PolicyAbout
from scm_world.policies.zoo import best_known, zoo
from scm_world.tasks import CONVENTIONS, TASKS
from scm_world.tasks.trifinger.entities.robot import ACTIONS
from scm_world.tasks.trifinger.presets import PRESETS


def _first_line(text: str | None) -> str:
    return (text or "").strip().partition("\n")[0]


def _engine(name: str) -> Text:
    """Say which version of an engine there is, or why there is none."""
    try:
        backend = make_backend(name)
    except EngineError as error:
        return Text(f"not available: {error}", style="yellow")
    try:
        return Text(f"available, version {backend.version}", style="green")
    finally:
        backend.close()


def _learner(chosen: Learner) -> Text:
    """Say what a learner does, what it takes, and whether it is there."""
    missing = "" if chosen.is_installed else f"; needs the extra {chosen.extra!r}"
    return Text(f"{chosen.doc} ({', '.join(chosen.takes)}{missing})")


def _protocols() -> dict[str, str | Text]:
    """Say what each protocol varies, where tasks differ in the words of pushing."""
    common = {protocol.name: protocol.doc for protocol in protocols_of("pushing")}
    more = {protocol.name: protocol.doc for protocol in protocols_of("reaching")}
    only = {name: f"{doc}; reaching only" for name, doc in more.items() if name not in common}
    return {**common, **only}


def _trained(about: PolicyAbout) -> str:
    """Say for what a policy was trained, and how well it does."""
    scores = best_known(about)
    return f"{about.task}: {scores}" if scores else about.task


def show_zoo() -> None:
    """List the trained policies: how each was made, and how well it does."""
    made = table("name", "task", "seed", "scores", "command", title="trained policies")
    cards = zoo()
    for name, about in cards.items():
        seed, command = about.card.get("seed", ""), about.card.get("command", "")
        cells = (name, about.task, str(seed), best_known(about), str(command))
        made.add_row(*map(Text, cells))
    console().print(made if cards else "there are no trained policies in this installation")


def run() -> None:
    """List what can be chosen."""
    made = table("", "name", "")
    made.show_header = False
    sections: dict[str, dict[str, str | Text]] = {
        "tasks": {name: _first_line(task.__doc__) for name, task in TASKS.items()},
        "backends": {name: _engine(name) for name in backends()},
        "presets": {p.name: f"physics steps of {1000 * p.timestep:g} ms" for p in PRESETS.values()},
        "action modes": {name: unit for name, (unit, _) in ACTIONS.items()},
        "conventions": dict.fromkeys(CONVENTIONS, ""),
        "learners": {name: _learner(chosen) for name, chosen in learners().items()},
        "protocols": _protocols(),
        "trained policies": {name: _trained(about) for name, about in zoo().items()},
        "families": {f"{name}:N": _first_line(draw.__doc__) for name, draw in FAMILIES.items()},
        "environments": {name: f"gymnasium.make({name!r})" for name in IDS},
    }
    for title, rows in sections.items():
        for number, (name, about) in enumerate(rows.items()):
            made.add_row(Text("" if number else title, style="bold"), name, about)
        made.add_section()
    console().print(made)

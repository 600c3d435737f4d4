"""The process of a session: one world, its twin, and the requests of the page.

Messages come from a pipe as dicts with ``op`` and ``id``; replies and news go back as dicts, frames
as bytes. What a message asks for happens completely, or it gets an error and nothing changes.
"""

from __future__ import annotations

import sys
import tempfile
import time
import warnings
from base64 import b64encode
from collections.abc import Mapping
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Annotated, Any, Literal, final

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError, validate_call

from scm_world._types import Floats, Value
from scm_world.errors import EngineFailure, ScmWorldError, UnknownOption, in_one_line
from scm_world.policies.scripted import Policy
from scm_world.policies.zoo import PREFIX as ZOO
from scm_world.queries import Episode, save_episode
from scm_world.studio.reading import (
    Bundles,
    audited,
    cut_off,
    described,
    in_words,
    marks,
    nearest,
    plain,
)
from scm_world.studio.scene import SentShapes, frame, packed, touching
from scm_world.studio.spec import PipedProcess, Spec
from scm_world.tasks import WorldSource
from scm_world.variables import Draw, Hard, Natural, Scale, Shift
from scm_world.variables.spaces import problems_of

FRAMES, NEWS = 60.0, 15.0  # most frames and reports of a second
LATE = 0.25  # [s] by how much a world that plays may be late before it gives up catching up
MOST_LINES = 2000
MOST_SERIES = 12  # outcomes that are drawn over time
FACTUAL, TWIN = 0, 1

Step = Annotated[int, Field(ge=0)]
Finite = Annotated[float, Field(allow_inf_nan=False)]
Lane = Literal[0, 1]
Chosen = str | list[float] | None
"""The name of a policy, an action that is kept, or nobody."""


class Act(BaseModel):
    """An intervention on one variable, as the page sends it."""

    model_config = ConfigDict(extra="forbid")
    kind: Literal["hard", "shift", "scale", "draw"] = "hard"
    value: Finite | list[Finite] | str | None = None  # or by how much it is shifted or scaled
    source: Literal["A", "B", "A|B"] = "A"  # the space that is drawn from
    start: Step | None = None  # now if None
    stop: Step | None = None  # a window without it has no end
    window: bool = False  # whether it is held until then

    def part(self, now: int) -> tuple[Any, str]:
        """Return it as ``do`` takes it, and as Python."""
        kinds: dict[str, Any] = {"hard": Hard, "shift": Shift, "scale": Scale, "draw": Draw}
        kind = kinds[self.kind]
        value = self.source if kind is Draw else self.value
        if value is None:
            raise UnknownOption("value", None, ("a number", "a list of numbers"))
        start = now if self.start is None else self.start
        later: dict[str, Any] = {"at": start} if start != now else {}
        time = {"during": (start, self.stop)} if self.window else later
        if kind is Hard and not time:
            return value, repr(value)
        given = ", ".join([repr(value), *(f"{name}={when!r}" for name, when in time.items())])
        return kind(value, **time), f"sw.{kind.__name__}({given})"


@final
class _LaneState:
    """The factual or the counterfactual episode, and its values at every instant from the first."""

    def __init__(self, live: Episode, first: int = 0) -> None:
        self.live, self.first = live, first
        self.rows: list[dict[str, Value]] = []
        self.contacts: list[tuple[Floats, frozenset[tuple[str, str]]]] = []
        self.look()

    def look(self) -> None:
        """Write down the present instant, once more if it was changed."""
        at, world = self.live.steps - self.first, self.live.world
        del self.rows[at:], self.contacts[at:]
        if self.rows:  # the command of a step stands in the row in which it was chosen
            self.rows[-1] |= {n: np.array(v) for n, v in world.decided_values().items()}
        self.rows.append(world.values())
        self.contacts.append(
            touching(world.backend.contacts() if world.backend is not None else ())
        )


@final
class Session:
    """One world, and the page that looks at it."""

    def __init__(self, spec: Spec, pipe: Connection, read: WorldSource | None = None) -> None:
        self._spec, self._pipe = spec, pipe
        self.world = spec.make(read)
        self._shapes = SentShapes()
        self._playing, self._speed, self._next = False, 1.0, 0.0
        self._looking: int | None = None
        self._watched = ""
        self._plotted: tuple[str, ...] = ()
        self._sent_rows = [0, 0]
        self._last_frame = self._last_news = 0.0
        self._compiled: object = None
        self._lines = [(line, 1) for line in spec.code()]
        self._new_lines = True
        self._policy: Chosen = None
        self._job: PipedProcess | None = None
        self._kind = ""  # of the job
        self._lanes: list[_LaneState] = []
        self.reset()
        self._describe()

    # --- the loop -------------------------------------------------------------------------------

    def run(self) -> None:
        """Answer messages and play, until the server has gone."""
        while True:
            pause = None
            if self._playing:
                pause = max(0.0, self._next - time.monotonic())
            pipes = [self._pipe, *([self._job.pipe] if self._job else [])]
            ready = wait(pipes, pause)
            if self._job and self._job.pipe in ready:
                self._news_of_job(self._job)
            if self._pipe in ready:
                try:
                    message = self._pipe.recv()
                except (EOFError, OSError):  # also in the middle of a message
                    break
                self._pipe.send(self._answer(message))
                self._show(force=True)
            elif self._playing and time.monotonic() >= self._next:
                self._play_on()
        if self._job:
            self._job.close(0.0)
        self._lanes[FACTUAL].live.close()

    def _play_on(self) -> None:
        period = self._period / self._speed
        now = time.monotonic()
        self._next = self._next + period if now - self._next < LATE else now + period
        if self._looking is not None:
            self._looking += 1
            if self._looking >= self._steps:
                self._looking, self._playing = None, False
        else:
            try:
                self._advance(1)
            except ScmWorldError as error:
                self._playing = False
                self._pipe.send({"type": "trouble", "error": str(error)})
            world = self.world
            if world.backend is not None and self._steps % world.max_episode_length == 0:
                self._playing = False
        self._show(force=not self._playing)

    def _answer(self, message: object) -> dict[str, Any]:
        """Handle a message; return the reply."""
        number = message.get("id") if isinstance(message, dict) else None
        try:
            if not isinstance(message, dict) or not isinstance(message.get("op"), str):
                raise UnknownOption("message", type(message).__name__, ("an object with 'op'",))
            given = {key: value for key, value in message.items() if key not in ("op", "id")}
            if message["op"] not in OPS:
                raise UnknownOption("op", message["op"], (*OPS,))
            try:
                found = OPS[message["op"]](self, **given)
            except ValidationError as error:
                raise UnknownOption("message", message["op"], problems_of(error)) from error
            except TypeError as error:
                raise UnknownOption("message", message["op"], (in_one_line(error),)) from error
        except ScmWorldError as error:
            if isinstance(error, EngineFailure):
                self._playing = False
            return {"type": "reply", "id": number, "error": str(error), "nearest": nearest(error)}
        except Exception as error:  # of a user's function; the page says so and stays
            return {"type": "reply", "id": number, "error": in_one_line(error), "nearest": []}
        return {"type": "reply", "id": number, "ok": found}

    # --- showing --------------------------------------------------------------------------------

    @property
    def _steps(self) -> int:
        return self._lanes[FACTUAL].live.steps

    def _describe(self) -> None:
        """Describe the system for the page, before anything moves."""
        world = self._lanes[FACTUAL].live.world
        self._compiled, self._edges = world.compiled, Bundles(world)
        self._hello = {"type": "hello", **described(self._spec, world, self._edges)}
        self._period: float = self._hello["dt"]

    def _show(self, *, force: bool = False) -> None:
        """Send frames and news, not more often than a page can show."""
        now = time.monotonic()
        if force or now - self._last_frame >= 1.0 / FRAMES:
            self._last_frame = now
            for number in range(len(self._lanes)):
                self._send_frame(number)
        if force or now - self._last_news >= 1.0 / NEWS:
            self._last_news = now
            self._send_news()

    def _send_frame(self, number: int) -> None:
        lane, scene = self._lanes[number], None
        live = lane.live
        step = live.steps if self._looking is None else self._looking
        if live.world.backend is not None:  # of the past that of the record, not drawn again
            scene = live.world.scene() if step >= live.steps else live.episode().scene(step)[0]
        shapes, poses, vertices, message = self._shapes.place(scene)
        if message is not None:
            self._pipe.send(packed(message))
        contacts = lane.contacts[step - lane.first][0] if step >= lane.first else np.zeros((0, 7))
        self._pipe.send(frame(number, shapes, step, poses, contacts, vertices))

    def _send_news(self) -> None:
        live = self._lanes[FACTUAL].live
        if live.world.compiled is not self._compiled:
            self._describe()
            self._pipe.send(self._hello)
        step = self._steps if self._looking is None else self._looking
        values, rows = [], []
        for number, lane in enumerate(self._lanes):
            row = self._row(lane, step)
            shown = {self._watched, *self._plotted}
            values.append({name: plain(row[name]) for name in shown if name in row})
            first, end = self._sent_rows[number], lane.live.steps + 1
            since = [self._row(lane, at) for at in range(first, end)]
            series = {name: [plain(row.get(name)) for row in since] for name in self._plotted}
            rows.append({"first": first, "values": series})
            self._sent_rows[number] = max(first, end - 1)  # the present may still change
        news: dict[str, Any] = {
            "type": "news",
            "step": step,
            "steps": self._steps,
            "time": step * self._period,
            "playing": self._playing,
            "past": self._looking is not None,
            "held": [
                [[name, in_words(act)] for name, act in lane.live.held.items()]
                for lane in self._lanes
            ],
            "cut": cut_off(live.world, live.held),
            "twin": self._lanes[TWIN].first if len(self._lanes) > 1 else None,
            "values": values,
            "rows": rows,
            "lit": self._edges.lit(self._lanes[FACTUAL].contacts[step][1]),
            "policy": "sliders" if isinstance(self._policy, list) else self._policy or "",
        }
        if self._new_lines:
            news["python"], self._new_lines = self._code(), False
        self._pipe.send(news)

    def _row(self, lane: _LaneState, step: int) -> Mapping[str, Value]:
        """Return all values at an instant; before the split, those of the factual episode."""
        lane = lane if step >= lane.first else self._lanes[FACTUAL]
        return lane.rows[step - lane.first]

    # --- Python ---------------------------------------------------------------------------------

    def _note(self, *lines: str, again: bool = False) -> None:
        """Add lines of Python; a step that follows an equal one becomes a loop."""
        if again and self._lines[-1][0] == lines[0]:
            self._lines[-1] = lines[0], self._lines[-1][1] + 1
        else:
            self._lines += [(line, 1) for line in lines]
        del self._lines[:-MOST_LINES]
        self._new_lines = True

    def _code(self) -> list[str]:
        looped = (
            [f"for _ in range({n}):", f"    {one}"] if n > 1 else [one] for one, n in self._lines
        )
        return [line for lines in looped for line in lines]

    # --- what the page asks for -----------------------------------------------------------------

    def reset(self, seed: Step = 0, number: Step = 0) -> None:
        """Begin an episode; the twin ends."""
        policy, code = self._acting(self._policy)
        live = self.world.live(policy, seed=seed, episode=number)
        for lane in self._lanes:
            lane.live.close()
        self._looking, self._playing = None, False
        self._lanes, self._sent_rows = [_LaneState(live)], [0, 0]
        of = "" if not number else f", episode={number}"
        by = "" if self._policy is None else f"{code}, "
        self._note(f"live = world.live({by}seed={seed}{of})")

    def _advance(self, count: int) -> None:
        factual = self._lanes[FACTUAL]
        for _ in range(count):
            twin = self._lanes[TWIN] if len(self._lanes) > 1 else None
            before = self._steps
            try:
                action = factual.live.step()
            finally:
                if self._steps > before:
                    factual.look()
            if twin is not None:
                try:
                    twin.live.step(action)
                finally:
                    twin.look() if twin.live.steps > before else self.join()
            self._note("live.step()" if twin is None else "twin.step(live.step())", again=True)

    def play(self, speed: Annotated[float, Field(gt=0.0, le=100.0)] = 1.0) -> None:
        """Play in real time, times a factor: the recorded part, then the world."""
        self._speed, self._playing, self._next = speed, True, time.monotonic()

    def pause(self) -> None:
        """Stay at this instant."""
        self._playing = False

    def step(self, n: Annotated[int, Field(ge=1, le=1000)] = 1) -> None:
        """Take control steps; in the past, go forward over the recorded part."""
        self._playing = False
        if self._looking is not None:
            return self.look(min(self._looking + n, self._steps))
        self._advance(n)
        return None

    def look(self, step: Step | None = None) -> None:
        """Show an instant of the episode; at the present one if None."""
        if step is not None and step > self._steps:
            raise UnknownOption("step", step, (f"a control step from 0 to {self._steps}",))
        self._playing = False
        self._looking = None if step == self._steps else step

    def policy(self, name: str | None = None, action: list[Finite] | None = None) -> None:
        """Choose who acts: nobody, a policy by its name, or an action that is kept."""
        if action is not None:
            self._lanes[FACTUAL].live.world.compiled.clipped(action)
        chosen: Chosen = name if action is None else action
        self._lanes[FACTUAL].live.policy, code = self._acting(chosen)
        self._policy = chosen
        self._note(f"live.policy = {code}")

    def _acting(self, chosen: Chosen) -> tuple[Policy | Chosen, str]:
        """Return a policy as ``live`` takes it, and as Python; those of the zoo observe."""
        if not (isinstance(chosen, str) and chosen.startswith(ZOO)):
            return chosen, repr(chosen)
        from scm_world.evaluation import in_world  # slow to import

        return in_world(chosen, self.world), f"in_world({chosen!r}, world)"

    def plot(self, names: list[str]) -> None:
        """Choose the outcomes that are drawn over time."""
        if len(names) > MOST_SERIES:
            raise UnknownOption("number of outcomes", len(names), (f"at most {MOST_SERIES}",))
        for name in names:
            self._lanes[FACTUAL].live.world.model.declared(name)
        self._plotted, self._sent_rows = tuple(names), [0, 0]

    def inspect(self, name: str) -> dict[str, Any]:
        """Describe a variable as it is now: value, bounds, spaces; news have its value from now."""
        world = self._lanes[FACTUAL].live.world
        step = self._steps if self._looking is None else self._looking
        values = self._row(self._lanes[FACTUAL], step)
        variable = world.model.declared(name)
        self._watched = name
        spaces = {"bounds": variable.bounds, "a": variable.a, "b": variable.b}
        return {
            "name": variable.name,
            "value": plain(values[variable.name]),
            **{key: marks(space, variable.shape, values) for key, space in spaces.items()},
        }

    def do(self, name: str, act: Act, lane: Lane = 0) -> dict[str, Any]:
        """Intervene at the present instant, and audit it."""
        chosen = self._lane(lane)
        if self._looking is not None:
            past = "the present instant; at an earlier one, split the episode"
            raise UnknownOption("instant of do", self._looking, (past,))
        part, code = act.part(chosen.live.steps)
        audit = chosen.live.do({name: part})
        chosen.look()
        first = f"{('live', 'twin')[lane]}.do({{{name!r}: "
        last = self._lines[-1][0]
        if last.startswith(first) and "sw.Draw" not in last:
            self._lines.pop()  # at one instant, the last one counts
        self._note(f"{first}{code}}})")
        return audited(audit)

    def release(self, name: str, lane: Lane = 0) -> dict[str, Any]:
        """Hand a variable back to its own mechanism."""
        chosen = self._lane(lane)
        if name not in chosen.live.held:
            raise UnknownOption(
                "intervention in force", name, tuple(chosen.live.held) or ("nothing",)
            )
        audit = chosen.live.do({name: Natural()})
        chosen.look()
        self._note(f"{('live', 'twin')[lane]}.do({{{name!r}: sw.Natural()}})")
        return audited(audit)

    def _lane(self, lane: int) -> _LaneState:
        if lane >= len(self._lanes):
            raise UnknownOption("lane", lane, ("0: without a twin; split the episode first",))
        return self._lanes[lane]

    def split(self, at: Step | None = None, do: dict[str, Act] | None = None) -> None:
        """Run the counterfactual beside the episode: same noise and actions, from an instant on."""
        factual = self._lanes[FACTUAL]
        here = self._steps if self._looking is None else self._looking
        place = here if at is None else at
        parts = {name: act.part(place) for name, act in (do or {}).items()}
        live = factual.live.split({n: part for n, (part, _) in parts.items()}, at=place)
        twin, actions = _LaneState(live, place), factual.live.actions[place:]
        try:
            for action in actions:
                live.step(action)
                twin.look()
        except ScmWorldError:
            live.close()
            raise
        self.join()
        self._lanes.append(twin)
        code = ", ".join(f"{name!r}: {code}" for name, (_, code) in parts.items())
        replay = [f"for action in live.actions[{place}:]:", "    twin.step(action)"]
        self._note(f"twin = live.split({{{code}}}, at={place})", *(replay if len(actions) else ()))

    def join(self) -> None:
        """End the twin."""
        if len(self._lanes) > 1:
            self._lanes.pop().live.close()
            self._sent_rows[TWIN] = 0
            self._note("twin.close()")

    def greet(self, coarse: bool = False) -> None:
        """Send everything once more, to a page that has come; coarse if it draws by software."""
        self._shapes = SentShapes(coarse=coarse)
        self._sent_rows, self._new_lines = [0, 0], True
        self._pipe.send(self._hello)

    # --- jobs -----------------------------------------------------------------------------------

    def experiment(
        self,
        kind: Literal["discover", "verify"],
        probes: Annotated[int, Field(ge=1, le=10_000)] = 16,
        seed: Step = 0,
    ) -> None:
        """Recover the graph from experiments, or test the declared one, in another process."""
        if self._job is not None:
            raise UnknownOption("job", kind, (f"cancel {self._kind} first",))
        from scm_world.studio.jobs import experiment  # slow to import

        given, self._kind = (self._spec, kind, probes, seed), kind
        self._job = PipedProcess(experiment, *given, daemon=True)
        self._note(f"report = sw.{kind}(world, probes={probes}, seed={seed})")

    def cancel(self) -> None:
        """Interrupt discovery or verification; the report covers the finished part."""
        if self._job is None:
            raise UnknownOption("job", None, ("one that runs",))
        self._job.interrupt()

    def _news_of_job(self, job: PipedProcess) -> None:
        try:
            self._pipe.send(job.pipe.recv())
        except EOFError:
            self._job = None
            job.close()
            self._pipe.send({"type": "job", "kind": self._kind, "ended": True})

    # --- files ----------------------------------------------------------------------------------

    def save(self, what: Literal["episode", "plan"], lane: Lane = 0) -> dict[str, Any]:
        """Return a file: an episode, or the plan of interventions."""
        live = self._lane(lane).live
        title = self._spec.title.partition(".")[0].replace(":", "-")
        stem = f"{title}-{('factual', 'twin')[lane]}"
        if what == "plan":
            return {"name": f"{stem}-plan.json", "text": live.plan.to_json()}
        with tempfile.TemporaryDirectory(prefix="scm-world-") as folder:
            content = save_episode(live.episode(), Path(folder) / "episode.npz").read_bytes()
        return {"name": f"{stem}.npz", "base64": b64encode(content).decode()}


OPS = {
    name: validate_call(getattr(Session, name))
    for name in (
        *("play", "pause", "step", "look", "reset", "policy", "plot", "inspect", "do"),
        *("release", "split", "join", "greet", "experiment", "cancel", "save"),
    )
}
"""What a message may ask for."""


def work(spec: Spec, pipe: Connection) -> None:
    """Run a session, in the process that the server starts."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # they are among the notes
            read = spec.read()
        for note in getattr(getattr(read.made, "system", None), "notes", ()):
            sys.stderr.write(f"note: {note}\n")
        pipe.send({"type": "read"})
        Session(spec, pipe, read).run()
    except (BrokenPipeError, EOFError):
        return
    except Exception as error:
        ours = isinstance(error, ScmWorldError | OSError)
        pipe.send(error if ours else ScmWorldError(in_one_line(error)))

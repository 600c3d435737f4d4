"""What an agent has inferred: probes of its hidden state, and twins in which a cause is set.

A probe says whether a hidden state shows a cause, not whether the agent uses it. A twin says how
the actions change with the cause, and by which way: the state that the agent sees, or its memory.

Source:
    Alain and Bengio, *Understanding intermediate layers using linear classifier probes*, 2016;
    Hewitt and Liang, *Designing and interpreting probes with control tasks*, EMNLP 2019, for the
    controls.
"""

from __future__ import annotations

import io
import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field, replace
from hashlib import blake2b
from typing import Any, final

import numpy as np

from scm_world._arguments import typed, whole_number
from scm_world._patterns import as_names
from scm_world._types import Floats, Observation
from scm_world.curricula import Situation, at_step, resample, together
from scm_world.env import ScmWorldEnv
from scm_world.errors import UnknownOption
from scm_world.evaluation.episodes import Hook, placed, play, under
from scm_world.evaluation.preparation import prepare
from scm_world.evaluation.protocols import Protocol
from scm_world.evaluation.recording import parts
from scm_world.evaluation.setups import Setup, Shard
from scm_world.evaluation.statistics.causes import FEWEST, useless
from scm_world.evaluation.statistics.intervals import LEVEL, Interval, mean_interval
from scm_world.evaluation.statistics.probes import probe
from scm_world.evaluation.verdicts import (
    END,
    HIDDEN,
    OBSERVATION,
    PARTS,
    SHUFFLED,
    UNTRAINED,
    CauseProbe,
    Change,
    Inferred,
)
from scm_world.policies.agents import Actions, Agent
from scm_world.queries.progress import Progress
from scm_world.runs.files import Location, read_arrays
from scm_world.runs.pool import Pool, pool_of
from scm_world.runs.processes import single_threaded
from scm_world.runs.study import Study
from scm_world.tasks import AnySource
from scm_world.variables import Noise

STEPS = (5, 25, 100)
FLIPS = 1000
OTHER = 2**30
"""Added to the number of an episode: the episode from which a twin has its value of the cause."""
LOGARITHMIC = ("loguniform", "reciprocal", "lognorm")
"""Families of distributions whose values are probed on a logarithmic scale."""
AGENT, PRIVILEGED = ("agent", 0), ("privileged", 0)

Arrays = dict[str, Floats]


class _Watch(Hook):
    """Keeps hidden states, present observations and causes at some control steps."""

    def __init__(self, agent: Agent, untrained: Agent | None, names: Sequence[str]) -> None:
        self._agents = {HIDDEN: agent} | ({} if untrained is None else {UNTRAINED: untrained})
        self._names, self.kept = tuple(names), dict[int, Arrays]()

    def begin(self, env: ScmWorldEnv, observation: Observation) -> None:
        """Begin an episode, also of the untrained network."""
        self._env = env
        if UNTRAINED in self._agents:
            self._agents[UNTRAINED].start(env)

    def choose(self, observation: Observation, action: Actions) -> Actions:
        """Look at a control step; the untrained network sees the same observation."""
        if UNTRAINED in self._agents:
            self._agents[UNTRAINED].act(observation)
        now = self._env.world.evaluate((*self._env.observer.needed, *self._names))
        found = {OBSERVATION: self._shown(parts(self._env.observer.observe(now)))}
        found["causes"] = np.concatenate([np.ravel(now[name]) for name in self._names])
        states = {name: agent.hidden() for name, agent in self._agents.items()}
        found |= {name: state for name, state in states.items() if state is not None}
        self.kept[self._env.world.index] = {n: v.astype(np.float64) for n, v in found.items()}
        return action

    def _shown(self, present: Mapping[str, Any]) -> Floats:
        """Return the numbers of the present observation that the agent is shown, the others 0."""
        agent, shown = self._agents[HIDDEN], []
        inputs = None if agent.card is None else agent.card.inputs
        for name, part in present.items():
            if inputs is None or name in inputs:
                shown.append(np.array(part, np.float64).ravel())
                layout = getattr(self._env.observer.parts.get(name or "observation"), "layout", {})
                for variable in getattr(agent.network, "unseen", ()):
                    shown[-1][layout.get(variable, slice(0))] = 0.0
        return np.concatenate(shown)


class _Twin(Hook):
    """Keeps the action at a control step, and that without a past; the episode ends there."""

    def __init__(self, agent: Agent, step: int) -> None:
        self._agent, self._step = agent, step

    def begin(self, env: ScmWorldEnv, observation: Observation) -> None:
        """Begin an episode."""
        self._env = env
        self.own = self.reaction = np.full(np.prod(env.action_space.shape or (1,)), np.nan)

    def choose(self, observation: Observation, action: Actions) -> Actions:
        """Act once more at the control step, after the memory and the history are lost."""
        if self._env.world.index == self._step:
            self.own, self.world = np.array(action, np.float64).ravel(), self._env.world.snapshot()
            if self._env.history is not None:
                self._env.history.rows[:] = 0.0
            self._agent.forget()
            self._agent.start(self._env)
            emptied = self._agent.act(self._env.observe())
            self.reaction = np.array(emptied, np.float64).ravel()
        return action

    def after(self, observation: Observation, reward: float, info: Mapping[str, Any]) -> bool:
        """Return whether the control step is over."""
        return self._env.world.index > self._step


@final
@dataclass
class _EpisodeRunner:
    """Plays shards of episodes and their twins; keeps environments for the next one."""

    setup: Setup
    names: tuple[str, ...]
    steps: tuple[int, ...]
    twins: tuple[int, int]
    environments: dict[tuple[str, int], ScmWorldEnv] = field(default_factory=dict)

    def __call__(self, shard: Shard) -> Arrays:
        """Return the arrays of a shard; the first axis is that of the episodes."""
        return joined([self.episode(shard, one) for one in range(shard.first, shard.stop)])

    def env(self, who: tuple[str, int]) -> ScmWorldEnv:
        """Return the environment of an agent."""
        if who not in self.environments:
            agent = self.setup.agents[who]
            self.environments[who] = self.setup.env(self.setup.engines[0], agent)
        return self.environments[who]

    def episode(self, shard: Shard, episode: int) -> Arrays:
        """Play an episode and, for each cause, its twin."""
        (protocol,), env = self.setup.protocols.values(), self.env(AGENT)
        agent, where = self.setup.agents[AGENT], {"seed": shard.seed, "episode": episode}
        with placed({"engine": shard.engine, "protocol": protocol.name, **where}, env):
            agent.forget()
            watch = _Watch(agent, agent.untrained(), self.names)
            play(under(env, protocol), agent, hooks=(watch,), seed=shard.seed, episode=episode)
            end = watch.kept[max(watch.kept)]
            none = {name: np.full_like(value, np.nan) for name, value in end.items()}
            rows = [watch.kept.get(step, none) for step in self.steps if step != END]
            return joined([*rows, end]) | self.changes(protocol, shard.seed, episode)

    def changes(self, protocol: Protocol, seed: int, episode: int) -> Arrays:
        """Return how actions change where a cause is set within an episode, a row for each."""
        at, end = self.twins
        if not at:
            return {}
        env, agent, act = self.env(AGENT), self.setup.agents[AGENT], protocol.curriculum()
        under(env, protocol).reset(seed=seed, options={"episode": episode + OTHER})
        row = env.world.evaluate(self.names)
        other = {name: np.array(row[name]) for name in self.names}
        usual = _Twin(agent, end)
        agent.forget()
        play(under(env, protocol), agent, hooks=(usual,), seed=seed, episode=episode)
        row = env.world.evaluate(self.names)
        was, found = {name: np.array(row[name]) for name in self.names}, []
        for name, value in other.items():
            twin, set_there = _Twin(agent, end), at_step(at, {name: value})
            acting = under(env, Protocol("twin", act=together(act, set_there)))
            agent.forget()
            play(acting, agent, hooks=(twin,), seed=seed, episode=episode)
            one = {"own": twin.own - usual.own, "reaction": twin.reaction - usual.reaction}
            one["sign"] = np.sign(np.sum(value - was[name]))[None]
            one["privileged"] = np.full_like(twin.own, np.nan)
            if PRIVILEGED in self.setup.agents and np.isfinite(twin.own).all():
                judge, its, actions = self.setup.agents[PRIVILEGED], self.env(PRIVILEGED), []
                its.world.restore(twin.world)
                for one_value in (was[name], value):  # in one state, of the twin
                    its.do({name: one_value})
                    judge.start(its)
                    actions.append(np.array(judge.act(its.observe()), np.float64).ravel())
                one["privileged"] = actions[1] - actions[0]
            found.append(one)
        return joined(found)

    def close(self) -> None:
        """Free the engines."""
        for env in self.environments.values():
            env.close()
        self.environments.clear()


def joined(rows: Sequence[Arrays], join: Callable[..., Floats] = np.stack) -> Arrays:
    """Join the arrays of several rows, by name."""
    try:
        return {name: join([row[name] for row in rows]) for name in rows[0]}
    except ValueError:
        allowed = ("the same in all episodes; where bodies come and go give pad={…}",)
        raise UnknownOption("number of observations", "several", allowed) from None


# --- estimates ------------------------------------------------------------------------------------


def _probes(
    arrays: Arrays, columns: Sequence[str], steps: Sequence[int], logs: Sequence[bool]
) -> tuple[list[CauseProbe], dict[str, str]]:
    """Fit the probes; return them, and why there are none of a column or a step."""
    found, left_out = list[CauseProbe](), dict[str, str]()
    for place, step in enumerate(steps):
        reached = np.isfinite(arrays["causes"][:, place]).all(axis=1)
        causes = arrays["causes"][reached, place]
        causes = np.where(logs, np.log(np.where(logs, causes, 1.0)), causes)
        word = "" if step == END else f" at step {step}"
        reasons = [useless(column) for column in causes.T]
        left_out |= {f"{n}{word}": why for n, why in zip(columns, reasons, strict=True) if why}
        used = [k for k, why in enumerate(reasons) if not why]
        scores: dict[int, dict[str, Any]] = {k: {} for k in used}
        for name in (HIDDEN, UNTRAINED, OBSERVATION) if used else ():
            if name not in arrays:
                continue
            fitted = probe(arrays[name][reached, place], causes[:, used])
            for k, (own, by_chance) in zip(used, fitted, strict=True):
                scores[k][name] = own
                scores[k] |= {SHUFFLED: by_chance} if name == HIDDEN else {}
        found += [CauseProbe(columns[k], step, each) for k, each in scores.items()]
    return found, left_out


def _mean(values: Floats) -> Interval:
    """Return a mean with its interval, which has no width where all values are one."""
    found = mean_interval(values, proportion=False)
    is_same = len(values) > 1 and np.isnan(found.width)
    return replace(found, low=found.value, high=found.value) if is_same else found


def _by_chance(values: Floats) -> Interval:
    """Return the mean of the means under signs at random, and where 95 % of them lie."""
    means = values.mean(axis=1)
    low, high = np.quantile(means, [0.5 - 0.5 * LEVEL, 0.5 + 0.5 * LEVEL])
    return Interval(float(means.mean()), float(low), float(high), LEVEL, FLIPS)


def _along(changes: Floats) -> Floats:
    """Project changes on the mean of the others, shape (..., n, k); 0 where that is 0."""
    others = changes.sum(axis=-2, keepdims=True) - changes
    length = np.linalg.norm(others, axis=-1)
    found: Floats = (changes * others).sum(axis=-1) / np.where(length > 0.0, length, 1.0)
    return found


def _changes(arrays: Arrays, names: Sequence[str]) -> Iterator[Change]:
    """Estimate how actions change with each cause, by which way."""
    arrays = arrays | {"memory": arrays["own"] - arrays["reaction"]}
    reached = np.isfinite(arrays["own"]).all(axis=(1, 2))
    flips = np.random.default_rng(0).choice([-1.0, 1.0], size=(FLIPS, reached.sum()))
    for place, name in enumerate(names) if reached.sum() >= FEWEST else ():
        signs, other = arrays["sign"][reached, place], arrays["privileged"][reached, place]
        for part in PARTS:
            moved = arrays[part][reached, place]
            lengths = np.linalg.norm(moved, axis=1)
            signed = signs * moved
            chance = _by_chance(_along(flips[..., None] * signed))
            one = Change(name, part, _mean(lengths), _mean(_along(signed)), chance)
            both = lengths * np.linalg.norm(other, axis=1)
            if (both > 0.0).sum() > 1:
                cosines = (moved * other).sum(axis=1)[both > 0.0] / both[both > 0.0]
                by_chance = _by_chance(flips[:, : len(cosines)] * cosines)
                one = replace(one, agreement=_mean(cosines), flipped=by_chance)
            yield one


# --- the question ---------------------------------------------------------------------------------


@typed
def inferred(
    policy: object,
    variables: str | Iterable[str] | Mapping[str, Any] | Protocol,
    *,
    task: AnySource | None = None,
    steps: Iterable[int] | None = None,
    at: int | None = None,
    after: int | None = None,
    privileged: object = None,
    n: int = 200,
    seed: int = 0,
    backend: str | None = None,
    env: Mapping[str, Any] | None = None,
    workers: int | None = None,
    engine: Pool | str | None = None,
    out: Location | str | None = None,
    trusted: Sequence[str] | None = None,
    progress: Progress | None = None,
) -> Inferred:
    """Find out which hidden causes an agent infers.

    A cause counts as inferred where a probe predicts it from the agent's hidden state in episodes
    that were not fitted, and the lower end of the 95 % interval of R² lies above the upper ends of
    all controls: of causes of other episodes, of the same network with random weights in the same
    episodes, and of the present observation alone. A network that reads the cause in its
    observation does not infer it.

    Each episode has a twin for each cause: the same noise, with the cause set to another value
    within the episode. The observations differ after that, so both are reported: the change of the
    action on the agent's own trajectory, and that of an agent with an emptied memory for the same
    observations; the difference is what the agent owes to its memory, or to the ``history`` that
    it observes.

    Args:
        policy: As in ``as_agent``. Policy files have a hidden state, recurrent models their memory,
            and any object a method ``hidden(observation)``, called after it has acted. Of others
            only the twins are reported.
        variables: Causes: names or patterns, drawn from A; where each is drawn from, by name; or a
            protocol that draws them.
        task: As in ``evaluate``.
        steps: Control steps whose hidden states are probed, in addition to the last one of each
            episode; 5, 25 and 100 if None, as far as episodes have so many.
        at: Control step at which twins set the cause; 25 if None, or a quarter of a shorter
            episode; 0 for no twins.
        after: How many control steps later the action is compared; likewise.
        privileged: An agent that sees the causes, for the direction of changes, whose memory is
            empty.
        n: Episodes.
        seed: Seed of the noise of the episodes.
        backend: As in ``evaluate``, one.
        env: As in ``evaluate``.
        workers: How many shards of 25 episodes are played at the same time, as in ``evaluate``.
        engine: The executor, as in ``evaluate``.
        out: Folder, or a URL, for finished shards; the same call resumes there.
        trusted: Packages whose functions may be named as policies; any if None.
        progress: Called with how many episodes are done, and how many there are.

    Raises:
        UnknownOption: An argument names something that does not exist, nothing is drawn, or steps
            lie beyond the episode.
        EvaluationError: As in ``evaluate``.
        InexactEngine: With twins: equal runs differ on the backend.

    Example:
        >>> found = inferred("still", "*.mass", n=12, backend="fake", env={"max_episode_length": 8})
        >>> found.probes, [one.verdict for one in found.changes][:1]
        ((), ['no change'])
    """
    protocol = variables if isinstance(variables, Protocol) else _drawing(variables)
    agents = {"agent": policy} | ({} if privileged is None else {"privileged": privileged})
    setup = prepare(agents, protocol, task, n, seed, backend, env, trusted)
    if len(setup.engines) > 1 or {*setup.agents} - {AGENT, PRIVILEGED}:
        raise UnknownOption("policy or backend", "several", ("one",))
    with closing(_EpisodeRunner(setup, (), (), (0, 0))) as runner:
        here = runner.env(AGENT)
        length = min(here.limit, here.world.max_episode_length)
        wanted = [s for s in STEPS if s < length - 1] if steps is None else [*steps]
        for step in wanted:
            whole_number("steps", step, least=0, most=length - 1)
        probed = (*dict.fromkeys(wanted), END)
        usual = min(25, length // 4)
        start = whole_number("at", min(max(usual, 1), length - 1) if at is None else at, least=0)
        later = whole_number("after", usual if after is None else after, least=0)
        pair = start, start + later
        if start:
            whole_number("at + after", start + later, least=1, most=length - 1)
            here.world.require_exact("a twin of an episode", independent=True)
        compiled = here.world.compiled
        plan = protocol.curriculum().plan(Situation(0, {}, compiled, Noise(seed), 0))
        acts = {n: act for n, several in plan.items() for act in several if act.draws}
        names = tuple(n for n in acts if n in compiled.model and n not in compiled.actions)
        if not names:
            allowed = ("causes that are drawn, such as '*.mass'",)
            raise UnknownOption("variables", variables, allowed)
        columns, logs = [], []
        for name in names:
            declared = compiled.model.declared(name)
            source = getattr(acts[name], "distribution", lambda _: None)(declared)
            size = int(np.prod(declared.shape))
            columns += [name] if size == 1 else [f"{name}[{k}]" for k in range(size)]
            logs += [getattr(source, "family", "") in LOGARITHMIC] * size
    runner = _EpisodeRunner(setup, names, probed, pair)
    cells = {}
    for shard in setup.shards():
        if (shard.agent, shard.run) == AGENT:
            keys = [setup.key(shard._replace(agent=name)) for name in agents]
            said = json.dumps([*keys, probed, runner.twins]).encode()
            cells[f"parts/{blake2b(said, digest_size=12).hexdigest()}.npz"] = shard
    arrays = _played(runner, cells, pool_of(engine, workers), out, progress or (lambda *_: None))
    found, left_out = list[CauseProbe](), dict[str, str]()
    with single_threaded():
        if HIDDEN in arrays:
            found, left_out = _probes(arrays, columns, probed, logs)
            if UNTRAINED not in arrays:
                left_out["untrained network"] = "the policy has no method untrained"
        else:
            left_out["probes"] = "the policy has no hidden state"
        changes = tuple(_changes(arrays, names)) if start else ()
    if start and not changes:
        left_out["twins"] = f"fewer than {FEWEST} episodes have control step {pair[1]}"
    about = setup.about() | {"steps": list(probed), "twins": list(pair)}
    return Inferred(about, tuple(found), changes, left_out)


def _drawing(variables: Any) -> Protocol:
    """Return the protocol that draws variables."""
    if not isinstance(variables, Mapping):
        return Protocol("drawn", as_names(variables), "A")
    draws = [resample(name, space=space) for name, space in variables.items()]
    return Protocol("drawn", act=together(*draws) if draws else None)


def _played(
    runner: _EpisodeRunner,
    cells: Mapping[str, Shard],
    pools: Any,
    out: Location | str | None,
    tell: Callable[[int, int], object],
) -> Arrays:
    """Play all shards that are not there yet; return their arrays."""
    found: dict[str, Arrays] = {}
    done, planned = 0, sum(shard.stop - shard.first for shard in cells.values())
    with pools as pool, Study(out, "inference", {}) as study, closing(runner):
        pool.check("policy or task with several workers", runner)
        tell(0, planned)
        for name, one in study.map(cells, runner, read=read_arrays, write=_archive, pool=pool):
            found[name] = one
            done += cells[name].stop - cells[name].first
            tell(done, planned)
    return joined([found[name] for name in cells], np.concatenate)


def _archive(arrays: Mapping[str, Any]) -> bytes:
    content = io.BytesIO()
    np.savez(content, **arrays)
    return content.getvalue()

"""An agent that fits parameters to its own episode, and acts as a policy that observes them."""

from __future__ import annotations

import copy
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, final

import numpy as np

from scm_world._arguments import one_of, true_or_false, typed, whole_number
from scm_world._patterns import as_names
from scm_world._types import Floats, Observation
from scm_world.env import ScmWorldEnv
from scm_world.errors import ScmWorldError, UnknownOption, UnknownVariable, in_one_line
from scm_world.evaluation.recording import UNUSED, parts, whole
from scm_world.fit.online import OnlineFit
from scm_world.fit.targets import Target, blocks_of, ranges_of, values_of
from scm_world.graph import SCM
from scm_world.policies.agents import Actions, WorldPolicy, as_agent
from scm_world.policies.cards import HISTORY, PolicyAbout
from scm_world.policies.planning import CrossEntropy
from scm_world.variables import Normal
from scm_world.variables.kinds import SPACES, SpaceName

STREAM = "what an adaptive agent believes"
USES = ("mean", "draw")


@final
class Adaptive:
    """Acts as a policy that observes the parameters would, if it saw the fitted ones.

    It records what it observes and does. After some control steps it fits the parameters to that,
    from the beginning of its episode on. Until then it believes the defaults that the world
    declares, and what a fit does not determine stays as it was believed; with ``prior="A"`` it
    believes the mean of the posterior instead, however little was seen. The true values of the
    parameters, and of all parameters that follow from them, never reach the policy: in the
    observation the believed ones are in their place. Name all that it must not see as
    ``parameters``; it sees other variables as they are.

    It does the same whatever the machine, since its budget is a number of steps of the fit.

    Args:
        policy: What ``as_agent`` reads and observes the parameters, such as
            ``as_agent(f, env={"context": "observation"})``; or a ``CrossEntropy``, which plans with
            the believed parameters. A planner reads the state of the world, as it always does.
        parameters: Names or patterns of the parameters; see ``World.fit``.
        after: Control steps before the first fit.
        measures: Standard deviation of the noise of each variable that is measured, by name. They
            are among the observed ones.
        every: Control steps from fit to fit; one fit if None.
        iterations: Largest number of Gauss-Newton steps of a fit. The next fit goes on from there.
        last: How many of the last control steps are fitted, such as where parameters change within
            an episode; all if None.
        use: ``"mean"``: it acts by the fitted values; ``"draw"``: by a draw from what the fit
            leaves open, anew after each fit, from the noise of the episode.
        prior: ``"A"``, ``"B"`` or ``"A|B"``: parameters that have this space begin with its mean
            and covariance, of which a fit makes those of a normal posterior; see ``posterior``. At
            least one has it.
        keeps: Whether what it believes holds in the next episode, too, until ``forget`` is called:
            for draws of protocols that are repeated. Each fit is of one episode.

    Attributes:
        history: A dictionary for each fit of the episode: ``step``, the believed ``values`` from
            there on, and a ``reason`` if some or all are those that were believed before.

    Raises:
        UnknownOption: A number is wrong, or the policy does not observe the parameters.
        UnknownVariable: A name is not that of an observed variable, or fits no parameter.
        NotIntervenable: A parameter cannot be changed.

    Example:
        >>> from scm_world.policies.planning import CrossEntropy
        >>> planner = CrossEntropy(samples=4, horizon=3)
        >>> agent = as_agent(Adaptive(planner, "pole.mass", measures={"hinge.position": 0.01}))
        >>> agent.about["kind"]
        'object'
    """

    _fit: OnlineFit
    _shadow: ScmWorldEnv
    _seen: Mapping[str, Any]
    _scaled: Floats

    @typed
    def __init__(
        self,
        policy: object,
        parameters: Iterable[str],
        after: int = 25,
        *,
        measures: Mapping[str, float],
        every: int | None = None,
        iterations: int = 8,
        last: int | None = None,
        use: str = "mean",
        prior: SpaceName | None = None,
        keeps: bool = False,
    ) -> None:
        inside = policy.policy if isinstance(policy, WorldPolicy) else policy
        self._planner = copy.copy(inside) if isinstance(inside, CrossEntropy) else None
        self._given = {} if self._planner is None else dict(self._planner.do)
        self._agent = as_agent(policy if self._planner is None else WorldPolicy(self._planner))
        self.parameters, self.measures = as_names(parameters), dict(measures)
        for name in ("parameters", "measures"):
            if not getattr(self, name):
                raise UnknownOption(name, getattr(self, name), ("one name or more",))
        self.after = whole_number("after", after, least=1)
        self.every = None if every is None else whole_number("every", every, least=1)
        self.iterations = whole_number("iterations", iterations, least=1)
        self.last = None if last is None else whole_number("last", last, least=2)
        one_of("use", use, USES)
        one_of("prior", prior, (None, *SPACES))
        self.prior = prior
        self.use, self.keeps = use, true_or_false("keeps", keeps)
        self.history: list[dict[str, Any]] = []
        self._env: ScmWorldEnv | None = None

    @property
    def card(self) -> PolicyAbout | None:
        """How the policy observes and acts, if known."""
        return self._agent.card

    def __fingerprint__(self) -> dict[str, Any]:
        """Return all that decides what it does."""
        how = (self.after, self.every, self.iterations, self.last, self.use, self.keeps, self.prior)
        about = {n: v for n, v in self._agent.about.items() if n not in ("path", "fingerprint")}
        policy: Any = None if "sha256" in about else self._agent.policy
        if self._planner is not None:
            planner = {n: v for n, v in vars(self._planner).items() if n != "_programs"}
            policy = {**planner, "do": self._given}
        form = None if self.card is None else self.card.env
        return {"policy": (about, policy, form), "fits": (self.parameters, self.measures, *how)}

    def __getstate__(self) -> dict[str, Any]:
        """Copy and pickle without the episode."""
        private = ("_shadow", "_fit", "_seen", "_scaled", "_moments")
        state = {name: value for name, value in vars(self).items() if name not in private}
        return {**state, "_env": None, "history": []}

    def start(self, env: ScmWorldEnv) -> None:
        """Begin an episode, with the first belief, unless it keeps what it believes."""
        if env is not self._env:
            self._prepare(env)
        if not self.keeps:
            self.forget()
        self.history, self._values, self._commands = [], list[Floats](), list[Floats]()
        self._believe(self._scaled)
        self._agent.start(env)

    def forget(self) -> None:
        """Believe again the declared values, or the mean of the prior."""
        if self._env is not None:
            self._fit.begin()
            center = self._moments[0]
            self._scaled = np.where(np.isnan(center), self._fit.scaled, center)

    def act(self, observation: Observation) -> Actions:
        """Fit, if it is time, and choose an action."""
        env, steps = self._env, len(self._commands)
        assert env is not None  # noqa: S101 # an Agent has started it
        vector: Any = env.observer.parts["observation"]
        present = parts(observation).get("observation", observation)
        self._values.append(vector.numbers(present)[self._measured])
        since = steps - self.after
        if since == 0 or (since > 0 and self.every and since % self.every == 0):
            self._learn(env, steps)
        action = self._agent.act(self._as_believed(observation, steps))
        self._commands.append(np.array(env.actions.command(action)))
        return action

    @property
    def unseen(self) -> frozenset[str]:
        """The variables whose true values never reach the policy."""
        return frozenset(self._hidden)

    def hidden(self, observation: Observation) -> Floats:
        """Return the believed parameters, as ``Agent.hidden`` has them, scaled for the fit."""
        return self._scaled

    def _prepare(self, env: ScmWorldEnv) -> None:
        """Make a world with the declared parameters, in which fits are simulated."""
        if self._env is not None:
            self._fit.close()
            self._shadow.close()
        self._shadow = shadow = ScmWorldEnv(**{**env.made_with, **UNUSED})
        how: Any = {"iterations": self.iterations, "last": self.last}
        self._fit = OnlineFit(shadow.world, self.parameters, self.measures, **how)
        where: Mapping[str, slice] = getattr(env.observer.parts["observation"], "layout", {})
        for column in self._fit.columns:
            if column.variable not in where:
                raise UnknownVariable(column.variable, where)
        places = [where[c.variable].start + c.component for c in self._fit.columns]
        self._measured, model = np.array(places), shadow.world.model
        written = {name for target in self._fit.targets for name in target.written}
        acting = written.union(*map(model.descendants, written))
        self._hidden = acting & shadow.world.compiled.static
        shown = {
            name for part in env.observer.parts.values() for name in getattr(part, "layout", ())
        }
        if self._planner is None and not written <= shown:
            missing = sorted(written - shown)[0]
            allowed = ("one that observes it: as_agent(policy, env={'context': 'observation'})",)
            raise UnknownOption(f"policy that does not observe {missing!r}", "this one", allowed)
        center, prior = moments(self._fit.targets, model, self.prior)
        own, sizes = ~np.isnan(center), np.ones(len(center))
        if self.prior is not None and not own.any():
            names = tuple(target.variable for target in self._fit.targets)
            known = (f"a space that one of {', '.join(dict.fromkeys(names))} has", "None")
            raise UnknownOption("prior", self.prior, known)
        sizes[own] = np.sqrt(np.diag(prior))
        self._fit.rescale(sizes)
        self._env, self._moments = env, moments(self._fit.targets, model, self.prior)
        self.forget()

    def _believe(self, scaled: Floats) -> None:
        """Act by these parameters from now on."""
        values = values_of(self._fit.targets, scaled)
        self._seen = parts(self._shadow.reset(seed=0, options={"do": values})[0])
        if self._planner is not None:
            self._planner.do = {**self._given, **values}
        self._scaled = scaled

    def _as_believed(self, observation: Observation, steps: int) -> Observation:
        """Return an observation with the believed parameters, in the steps so far, too."""
        shown, env = {name: np.array(one) for name, one in parts(observation).items()}, self._env
        for name, part in env.observer.parts.items() if env is not None else ():
            here = name if name in shown else ""
            for variable in self._hidden.intersection(getattr(part, "layout", ())):
                place = part.layout[variable]
                value = shown[here][place] = self._seen[here][place]
                if name == "observation" and env is not None and env.history is not None:
                    if HISTORY in shown:
                        shown[HISTORY][:steps, place] = value
                    for lag in range(1, steps + 1):
                        if (past := env.layout.get(f"{variable}@-{lag}")) is not None:
                            shown[here][past] = value
        found: Observation = whole(shown)
        return found

    def _learn(self, env: ScmWorldEnv, steps: int) -> None:
        """Fit the episode so far; believe what it determines."""
        targets, reason = self._fit.targets, ""
        try:
            fit = self._fit.update(np.array(self._commands), np.array(self._values))
            known = fit.table["determined"].to_numpy(bool, copy=True)
            for _, own in blocks_of(targets):
                known[own] = known[own].all()
            new, spread, center = fit.scaled.copy(), fit.spread.copy(), self._moments[0]
            with_prior = np.flatnonzero(~np.isnan(center))
            # Where the residuals are like the noise, an end without convergence is taken for the
            # minimum: what is left to go is in flat directions, and these the prior decides.
            if len(with_prior) and (fit.explains or not fit.ended):
                square = np.ix_(with_prior, with_prior)
                mean, rest = posterior(*self._moments, new[with_prior], spread[square])
                new[with_prior], spread[square], known[with_prior] = mean, rest, True
            which = np.flatnonzero(known)
            if self.use == "draw" and known.any():
                root = root_of(spread[np.ix_(which, which)])
                place = {"episode": env.world.episode, "step": steps}
                noise = env.world.noise.draw(Normal(), STREAM, (len(new),), {}, **place)[0]
                new[which] = new[which] + root @ noise[which]
            believed = np.where(known, np.clip(new, *ranges_of(targets)), self._scaled)
            if known.any():
                self._believe(believed)
            left = [t.name for t, is_known in zip(targets, known, strict=True) if not is_known]
            reason = f"not determined: {', '.join(left)}" if left else ""
        except (ScmWorldError, np.linalg.LinAlgError) as error:
            reason = in_one_line(error)
        values = {name: np.array(v) for name, v in values_of(targets, self._scaled).items()}
        self.history.append({"step": steps, "values": values, "reason": reason})


def moments(
    targets: Sequence[Target], model: SCM, prior: SpaceName | None
) -> tuple[Floats, Floats]:
    """Return the mean of each target in a space, NaN without one, and the covariance of the others.

    They are those of 1,000 draws, scaled, shape (p,) and (m, m).
    """
    random, count, columns = np.random.default_rng(0), 1000, list[Floats]()
    center, drawn = np.full(len(targets), np.nan), dict[str, Floats]()
    for i, target in enumerate(targets):
        variable = model.declared(target.variable) if target.values is not None else None
        space = variable.space(prior) if variable is not None and prior is not None else None
        if variable is None or space is None or target.block is not None or space.parents():
            continue
        if target.variable not in drawn:
            uniforms = random.random((count, space.n_uniforms(variable.shape)))
            draws = space.transform(uniforms, variable.shape, {})
            drawn[target.variable] = np.asarray(draws, float).reshape(count, -1)
        columns.append(target.scaled(drawn[target.variable][:, target.component]))
        center[i] = columns[-1].mean()
    shape = len(columns), len(columns)
    return center, np.cov(columns).reshape(shape) if columns else np.empty(shape)


def posterior(
    center: Floats, prior: Floats, found: Floats, spread: Floats
) -> tuple[Floats, Floats]:
    """Return mean and covariance of a normal posterior.

    Args:
        center: Mean of the prior, shape (p,); NaN of what has none.
        prior: Its covariance, shape (m, m), of the others.
        found: What a fit without a prior found of these, shape (m,).
        spread: The covariance of its errors, shape (m, m); it may be as good as infinite.

    Source:
        Särkkä, *Bayesian Filtering and Smoothing*, 2013, equation 4.20 (the Kalman update).
    """
    mean = center[~np.isnan(center)]
    gain = np.linalg.solve(prior + spread, prior).T
    return mean + gain @ (found - mean), prior - gain @ prior


def root_of(spread: Floats) -> Floats:
    """Return a matrix whose product with its transpose is a covariance, which may be singular."""
    sizes, axes = np.linalg.eigh((spread + spread.T) / 2.0)
    found: Floats = axes * np.sqrt(np.maximum(sizes, 0.0))
    return found

"""Confirm answers of certified questions without the package's queries.

Numbers of the generator (weights, the MJCF, the values of a query) are read; what follows from them
is computed here: equations by NumPy, bodies by plain MuJoCo. Units are drawn here, too, so means
are compared within five standard errors. Names, graphs and numbers without chance have to agree.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import mujoco
import numpy as np

from scm_world.lab.questions import Question

TENDON = mujoco.mjtObj.mjOBJ_TENDON
UNITS, BODIES = 100_000, 400
"""Units of equations, and of bodies."""
ERRORS, CLOSE = 5.0, 1e-5
"""Standard errors of means, and the share of its scale by which an exact number may differ."""


def confirm(question: Question) -> dict[str, Any]:
    """Return whether the answer is confirmed, and how far off it is, in what is allowed."""
    makers: dict[str, Any] = {"equations": Equations, "servo": Servo, "network": Network}
    own: Any = makers.get(question.world, Rig)(question)
    query, answer = question.query, question.answer
    names = {shown: one.name for shown, one in question.view.quantities.items()}

    def inner(values: Mapping[str, float]) -> dict[str, float]:
        return {names[n]: float(question.view.inner(n, v)) for n, v in values.items()}

    def apart(values: Any, right: float, units: int) -> float:
        """Return how far a mean is from the answer, in standard errors, or in its scale."""
        shown = question.view.shown(query["outcome"], np.asarray(values, float))
        if own.exact or np.ptp(shown) == 0.0:
            return float(abs(shown.mean() - right) / (own.close * question.scale))
        error = shown.std() * np.sqrt(1.0 / units + 1.0 / shown.size)
        return float(abs(shown.mean() - right) / (ERRORS * error))

    made, outcome = question.view.testbed, names.get(query.get("outcome", ""), "")
    match question.kind:
        case "graph":
            edges, hidden = own.graph()
            told = {(names[a], names[b]) for a, b in answer["edges"]}
            shared = {frozenset(names[n] for n in pair) for pair in answer["hidden"]}
            return {"confirmed": told == edges and shared == hidden}
        case "effect":
            ends = [inner({query["cause"]: query[end]}) for end in ("to", "from")]
            one, other = (own.units(do)[outcome] for do in ends)
            scale = question.view._affine[query["outcome"]][0]
            change = scale * (one - other)
            error = change.std() * np.sqrt(1.0 / made.truth + 1.0 / change.size)
            far = abs(change.mean() - answer) / max(ERRORS * error, CLOSE * abs(answer))
        case "law":
            pairs = zip(answer["values"], answer["means"], strict=True)
            dos = [({**query["held"], query["cause"]: v}, mean) for v, mean in pairs]
            far = max(apart(own.units(inner(do))[outcome], m, made.truth) for do, m in dos)
        case "prediction":
            pairs = zip(query["dos"], answer, strict=True)
            far = max(apart(own.units(inner(do))[outcome], m, made.truth) for do, m in pairs)
        case "control":
            do = inner({**query["held"], **answer})
            far = apart(own.units(do)[outcome], query["target"], made.truth)
        case "counterfactual":
            value = own.other(inner(query["run"]), inner({query["cause"]: query["value"]}))
            shown = question.view.shown(query["outcome"], value[outcome])
            far = abs(shown - answer) / (own.close * question.scale)
        case "explanation":
            bad = []
            for name in query["usual"]:
                do = inner({**query["set"], name: query["usual"][name]})
                end = question.view.shown(query["outcome"], own.units(do)[outcome][0])
                sign = 1.0 if query["fails"] == "above" else -1.0
                bad += [name] if sign * (end - query["limit"]) <= 0.0 else []
            return {"confirmed": bad == [answer]}
        case _:
            run, least = inner(query["run"]), dict[str, float]()
            for name in query["usual"]:
                low, high = question.view.ends(name)
                least[name] = np.inf
                for share in (0.08, 0.92):
                    value = round(low + share * (high - low), 6)
                    found = own.units(inner({**query["usual"], name: value}))
                    gap = max(abs(float(found[n][0]) - v) for n, v in run.items())
                    least[name] = min(least[name], gap)
            best = min(least, key=lambda n: least[n])
            return {"confirmed": best == answer and least[best] < 1e-6}
    return {"confirmed": bool(far <= 1.0), "far": float(far)}


class Equations:
    """A model of equations, in NumPy."""

    exact, close = False, 1e-6

    def __init__(self, question: Question) -> None:
        made: Any = question.view.testbed
        model, self.read = made.world, made.quantities
        self.laws: dict[str, Any] = {}
        self.noise: dict[str, float] = {}
        self.causes: dict[str, tuple[str, ...]] = {}
        for name in model:
            one = model[name]
            drawn = one.distribution if one.kind == "exogenous" else one.noise
            self.causes[name], self.noise[name] = (), float(drawn.std)
            if one.kind == "derived":
                self.causes[name] = tuple(parent.name for parent in one.parents)
                constants = getattr(one.mechanism, "constants", {})
                weights = constants.get("weights", getattr(one.mechanism, "weights", ()))
                self.laws[name] = np.ravel(weights).tolist(), float(constants.get("law", 0.0))
        self.order = _sorted(self.causes)
        self.hidden = {*self.order} - {one.name for one in self.read}

    def graph(self) -> tuple[set[Any], set[Any]]:
        """Return the edges with a weight, and the pairs that a hidden variable acts on."""
        edges = {
            (c, e) for e, causes in self.causes.items() for c in causes if c not in self.hidden
        }
        acts = [[e for e, causes in self.causes.items() if h in causes] for h in self.hidden]
        return edges, {frozenset(pair) for pair in acts if len(pair) == 2}

    def force(self, name: str, values: Mapping[str, Any]) -> Any:
        """Return the part of a variable that its causes decide."""
        weights, law = self.laws.get(name, ((), 0.0))
        total: Any = 0.0
        for weight, cause in zip(weights, self.causes[name], strict=True):
            x = np.asarray(values[cause], float)
            of = {0.0: x, 1.0: 0.25 * x**3, 2.0: 0.5 * x * np.abs(x)}
            dry = np.sign(x) * np.maximum(np.abs(x) - 0.5, 0.0)
            total = total + weight * of.get(law, dry)
        return total

    def units(self, do: Mapping[str, float]) -> dict[str, Any]:
        """Return the variables of new units under an intervention, the same units each time."""
        rng, values = np.random.default_rng(1), dict[str, Any]()
        for name in self.order:
            drawn = self.noise[name] * rng.normal(size=UNITS)
            values[name] = self.force(name, values) + drawn
            if name in do:
                values[name] = np.full(UNITS, do[name])
        return values

    def other(self, run: Mapping[str, float], change: Mapping[str, float]) -> dict[str, float]:
        """Return the counterfactual of a run: what its causes do not explain stays."""
        seen, values = {**dict.fromkeys(self.hidden, 0.0), **run}, dict.fromkeys(self.hidden, 0.0)
        for name in self.order:
            if name in run:
                rest = run[name] - float(self.force(name, seen))
                values[name] = change.get(name, float(self.force(name, values)) + rest)
        return values


def _sorted(causes: Mapping[str, tuple[str, ...]]) -> list[str]:
    found: list[str] = []
    while len(found) < len(causes):
        found += [n for n, of in causes.items() if n not in found and {*of} <= {*found}]
    return found


class Rig:
    """A rig in plain MuJoCo: readings are summaries of the states after its control steps."""

    exact, close = False, CLOSE

    def __init__(self, question: Question) -> None:
        made: Any = question.view.testbed
        self.task, self.steps, self.question = made.world.task, made.setting["steps"], question
        self.model = mujoco.MjModel.from_xml_string(self.task.given["model"])
        # As in the package: otherwise a contact depends on the last solution, too.
        self.model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_WARMSTART
        self.causes = [one for one in made.quantities if one.sets and "lamp" not in one.name]
        self.read = [one for one in made.quantities if not one.sets]
        given = made.world.plan.at_start()
        laws = {one.name: given[one.name].function for one in self.causes if one.name in given}
        self.laws = {n: (law.weights, law.intercept) for n, law in laws.items()}
        follows = {n: law for n, law in given.items() if n.endswith(".control")}
        self.agent = {
            n.partition(".")[0]: {
                getattr(parent, "name", parent): w
                for parent, w in zip(law.parents, np.ravel(law.function.weights), strict=True)
            }
            for n, law in follows.items()
        }

    def graph(self) -> tuple[set[Any], set[Any]]:
        """Return which causes move which outcomes of the run that the question gives."""
        view, query = self.question.view, self.question.query
        names = {shown: one.name for shown, one in view.quantities.items()}
        values = {names[n]: float(view.inner(n, v)) for n, v in query["set"].items()}
        own, edges = {(names[a], names[b]) for a, b in query["known"]}, set[Any]()
        for one in self.causes:
            step = 1e-4 * (one.high - one.low)
            ends = [self.one({**values, one.name: values[one.name] + s * step}) for s in (-1, 1)]
            moved = [n.name for n in self.read if abs(ends[1][n.name] - ends[0][n.name]) > 1e-9]
            edges |= {(one.name, outcome) for outcome in moved}
        return edges - own, set()

    def one(self, values: Mapping[str, float]) -> dict[str, float]:
        """Simulate one run; return all readings."""
        model, data = self.model, mujoco.MjData(self.model)
        for name, value in values.items():
            entity, _, what = name.rpartition(".")
            if what == "mass":
                model.body(entity).mass[:] = value  # its inertia stays, as the package says
            elif what == "stiffness" and mujoco.mj_name2id(model, TENDON, entity) >= 0:
                model.tendon_stiffness[model.tendon(entity).id] = value
            elif what in ("stiffness", "damping"):
                getattr(model.joint(entity), what)[0] = value
            elif what == "friction":
                model.geom(entity).friction[0] = value
        mujoco.mj_setConst(model, mujoco.MjData(model))
        for name, value in values.items():
            entity, _, what = name.rpartition(".")
            if what in ("position", "velocity"):
                state = data.joint(entity)
                (state.qpos if what == "position" else state.qvel)[:] = value
        states = []
        for _ in range(self.steps):
            for motor, weights in self.agent.items():
                now = {n: self.state(data, n) for n in weights}
                data.actuator(motor).ctrl[:] = sum(w * now[n] for n, w in weights.items())
            for _ in range(round(self.task.control_dt / model.opt.timestep)):
                mujoco.mj_step(model, data)
            states.append({one.name: self.state(data, one.reads.name) for one in self.read})
        found = dict(values)
        for one in self.read:
            path = [state[one.name] for state in states]
            summary = {"final": path[-1], "mean": float(np.mean(path)), "max": max(path)}
            found[one.name] = summary[one.reads.how]
        return found

    def state(self, data: Any, name: str) -> float:
        """Return the position or velocity of a joint."""
        joint = data.joint(name.rpartition(".")[0])
        return float((joint.qvel if name.endswith(".velocity") else joint.qpos)[0])

    def units(self, do: Mapping[str, float]) -> dict[str, Any]:
        """Return readings; causes that are not set follow a driver and noise of their own."""
        free = [one.name for one in self.causes if one.name not in do and one.name in self.laws]
        rng, runs = np.random.default_rng(1), []
        for _ in range(BODIES if free else 1):
            driver, values = rng.uniform(-1.0, 1.0), dict[str, float]()
            for one in self.causes:
                own = rng.uniform(-1.0, 1.0)
                if one.name in free:
                    weights, level = self.laws[one.name]
                    values[one.name] = float(weights[0] * driver + weights[1] * own + level)
            runs.append(self.one({**values, **do}))
        return {name: np.array([run[name] for run in runs]) for name in runs[0]}

    def other(self, run: Mapping[str, float], change: Mapping[str, float]) -> dict[str, float]:
        """Simulate the run again with a change: all that acts on it was read."""
        causes = {one.name: run[one.name] for one in self.causes}
        again = self.one(causes)
        gap = max(abs(again[n] - v) for n, v in run.items() if n in again)
        if gap > 1e-6:
            raise ValueError(f"the run is not reproduced: {gap}")
        return self.one({**causes, **change})


class Network:
    """Masses and springs: which springs the MJCF has."""

    exact, close = True, CLOSE

    def __init__(self, question: Question) -> None:
        made: Any = question.view.testbed
        task = made.world.task
        self.model = mujoco.MjModel.from_xml_string(task.given["model"])

    def graph(self) -> tuple[set[Any], set[Any]]:
        """Move each mass, and see which speeds change in one step of plain MuJoCo."""
        model, edges = self.model, set[Any]()
        names = [model.joint(i).name for i in range(model.njnt)]

        def speeds(places: Any) -> Any:
            data = mujoco.MjData(model)
            data.qpos[:] = places
            mujoco.mj_step(model, data)
            return data.qvel.copy()

        rest = speeds(np.zeros(model.nq))
        for i, name in enumerate(names):
            moved = speeds(0.3 * np.eye(model.nq)[i]) - rest
            near = [j for j in np.flatnonzero(np.abs(moved) > 1e-9) if j != i]
            edges |= {(f"{name}.position", f"{names[j]}.velocity") for j in near}
        return edges, set()


class Servo:
    """Arms whose servos follow one another, in plain MuJoCo."""

    exact, close = False, 0.05

    def __init__(self, question: Question) -> None:
        made: Any = question.view.testbed
        self.task, self.steps = made.world.task, made.setting["steps"]
        self.model = mujoco.MjModel.from_xml_string(self.task.given["model"])
        self.arms = {one.name: one for one in made.quantities}
        self.laws: dict[str, dict[str, float]] = {}
        for name, one in self.arms.items():
            law = made.world.plan.at_start()[one.sets]
            causes = [getattr(parent, "name", parent) for parent in law.parents]
            self.laws[name] = dict(zip(causes, np.ravel(law.function.weights), strict=True))
        drawn = {one.name: one.distribution for one in self.task.ties}
        self.std = {n: float(d.std) for n, d in drawn.items() if hasattr(d, "std")}

    def graph(self) -> tuple[set[Any], set[Any]]:
        """Hold all arms but one; move each of the others, and see whether it follows."""
        edges, forces = set[Any](), [n for n in self.std if n.startswith("force")]
        still = dict.fromkeys(self.std, 0.0)
        for effect in self.arms:
            others = [a for a in self.arms if a != effect]
            before = self.run(still, dict.fromkeys(others, 0.0))[effect]
            for cause in others:
                after = self.run(still, {**dict.fromkeys(others, 0.0), cause: 0.3})[effect]
                edges |= {(cause, effect)} if abs(after - before) > 1e-9 else set()
        acts = [[a for a, law in self.laws.items() if force in law] for force in forces]
        return edges, {frozenset(pair) for pair in acts if len(pair) == 2}

    def run(self, drawn: Mapping[str, float], do: Mapping[str, float]) -> dict[str, float]:
        """Return where the arms rest; an arm that is held has its command times a factor."""
        model, data = self.model, mujoco.MjData(self.model)
        substeps = round(self.task.control_dt / model.opt.timestep)
        for _ in range(self.steps):
            known = {f"{arm}.position": data.joint(arm).qpos[0] for arm in self.arms} | {**drawn}
            for arm, one in self.arms.items():
                held = do.get(arm)
                follows = sum(w * known[c] for c, w in self.laws[arm].items())
                command = follows if held is None else one.factor * held
                data.actuator(one.sets.partition(".")[0]).ctrl[:] = command
            for _ in range(substeps):
                mujoco.mj_step(model, data)
        return {arm: float(data.joint(arm).qpos[0]) for arm in self.arms}

    def units(self, do: Mapping[str, float]) -> dict[str, Any]:
        """Return where the arms of new units rest, the same units each time."""
        rng = np.random.default_rng(1)
        units = [{n: s * rng.normal() for n, s in self.std.items()} for _ in range(BODIES // 2)]
        runs = [self.run(drawn, do) for drawn in units]
        return {name: np.array([run[name] for run in runs]) for name in runs[0]}

    def other(self, run: Mapping[str, float], change: Mapping[str, float]) -> dict[str, float]:
        """Read what each arm does by itself from where it rests, then simulate the change."""
        drawn, places = dict.fromkeys(self.std, 0.0), {f"{a}.position": v for a, v in run.items()}
        for arm, one in self.arms.items():
            servo = one.sets.partition(".")[0]
            stiffness = self.model.actuator(servo).gainprm[0]
            body = self.model.body(arm)
            weight = body.mass[0] * 9.81 * abs(float(body.ipos[2]))
            command = run[arm] + weight * np.sin(run[arm]) / stiffness
            rest = command - sum(w * places[c] for c, w in self.laws[arm].items() if c in places)
            drawn[f"{servo}.setpoint"] = rest / self.laws[arm][f"{servo}.setpoint"]
        return self.run(drawn, change)

"""Fit simulated recordings of foreign models, and count how often the intervals cover the truth.

::

    python benchmarks/fit.py --runs 17

Twelve models that others wrote (dm_control, Gymnasium, pybullet_data) get known deviations; runs
of them with sensor noise are fitted by worlds that do not know these. One recording of each of six
is fitted from ten random defaults. Then a payload of an arm with stiff servos is fitted before and
after a suggested experiment, and one recording is fitted by ``mujoco.sysid``, too, where that can
be imported (``pip install mujoco[sysid]``). It prints what it finds and writes it as JSON.
"""

from __future__ import annotations

import argparse
import importlib
import json
import re
import time
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

import scm_world as sw
from scm_world.policies.scripted import Random
from scm_world.queries.experiments.versions import versions

HERE = Path(__file__).parent


@dataclass(frozen=True)
class Case:
    """A model, and how the recorded system differs from it.

    Attributes:
        package: The package that has the file.
        file: The file in it.
        factors: By which factor each parameter deviates.
        also: Further fitted parameters, which do not deviate.
        noise: Standard deviation of the sensors, by patterns of what is measured.
        steps: Control steps of a recording.
        share: Share of the range of the commands, which are drawn at random.
        start: Where a recording begins.
        delay: Delay of the commands of the recorded system [s], a multiple of ``fine``.
        fine: Control step of the recorded system [s], where commands are delayed.
        to: Values of parameters that deviate and are zero in the file.
        change: Changes the model, before it is a world and before it deviates.
        expose: Patterns of the variables of the world.
    """

    package: str
    file: str
    factors: Mapping[str, float]
    also: tuple[str, ...] = ()
    noise: Mapping[str, float] = None  # type: ignore[assignment]
    steps: int = 100
    share: float = 1.0
    start: Mapping[str, Any] = None  # type: ignore[assignment]
    delay: float = 0.0
    fine: float = 0.01
    to: Mapping[str, float] = field(default_factory=dict)
    change: Callable[[mujoco.MjSpec], None] | None = None
    expose: tuple[str, ...] | None = None


def lagging(spec: mujoco.MjSpec) -> None:
    """Put a position servo, whose target is filtered, in place of the motor of a pendulum."""
    (servo,) = spec.actuators
    servo.set_to_position(kp=20.0, kv=2.0, timeconst=0.05)  # filterexact
    servo.ctrlrange, spec.option.timestep = (-2.0, 2.0), 0.002


def integrating(spec: mujoco.MjSpec) -> None:
    """Put servos that integrate a velocity in place of motors."""
    for servo in spec.actuators:
        servo.set_to_intvelocity(kp=0.2)
        servo.gear = (1.0, 0.0, 0.0, 0.0, 0.0, 0.0)


def stiff(spec: mujoco.MjSpec) -> None:
    """Put stiff servos in place of the motors of an arm, and let it be heavy."""
    joints = [joint for joint in spec.joints if joint.name[:2] == "r_"]
    for actuator, joint in zip(spec.actuators, joints, strict=True):
        actuator.set_to_position(kp=5000.0, kv=100.0)
        actuator.ctrlrange = joint.range if joint.range[0] < joint.range[1] else (-1.5, 1.5)
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST  # for the stiff servos
    spec.option.gravity = (0.0, 0.0, -9.81)


ANGLES = {"*.position": 2e-3}
CASES = {
    "acrobot: damping": Case(
        "dm_control",
        "suite/acrobot.xml",
        {"shoulder.damping": 2.0, "elbow.damping": 2.0},
        noise=ANGLES,
    ),
    "finger: friction of a joint": Case(
        "dm_control", "suite/finger.xml", {"hinge.frictionloss": 2.0}, ("hinge.damping",), ANGLES
    ),
    "fish: gain": Case(
        "dm_control",
        "suite/fish.xml",
        {"tail.kp": 1.5, "tail_twist.kp": 1.5},
        noise={"*.position": 2e-3, "*.orientation": 2e-3},
        steps=29,
    ),
    "reacher: gear and delay": Case(
        "gymnasium",
        "envs/mujoco/assets/reacher.xml",
        {"joint0.gear": 1.3, "joint1.gear": 1.3},
        ("delay",),
        {"joint*.position": 2e-3},
        share=0.3,
        delay=0.04,
    ),
    "half cheetah: friction of the floor": Case(
        "gymnasium",
        "envs/mujoco/assets/half_cheetah.xml",
        {"floor.friction": 1.5},
        noise={"*.position": 2e-3},
        steps=49,
    ),
    "iiwa (URDF): mass": Case(
        "pybullet_data",
        "kuka_iiwa/model.urdf",
        {"lbr_iiwa_link_4.mass": 1.8},
        ("lbr_iiwa_joint_4.damping",),
        {"*.position": 2e-3},
        39,
        0.02,
    ),
}
OTHERS = {  # nothing was chosen by looking at results of these
    "walker: damping": Case(
        "dm_control",
        "suite/walker.xml",
        {"right_knee.damping": 3.0},
        noise={"*.position": 2e-3},
        steps=49,
    ),
    "pusher: mass": Case(
        "gymnasium",
        "envs/mujoco/assets/pusher_v5.xml",
        {"r_elbow_flex_link.mass": 2.0},
        ("r_elbow_flex_joint.damping",),
        {"r_*.position": 2e-3},
        steps=80,
        share=0.5,
    ),
}
MORE = {  # nor of these: three kinds that were demanded before any fit, and one more model
    "pendulum: servo with a lag and a delay": Case(
        "dm_control",
        "suite/pendulum.xml",
        {"torque.kp": 1.4, "torque.timeconst": 1.6},
        ("delay",),
        ANGLES,
        steps=80,
        delay=0.026,
        fine=0.002,
        change=lagging,
    ),
    "cart-pole: spring, force and friction of zero": Case(
        "dm_control",
        "suite/cartpole.xml",
        {},
        ("cart.external_force[0]", "hinge_1.frictionloss"),
        ANGLES,
        steps=60,
        to={"slider.stiffness": 2.0},
        expose=("*", "*.external_force"),
    ),
    "reacher: integrated velocity": Case(
        "dm_control",
        "suite/reacher.xml",
        {"shoulder.kp": 1.5, "wrist.kp": 1.5},
        noise=ANGLES,
        steps=80,
        change=integrating,
    ),
    "double pendulum on a cart: mass": Case(
        "gymnasium",
        "envs/mujoco/assets/inverted_double_pendulum.xml",
        {"pole2.mass": 1.5},
        ("hinge.damping",),
        ANGLES,
        steps=50,
        share=0.05,
    ),
}
DEFAULTS = (  # of these, a recording is fitted from random defaults
    "acrobot: damping",
    "fish: gain",
    "reacher: gear and delay",
    "half cheetah: friction of the floor",
    "pendulum: servo with a lag and a delay",
    "cart-pole: spring, force and friction of zero",
)


def world_of(case: Case, **options: Any) -> sw.World:
    """Load the model of a case."""
    path: Any = Path(importlib.import_module(case.package).__path__[0]) / case.file
    if case.change is not None:
        path = mujoco.MjSpec.from_file(str(path))
        case.change(path)
    if case.expose is not None:
        options["expose"] = case.expose
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        return sw.World(path, **options)


def recorded_by(world: sw.World, case: Case) -> tuple[sw.World, dict[str, float]]:
    """Return the recorded system of a case, and the true values of all fitted parameters."""
    truth = deviating(world, case)
    fine = {"control_dt": case.fine} if case.delay else {}
    true = world_of(case, **fine).given(truth)
    also = {n: case.delay if n == "delay" else float(default_of(world, n)) for n in case.also}
    return true, truth | also


def default_of(world: sw.World, name: str) -> float:
    """Return the value of a parameter, or of a component such as ``force[0]``, in the file."""
    world.reset(seed=0)
    variable, _, place = name.partition("[")
    return float(np.ravel(world[variable])[int(place.rstrip("]") or 0)])


def record(
    world: sw.World, true: sw.World, case: Case, seed: int, commands: Any = None
) -> dict[str, Any]:
    """Record a run of the true system, with sensor noise."""
    dt, rng = world.options.control_period, np.random.default_rng(seed)
    start = dict(case.start or {})
    if commands is None:
        policy = Random(share=case.share, every=5)
        commands = world.rollout(policy, seed=seed, steps=case.steps).actions
    sent, every = commands, 1
    if case.delay:  # the true system has shorter control steps
        every = round(dt / true.options.control_period)
        late = round(case.delay / true.options.control_period)
        fine = np.repeat(commands, every, axis=0)
        sent = np.concatenate([np.repeat(fine[:1], late, axis=0), fine])[: len(fine)]
    names = [name for name in world.compiled.slices if name not in world.compiled.bundles]
    episode = true.rollout(sent, steps=len(sent), do=start)
    found: dict[str, Any] = {"time": dt * np.arange(len(commands) + 1)}
    found |= {name: commands[:, at] for name, at in world.compiled.actions.items()}
    for name in names:
        noise = [n for pattern, n in case.noise.items() if Path(name).match(pattern)]
        if noise:
            values = episode[name][::every]
            found[name] = values + noise[0] * rng.normal(size=values.shape)
    return found


def deviating(world: sw.World, case: Case) -> dict[str, float]:
    """Return the true values of the parameters that deviate."""
    factors = case.factors.items()
    return {n: factor * default_of(world, n) for n, factor in factors} | dict(case.to)


def studied(kept: Path, number: int, fit: Callable[[int], sw.Fit]) -> list[dict[str, Any]]:
    """Return what some fits find; a file of lines of JSON resumes an interrupted study."""
    done = [*map(json.loads, kept.read_text().splitlines())] if kept.exists() else []
    for seed in range(len(done), number):
        begin = time.process_time()
        found = fit(seed)
        rows = found.table.set_index("parameter").iterrows()
        fitted = {name: [row.value, row.low, row.high, bool(row.determined)] for name, row in rows}
        seconds = time.process_time() - begin
        done.append({"seconds": seconds, "explains": bool(found.explains), "fitted": fitted})
        with kept.open("a") as file:
            file.write(json.dumps(done[-1]) + "\n")
    return done[:number]


def coverage(case: Case, runs: int, kept: Path) -> dict[str, Any]:
    """Fit recordings with different noise and commands, and count the intervals that cover.

    An interval over the whole range ("none") covers. A miss is the distance from the interval to
    the true value, in widths of the interval.
    """
    world = world_of(case)
    true, expected = recorded_by(world, case)
    done = studied(kept, runs, lambda seed: world.fit(record(world, true, case, seed), [*expected]))
    hits: dict[str, list[bool]] = {name: [] for name in expected}
    errors, determined, misses, none = list[float](), list[bool](), list[float](), 0
    for one in done:
        for name, (value, low, high, sure) in one["fitted"].items():
            away = max(low - expected[name], expected[name] - high, 0.0)
            none += bool(np.isnan(low))
            hits[name].append(not away > 0.0)
            errors.append(abs(value / expected[name] - 1.0) if expected[name] else abs(value))
            determined.append(sure)
            if sure and away > 0.0:
                misses.append(away / (high - low))
    n, cover = sum(map(len, hits.values())), sum(map(sum, hits.values()))
    seconds = [one["seconds"] for one in done]
    return {
        "parameters": [*expected],
        "true values": expected,
        "runs": len(done),
        "intervals": n,
        "cover": cover,
        "covered": {name: f"{sum(each)} of {len(each)}" for name, each in hits.items()},
        "95 % interval of the coverage": binomial(cover, n),
        "none": none,
        "largest miss of a determined interval, in its widths": max(misses, default=0.0),
        "median error": float(np.median(errors)),
        "determined": float(np.mean(determined)),
        "explains": float(np.mean([one["explains"] for one in done])),
        "CPU seconds for each fit": float(np.mean(seconds)),
        "longest fit, CPU seconds": float(np.max(seconds)),
    }


def binomial(cover: int, n: int) -> list[float]:
    """Return the 95 % interval of Clopper and Pearson (Biometrika 1934) of a share."""
    from scipy.stats import binomtest

    return [*binomtest(cover, n).proportion_ci(0.95)]


def from_defaults(case: Case, number: int, kept: Path) -> dict[str, Any]:
    """Fit one recording by worlds with random defaults of the fitted parameters.

    Defaults are log-uniform within a factor of ten of those in the file, or, where these are zero,
    of the true value; uniform between 0 and 1 where this is zero, too, and between -1 and 1 if the
    parameter has a sign. A delay has the default 0. The spread of values is the largest difference
    of two of them, in widths of the interval of the first fit.
    """
    world = world_of(case)
    true, expected = recorded_by(world, case)
    recording, names = record(world, true, case, 0), [*expected]

    def fit(seed: int) -> sw.Fit:
        rng, given = np.random.default_rng(seed), dict[str, Any]()
        for name in names:
            factor, share = 10.0 ** rng.uniform(-1.0, 1.0), rng.uniform(-1.0, 1.0)
            if name == "delay":
                continue
            variable, usual = name.partition("[")[0], default_of(world, name) or expected[name]
            if "[" in name:
                given[variable] = np.where(np.arange(3) == int(name[-2]), share, 0.0)
            else:
                given[variable] = factor * usual if usual else abs(share)
        return world.given(given).fit(recording, names)

    done = studied(kept, number, fit)
    spreads = dict[str, dict[str, float]]()
    for name in names:
        values, lows, highs, _ = map(np.array, zip(*(o["fitted"][name] for o in done), strict=True))
        columns = {"value": values, "low": lows, "high": highs}
        width = highs[0] - lows[0]
        spreads[name] = {what: float(np.ptp(each) / width) for what, each in columns.items()}
    return {
        "fits": len(done),
        "largest difference, in widths of the interval": spreads,
        "within a tenth": max(each["value"] for each in spreads.values()) <= 0.1,
        "determined": [all(one["fitted"][n][3] for n in names) for one in done],
        "CPU seconds for each fit": float(np.mean([one["seconds"] for one in done])),
    }


def payload() -> dict[str, Any]:
    """Fit the mass of a hand under stiff servos, then with a suggested experiment."""
    case = Case(
        "gymnasium",
        "envs/mujoco/assets/pusher_v5.xml",
        {"r_wrist_roll_link.mass": 2.0},
        noise={"r_*.position": 2e-3},
        change=stiff,
    )
    world = world_of(case)
    (name,) = case.factors
    truth = deviating(world, case)
    true = world.given(truth)
    world.reset(seed=0)
    held = np.repeat(world.task.idle(world)[None], case.steps, axis=0)
    still = record(world, true, case, 0, held)
    before = world.fit(still, [name])
    (experiment,) = before.suggest(1)
    moved = replace(case, start=experiment.start)
    after = world.fit([still, record(world, true, moved, 1, experiment.commands)], [name])
    found: dict[str, Any] = {"true value": truth[name]}
    for when, fit in (("before", before), ("after", after)):
        row = fit.table.iloc[0]
        found[when] = {key: row[key] for key in ("value", "low", "high")}
        found[when] |= {"determined": bool(row.determined), "remarks": fit.remarks}
    return {**found, "experiment": str(experiment)}


def beside_sysid() -> dict[str, Any]:
    """Fit one recording of the acrobot with ``mujoco.sysid``, from the true start state."""
    sysid: Any = importlib.import_module("mujoco.sysid")
    if not hasattr(sysid, "optimize"):
        return {"mujoco.sysid": "its extra is not installed: pip install mujoco[sysid]"}
    case = CASES["acrobot: damping"]
    world = world_of(case)
    truth = deviating(world, case)
    found = record(world, world.given(truth), case, 0)
    begin = time.perf_counter()
    fit = world.fit(found, [*truth])
    ours = {
        "seconds": time.perf_counter() - begin,
        **fit.table.set_index("parameter")[["value", "low", "high"]].T.to_dict(),
    }
    spec = mujoco.MjSpec.from_file(
        str(Path(importlib.import_module(case.package).__path__[0]) / case.file)
    )
    joints = ("shoulder", "elbow")
    for joint in joints:
        spec.add_sensor(
            name=joint,
            type=mujoco.mjtSensor.mjSENS_JOINTPOS,
            objtype=mujoco.mjtObj.mjOBJ_JOINT,
            objname=joint,
        )
    model = spec.compile()
    skip = round(world.options.control_period / model.opt.timestep)
    (command,) = world.compiled.actions
    held = np.repeat(found[command], skip, axis=0)
    times = model.opt.timestep * np.arange(len(held) + 1)
    measured = np.column_stack(
        [np.interp(times, found["time"], found[f"{j}.position"].ravel()) for j in joints]
    )
    names = [model.sensor(i).name for i in range(model.nsensor)]
    data = np.zeros((len(times), model.nsensordata))
    for i, joint in enumerate(joints):
        data[:, model.sensor(joint).adr[0]] = measured[:, i]
    parameters = sysid.ParameterDict()
    world.reset(seed=0)
    for joint in joints:
        default = float(world[f"{joint}.damping"])

        def write(spec: Any, parameter: Any, joint: str = joint) -> None:
            spec.joint(joint).damping[0] = parameter.value[0]

        parameters.add(
            sysid.Parameter(
                f"{joint}.damping", nominal=default, min_value=0.0, max_value=1.0, modifier=write
            )
        )
    state = sysid.create_initial_state(
        model, np.zeros(model.nq), np.zeros(model.nv), np.zeros(model.na)
    )
    series = sysid.TimeSeries(times[:-1], held), sysid.TimeSeries.from_names(times, data, model)
    sequence = sysid.ModelSequences("acrobot", spec, "run", state, *series)
    kept = [(name, sysid.SignalType.MjSensor) for name in names if name in joints]
    begin = time.perf_counter()
    residual = sysid.build_residual_fn(models_sequences=[sequence], enabled_observations=kept)
    fitted, result = sysid.optimize(initial_params=parameters, residual_fn=residual, verbose=False)
    _, reach = sysid.calculate_intervals(residual(result.x, fitted)[0], result.jac)
    theirs: dict[str, Any] = {"seconds": time.perf_counter() - begin}
    for name, far in zip(truth, np.ravel(reach), strict=True):
        value = float(fitted[name].value[0])
        theirs[name] = {"value": value, "low": value - far, "high": value + far}
    return {"true values": truth, "scm_world": ours, "mujoco.sysid": theirs}


def main() -> None:
    """Fit all cases."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=17, help="recordings of each model")
    parser.add_argument("--defaults", type=int, default=10, help="random defaults of each model")
    parser.add_argument("--only", default="", help="cases whose names contain this")
    parser.add_argument("--out", type=Path, default=HERE / "fit.json")
    parser.add_argument("--kept", type=Path, default=Path("fit-runs"), help="fits of this study")
    asked = parser.parse_args()
    found: dict[str, Any] = {
        "runs": asked.runs,
        "versions": versions(f"mujoco {mujoco.__version__}"),
    }
    every, cases, same = {**CASES, **OTHERS, **MORE}, {}, {}
    asked.kept.mkdir(exist_ok=True)
    for name, case in every.items():
        if asked.only in name:
            kept = re.sub("[^a-z]+", "-", name)
            cases[name] = coverage(case, asked.runs, asked.kept / f"{kept}.jsonl")
            print(name, json.dumps(cases[name], indent=1), flush=True)
            if name in DEFAULTS and asked.defaults:
                kept = f"{kept}-defaults.jsonl"
                same[name] = from_defaults(case, asked.defaults, asked.kept / kept)
                print("from random defaults", json.dumps(same[name], indent=1), flush=True)
    found |= {"cases": cases, "from random defaults": same}
    for title, names in (("the six", CASES), ("others", OTHERS), ("more", MORE), ("all", every)):
        mine = [case for name, case in cases.items() if name in names]
        intervals, cover = (sum(case[what] for case in mine) for what in ("intervals", "cover"))
        found[title] = {"intervals": intervals, "cover": cover}
        print(f"{title}: {cover} of {intervals} intervals cover")
    if not asked.only:
        for title, more in (("payload", payload), ("mujoco.sysid", beside_sysid)):
            found[title] = more()
            print(title, json.dumps(found[title], indent=1, default=float), flush=True)
        asked.out.write_text(json.dumps(found, indent=1, default=float) + "\n")


if __name__ == "__main__":
    main()

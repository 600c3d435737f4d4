"""One physics client of the engine, with a model in it."""

from __future__ import annotations

import math
import statistics
import weakref
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, final

import mujoco
import numpy as np

from scm_world._types import Floats, Integers
from scm_world.backends.base import ContactPoint
from scm_world.backends.bullet.build import BALL, FREE, Built, custom, solid
from scm_world.backends.bullet.engine import Connection
from scm_world.backends.bullet.honoured import realized, rebuilt, rotations
from scm_world.backends.bullet.joints import JointSet, parts
from scm_world.backends.mujoco import reading
from scm_world.backends.mujoco.realization import Realization
from scm_world.backends.mujoco.trees import Couplings, disabled
from scm_world.errors import EngineFailure
from scm_world.models.model import Model
from scm_world.models.scene import ParameterKey, Parameters

_OFF = mujoco.mjtDisableBit
SMOOTH = int(_OFF.mjDSBL_CONSTRAINT) | int(_OFF.mjDSBL_AUTORESET)
"""What is switched off while MuJoCo computes smooth forces."""

SOLVER_ITERATIONS = 50  # with 20, towers spike at 40 mm/s
TOLERANCE = 1e-6  # how far a state that was set may read back from what was asked

Setting = tuple[str, tuple[int, ...], str]
"""A function of the engine, the body and the link that it is called with, and what it sets."""


@final
@dataclass(frozen=True)
class Instant:
    """A moment, without the caches of the engine.

    Attributes:
        structure: The bodies.
        parameters: All of them. Neither the mapping nor an array in it is ever changed in place.
        state: The vector of a ``State``, with unit quaternions; never changed in place.
    """

    structure: Model
    parameters: Parameters
    state: Floats


def alike(one: Parameters, other: Parameters, keys: Iterable[ParameterKey]) -> bool:
    """Return whether some parameters have the same bits."""
    return all(one[k] is other[k] or one[k].tobytes() == other[k].tobytes() for k in keys)


def shares(mj: mujoco.MjModel, geoms: Iterable[int], usual: float) -> dict[int, float]:
    """Compute a number for each shape, so that a contact has the product of two as its friction.

    A model says the larger of two coefficients. The product is that wherever a moving shape
    touches fixed ones that are all alike, and wherever one of two moving shapes has the usual
    coefficient and the other at least that, if the floor has no more than it. The number of a
    moving shape depends on its own coefficient and on that of the first fixed shape alone, so
    that shapes which never touch leave one another alone to the last bit.

    Args:
        mj: With the coefficients in force.
        geoms: The shapes.
        usual: See ``usual_friction``.

    Returns:
        The number of each shape.
    """
    shapes = list(geoms)
    still = mj.body_treeid[mj.geom_bodyid[shapes]] < 0
    found = np.where(mj.geom_condim[shapes] == 1, 0.0, mj.geom_friction[shapes, 0])
    measure = found[still][0] if still.any() else None
    if not measure:  # nothing is fixed, or it is smooth: the other shape decides
        scale = math.sqrt(usual) if measure is None and usual else 1.0
        found = np.where(still, np.where(found == 0.0, 1.0, found), found / scale)
    else:
        scale = math.sqrt(max(measure, usual))
        found = np.where(still, found / measure * scale, np.maximum(found, measure) / scale)
    return dict(zip(shapes, found.tolist(), strict=True))


def usual_friction(mj: mujoco.MjModel) -> float:
    """Return the coefficient in the middle of those of the moving shapes that touch something."""
    shapes = Couplings(mj).touches.any(axis=1) & (mj.body_treeid[mj.geom_bodyid] >= 0)
    found = np.where(mj.geom_condim == 1, 0.0, mj.geom_friction[:, 0])[shapes]
    return float(statistics.median_low(found.tolist() or [0.0]))


def spinning_shares(mj: mujoco.MjModel) -> dict[int, float]:
    """Compute the share of each shape in the spinning friction of its pairs.

    The engine combines two shapes to ``s1 f2 + s2 f1`` with the factors f of sliding friction. With
    these shares that is the spinning friction of the pair where one of the two has the largest
    factor, at the factors of the compiled model.
    """
    shapes = {*mj.pair_geom1.tolist(), *mj.pair_geom2.tolist()}
    largest = max((float(mj.geom_friction[geom, 0]) for geom in shapes), default=0.0)
    if largest == 0.0:
        return dict.fromkeys(shapes, 0.0)
    return {
        geom: (1.0 - float(mj.geom_friction[geom, 0]) / (2.0 * largest)) / largest
        for geom in sorted(shapes)
    }


def restitution(damping: float) -> float:
    """Compute the share of speed that half a period of a spring with a damping ratio leaves."""
    if not 0.0 <= damping < 1.0:
        return 0.0
    return math.exp(-math.pi * damping / math.sqrt(1.0 - damping * damping))


def _pulled(mj: mujoco.MjModel) -> Integers:
    """List the bodies of trees that actuators or tendons reach."""
    trees = Couplings(mj)
    effects = [trees.actuator(i) for i in range(mj.nactuator)]
    effects += [trees.tendon(i) for i in range(mj.ntendon)]
    reached = frozenset[int]().union(*(always for always, _ in effects))
    bodies = [body for body in range(mj.nbody) if trees.tree(body) in reached]
    return np.array(bodies, dtype=np.int64)


@final
class SavedState:
    """Stands for a state that a client keeps; the client forgets it when nobody holds this."""


@final
class Client:
    """A physics client with a model in it, and MuJoCo's own model beside it.

    MuJoCo takes the parameters, has what follows from them, gives the forces of actuators,
    springs, dampers and media, and converts states. Nothing moves there: each of its numbers that
    concerns the engine is told to the engine when it differs from what that was told before.

    Args:
        engine: The module ``pybullet``.

    Attributes:
        engine: Its functions for this client.
        holds: The history or the instant that it is in; set by the caller.
    """

    def __init__(self, engine: Any) -> None:
        self.engine = engine = Connection(engine)
        self.holds: Any = None
        self._model: Model | None = None
        self._told: dict[Setting, Any] = {}  # settings of the engine that are in force
        self._inside: Parameters | None = None  # parameters that were built into the bodies
        self._ruled: set[tuple[int, int, int, int]] = set()  # pairs of links with a rule
        self._saved: list[
            tuple[weakref.ref[SavedState], int, Floats]
        ] = []  # number and activations
        self._built = Built(engine)
        engine.setPhysicsEngineParameter(
            numSolverIterations=SOLVER_ITERATIONS, deterministicOverlappingPairs=1
        )

    # --- bodies ----------------------------------------------------------------------------------

    def canonicalize(self, instant: Instant) -> None:
        """Build the one world with these parameters and this state, independently of the past.

        Bodies stay where all their shapes stay; all else that depends on the past, the contact
        caches, is cleared by entering the collision objects again, always in one order.
        """
        self.holds = None
        self._forget(everything=True)
        self._construct(instant.structure, instant.parameters)
        self._twin.reset()  # what the last step left there must not matter
        self._twin.place(instant.state)
        for part in self._parts:
            part.put(self._twin.data)
        for place in self._built.geoms.values():  # pairs decide what touches
            self.engine.setCollisionFilterGroupMask(*place, 0, 0)
        self._check(instant.state)

    def _construct(self, model: Model, parameters: Parameters) -> None:
        """Make what differs from what is there, and what live bodies cannot take on."""
        model = realized(model)
        if self._model != model:
            compiled = reading.compiled(model)
            self._model, self._inside = None, None
            self._twin, self._given = Realization(model, parameters), dict(parameters)
            self._pulled = _pulled(compiled)
            self._usual, self._spinning = usual_friction(compiled), spinning_shares(compiled)
            trees = Couplings(compiled)
            self._dynamic = np.flatnonzero(trees.dynamic.any(axis=1)).tolist()
            self._touching = np.argwhere(np.triu(trees.touches)).tolist()
            self._shapes = np.flatnonzero(trees.touches.any(axis=1)).tolist()
            ends = zip(compiled.pair_geom1.tolist(), compiled.pair_geom2.tolist(), strict=True)
            self._paired = {geom: pair for pair, both in enumerate(ends) for geom in both}
            self._model = model
        self._take(parameters)
        if self._inside is None or not alike(self._inside, parameters, rebuilt(model)):
            self._inside, mj = None, self._twin.model
            gone = self._built.make(mj, self._shapes)
            self._told = {what: v for what, v in self._told.items() if gone.isdisjoint(what[1][:1])}
            self._connect()
            self._parts = parts(self.engine, mj, self._built.joints, range(mj.ntree))
            self._trees, self._driven = set[int](), list[JointSet]()
            self._inside, self._changed = parameters, True
        self._tell_all()

    def _connect(self) -> None:
        """Set which shapes may touch, pair by pair."""
        geoms = self._built.geoms
        # The engine has one rule for two links, in whichever order they are named.
        pairs = (sorted((geoms[one], geoms[two])) for one, two in self._touching)
        wanted = {(*first, *second) for first, second in pairs}
        self._ruled |= wanted  # this holds as long as the client
        for body, link, other, its in sorted(self._ruled):
            enabled = int((body, link, other, its) in wanted)
            self.engine.setCollisionFilterPair(body, other, link, its, enabled)

    def _check(self, state: Floats) -> None:
        """Check that the engine took the state, up to rounding and the sign of a quaternion.

        Raises:
            EngineFailure: It did not.
        """
        actual, model = self.read(), self._twin.structure
        for start in rotations(model):
            where = slice(start, start + 4)
            if actual[where] @ state[where] < 0.0:
                actual[where] *= -1.0
        near = abs(actual - state) <= TOLERANCE * (1.0 + abs(state))
        if not near[model.layout.can_be_set].all():
            raise EngineFailure("Bullet did not take the state that was set", "bullet")

    # --- parameters ------------------------------------------------------------------------------

    def edit(self, parameters: Parameters) -> None:
        """Change parameters that need no new bodies. What is in force already is left alone.

        Raises:
            Infeasible: Nothing can move with them. Nothing has changed.
        """
        self._take(parameters)
        self._tell_all()

    def _take(self, parameters: Parameters) -> None:
        """Write the parameters that are new to MuJoCo's model."""
        fresh = {k: v for k, v in parameters.items() if self._given.get(k) is not v}
        if fresh:
            self._twin.edit(fresh)
            self._given, self._changed = {**self._given, **fresh}, True

    def _tell_all(self) -> None:
        """Set in the engine whatever differs from its last setting."""
        if not self._changed:
            return
        for what, value in self._settings():
            if self._told.get(what) != value:
                self._told.pop(what, None)  # unknown, should the engine fail
                getattr(self.engine, what[0])(*what[1], **value[0])
                self._told[what] = value
        moved = self._moved()
        if self._trees != moved:
            self._trees = moved
            self._driven = parts(self.engine, self._twin.model, self._built.joints, moved)
        self._changed = False

    def _settings(self) -> Iterator[tuple[Setting, tuple[dict[str, Any], Any]]]:
        """List the settings of bodies: arguments, and what else their effect depends on."""
        mj, built = self._twin.model, self._built
        off = disabled(mj, _OFF.mjDSBL_GRAVITY)
        gravity = dict(zip(("gravX", "gravY", "gravZ"), mj.opt.gravity.tolist(), strict=True))
        yield ("setGravity", (), ""), (dict.fromkeys(gravity, 0.0) if off else gravity, None)
        # An early end, decided for all bodies together, lets bodies act on each other without
        # touching: only a model that asks for it has one.
        early = custom(mj, "bullet_early_end")
        for name, number in (
            ("fixedTimeStep", mj.opt.timestep),
            ("solverResidualThreshold", early),
        ):
            yield ("setPhysicsEngineParameter", (), name), ({name: number}, None)
        for body, place in built.bodies.items():
            moments = solid(mj, body)[0].tolist()
            inertia = {"mass": float(mj.body_mass[body]), "localInertiaDiagonal": moments}
            yield ("changeDynamics", place, "inertia"), (inertia, None)
        rigid = not disabled(mj, _OFF.mjDSBL_CONSTRAINT)
        dry = rigid and not disabled(mj, _OFF.mjDSBL_FRICTIONLOSS)
        ends = rigid and not disabled(mj, _OFF.mjDSBL_LIMIT)
        for joint, place in built.joints.items():
            if mj.jnt_type[joint] in (FREE, BALL):
                continue
            if ends and mj.jnt_limited[joint]:
                low, high = (mj.jnt_range[joint] - mj.qpos0[mj.jnt_qposadr[joint]]).tolist()
                limits = {"jointLowerLimit": low, "jointUpperLimit": high}
                yield ("changeDynamics", place, "limits"), (limits, None)
            loss = float(mj.dof_frictionloss[mj.jnt_dofadr[joint]]) if dry else 0.0
            brake = {"controlMode": self.engine.VELOCITY_CONTROL, "targetVelocity": 0.0}
            held = loss and mj.opt.timestep  # the engine keeps it as an impulse of a step
            yield ("setJointMotorControl2", place, ""), ({**brake, "force": loss}, held)
        frictions = [
            (geom, "lateralFriction", share)
            for geom, share in shares(mj, self._dynamic, self._usual).items()
        ]
        for geom, pair in self._paired.items():
            slides, spins, _ = mj.geom_friction[geom].tolist()
            bounce = math.sqrt(restitution(float(mj.pair_solref[pair, 1])))
            frictions += [
                (geom, "lateralFriction", slides),
                (geom, "spinningFriction", spins * self._spinning[geom]),
                (geom, "restitution", bounce),
            ]
        for geom, name, number in frictions:
            yield ("changeDynamics", built.geoms[geom], name), ({name: number}, None)

    def _moved(self) -> set[int]:
        """List the trees on which smooth forces act, other than weight."""
        mj = self._twin.model
        if mj.opt.density > 0.0 or mj.opt.viscosity > 0.0:
            return set(range(mj.ntree))
        bodies = (
            mj.dof_bodyid[mj.dof_damping != 0.0],
            mj.jnt_bodyid[mj.jnt_stiffness != 0.0],
            np.flatnonzero(mj.body_gravcomp),
            self._pulled,
        )
        return set(mj.body_treeid[np.concatenate(bodies)].tolist())

    def parameters(self, keys: Iterable[ParameterKey]) -> Parameters:
        """Read parameters from the arrays that the engine's numbers are made of."""
        return self._twin.parameters(keys)

    def remarks(self, before: Parameters) -> tuple[str, ...]:
        """List which frictions were changed without an effect; see ``shares``."""
        twin, found = self._twin, list[str]()
        now = shares(twin.model, self._dynamic, self._usual)
        for key, old in before.items():
            if key[1] == "friction":
                present = twin.kept[key]
                twin.edit({key: old})
                if shares(twin.model, self._dynamic, self._usual) == now:
                    found.append(
                        f"{'.'.join(key)} has no effect: the larger coefficient of two shapes "
                        "counts, and those of the others are larger"
                    )
                twin.edit({key: present})
        return tuple(found)

    # --- steps -----------------------------------------------------------------------------------

    def step(self, command: Sequence[float], substeps: int) -> None:
        """Hold a command for some physics steps.

        What brakes in proportion to speed acts with the speed at the end of the step: with that
        before the step, light links would turn back faster than they came. With mass matrix M,
        bias b, forces f and slopes D, MuJoCo's integrator ``implicitfast`` has the acceleration
        ``a = (M + h D)^-1 (f - b)``, and ``Euler`` has the slopes of passive dampers alone; the
        forces ``M a + b`` let the engine's explicit step have it.
        """
        self._twin.forget()
        mj, data, options = self._twin.model, self._twin.data, self._twin.model.opt
        asked = options.disableflags, options.integrator
        options.disableflags |= SMOOTH
        if options.integrator == mujoco.mjtIntegrator.mjINT_RK4:
            options.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        if custom(mj, "bullet_explicit_servos"):
            options.integrator = mujoco.mjtIntegrator.mjINT_EULER
        self._twin.command[:] = command
        forces, rates, step = np.empty(mj.nv), np.empty(mj.nv), options.timestep
        advance = self.engine.stepSimulation
        for _ in range(substeps):
            if self._driven:
                for part in self._driven:
                    part.take(data)
                speeds = data.qvel.copy()
                mujoco.mj_step(mj, data)
                np.subtract(data.qvel, speeds, out=rates)
                rates /= step
                mujoco.mj_mulM(mj, data, forces, rates)
                forces += data.qfrc_bias
                for part in self._driven:
                    part.drive(data, forces)
            advance()
        options.disableflags, options.integrator = asked

    def read(self) -> Floats:
        """Ask the engine for the state."""
        for part in self._parts:
            part.take(self._twin.data)
        vector = np.empty(self._twin.structure.layout.size)
        self._twin.read(vector)
        return vector

    def contacts(self) -> tuple[ContactPoint, ...]:
        """List the points of the last physics step that touch or press.

        The engine also keeps points of bodies that only came near; they are left out.
        """
        names = {h: self._twin.structure.owners[geom] for geom, h in self._built.geoms.items()}
        return tuple(
            ContactPoint(
                bodies=(names[point[1], point[3]], names[point[2], point[4]]),
                position=(np.array(point[5]) + np.array(point[6])) / 2,
                normal=-np.array(point[7]),  # the engine's points to the first body
                depth=-point[8],
                force=point[9],
            )
            for point in self.engine.getContactPoints()
            if point[8] <= 0.0 or point[9] > 0.0
        )

    # --- saved states ----------------------------------------------------------------------------

    def save(self) -> SavedState:
        """Keep the engine's own state in this process as long as what is returned is held."""
        self._forget()
        saved = SavedState()
        number, activations = self.engine.saveState(), self._twin.data.act.copy()
        self._saved.append((weakref.ref(saved), number, activations))
        return saved

    def load(self, saved: SavedState) -> bool:
        """Go back to a state if it is kept here. Parameters are not part of it."""
        for reference, number, activations in self._saved:
            if reference() is saved:
                self._twin.data.act[:] = activations
                self.engine.restoreState(stateId=number)
                return True
        return False

    def _forget(self, *, everything: bool = False) -> None:
        """Free states that nobody holds, or all: beyond a canonical state they are not exact."""
        kept = []
        for entry in self._saved:
            if everything or entry[0]() is None:
                self.engine.removeState(entry[1])
            else:
                kept.append(entry)
        self._saved = kept

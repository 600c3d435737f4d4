"""One physics client of the engine, with a model in it."""

from __future__ import annotations

import math
import statistics
import weakref
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from types import ModuleType
from typing import Any, final

import mujoco
import numpy as np

from scm_world._types import Floats
from scm_world.backends.base import ContactPoint
from scm_world.backends.bullet.build import EngineBody, custom, renewed
from scm_world.backends.bullet.engine import Connection
from scm_world.backends.bullet.honoured import realized, rebuilt
from scm_world.backends.bullet.joints import Free, JointSet, parts
from scm_world.backends.mujoco import reading
from scm_world.backends.mujoco.fields import BALL, FREE
from scm_world.backends.mujoco.realization import Realization
from scm_world.backends.mujoco.sources import LEAST
from scm_world.backends.mujoco.trees import Couplings, disabled
from scm_world.models.model import Model
from scm_world.models.scene import ParameterKey, Parameters

_OFF = mujoco.mjtDisableBit
SMOOTH = int(_OFF.mjDSBL_CONSTRAINT) | int(_OFF.mjDSBL_AUTORESET)
"""Flags that are off while MuJoCo computes smooth forces."""

SOLVER_ITERATIONS = 50  # with 20, towers spike at 40 mm/s


@final
@dataclass(frozen=True, eq=False)
class CanonicalState:
    """A canonical world: a function of these three, without the caches of the engine.

    Attributes:
        structure: The bodies.
        parameters: All of them. Neither the mapping nor an array in it is ever changed in place.
        state: The vector of a ``State``, with unit quaternions; never changed in place.
    """

    structure: Model
    parameters: Parameters
    state: Floats

    def differs_lightly(self, other: CanonicalState) -> bool:
        """Return whether it is another one but for parameters that live bodies can take on."""
        settable = self.structure.layout.can_be_set
        return (
            self.structure == other.structure
            and np.array_equal(self.state[settable], other.state[settable])
            and alike(self.parameters, other.parameters, rebuilt(self.structure))
        )


@final
@dataclass(frozen=True, eq=False)
class Past:
    """A canonical world, and the control steps since.

    Attributes:
        start: The canonical world.
        steps: For each, all parameters in force, the command, and for how many physics steps.
    """

    start: CanonicalState
    steps: tuple[tuple[Parameters, list[float], int], ...] = ()


@final
class SavedState:
    """A state that a client keeps as long as this is held. It is pickled as None."""

    def __init__(self, number: int, activations: Floats) -> None:
        self.number, self.activations = number, activations

    def __reduce__(self) -> tuple[type[None], tuple[()]]:
        return type(None), ()


def alike(one: Parameters, other: Parameters, keys: Iterable[ParameterKey]) -> bool:
    """Return whether some parameters have the same bits."""
    return all(one[k] is other[k] or one[k].tobytes() == other[k].tobytes() for k in keys)


def shares(mj: mujoco.MjModel, shapes: list[int], usual: float) -> Floats:
    """Compute a number for each shape, so that a contact has the product of two as its friction.

    A model says the larger of two coefficients. The product is that wherever a moving shape
    touches fixed ones that are all alike, and wherever one of two moving shapes has the usual
    coefficient and the other at least that, if the floor has no more than it. The number of a
    moving shape depends on its own coefficient and on that of the first fixed shape alone, so
    that shapes which never touch leave one another alone to the last bit.
    """
    still = mj.body_treeid[mj.geom_bodyid[shapes]] < 0
    found: Floats = np.where(mj.geom_condim[shapes] == 1, 0.0, mj.geom_friction[shapes, 0])
    measure = found[still][0] if still.any() else None
    if not measure:  # nothing is fixed, or it is smooth: the other shape decides
        scale = math.sqrt(usual) if measure is None and usual else 1.0
        numbers = np.where(still, np.where(found == 0.0, 1.0, found), found / scale)
    else:
        scale = math.sqrt(max(measure, usual))
        numbers = np.where(still, found / measure * scale, np.maximum(found, measure) / scale)
    return np.asarray(numbers, dtype=np.float64)


def usual_friction(mj: mujoco.MjModel) -> float:
    """Return the coefficient in the middle of those of the moving shapes that touch something."""
    shapes = Couplings(mj).touches.any(axis=1) & (mj.body_treeid[mj.geom_bodyid] >= 0)
    found = np.where(mj.geom_condim == 1, 0.0, mj.geom_friction[:, 0])[shapes]
    return float(statistics.median_low(found.tolist() or [0.0]))


def spinning_shares(mj: mujoco.MjModel, shapes: list[int]) -> Floats:
    """Compute the share of each shape of a pair in the spinning friction of its pairs.

    The engine combines two shapes to ``s1 f2 + s2 f1`` with the factors f of sliding friction. With
    these shares that is the spinning friction of the pair where one of the two has the largest
    factor, at the factors of the compiled model.
    """
    factors: Floats = mj.geom_friction[shapes, 0]
    largest = float(factors.max(initial=0.0))
    if largest == 0.0:
        return np.zeros(len(shapes))
    return (1.0 - factors / (2.0 * largest)) / largest


def restitution(damping: float) -> float:
    """Compute the share of speed that half a period of a spring with a damping ratio leaves."""
    if not 0.0 <= damping < 1.0:
        return 0.0
    return math.exp(-math.pi * damping / math.sqrt(1.0 - damping * damping))


@final
class Client:
    """A physics client with a model in it, and MuJoCo's own model beside it.

    MuJoCo takes the parameters, has what follows from them, gives the forces of actuators,
    springs, dampers and media, and converts states. Nothing moves there: each of its numbers that
    concerns the engine is set in the engine when it differs from its last setting.
    After an error other than ``Infeasible`` a client is of no use.

    Attributes:
        engine: Its functions for this client.
        holds: The world that it is in, with the parameters in force.
        twin: MuJoCo's model.
        bodies: The link that carries the mass of each body that can move, by its number.
        joints: The link of each joint, by its number; the base of a free body.
        geoms: The link of each shape that can touch something, by its number.
    """

    def __init__(self, module: ModuleType) -> None:
        self.engine = engine = Connection(module)
        self.holds: Past | None = None
        self._model: Model | None = None
        self._parameters: Parameters = {}  # in force
        self._in_force: list[Floats] = []  # rows of settings that are in force
        self._units: list[EngineBody] = []
        self._enabled: set[tuple[int, int, int, int]] = set()  # pairs of links that may touch
        self._saved: dict[int, weakref.ref[SavedState]] = {}
        engine.setPhysicsEngineParameter(
            numSolverIterations=SOLVER_ITERATIONS, deterministicOverlappingPairs=1
        )

    # --- bodies ----------------------------------------------------------------------------------

    def replay(self, world: Past) -> None:
        """Build a world, independently of the one before.

        Bodies stay where all their shapes stay; all else that depends on the past, the contact
        caches, is cleared by entering the collision objects again, always in one order.
        """
        self.holds, first = None, world.start
        self._free(self._saved)  # beyond a canonical world they are not exact
        self._construct(realized(first.structure), first.parameters)
        self.twin.reset()  # what the last step left there must not matter
        self.twin.place(first.state)
        for part in self._parts:
            part.put()
        for place in self.geoms.values():  # pairs decide what touches
            self.engine.setCollisionFilterGroupMask(*place, 0, 0)
        for parameters, command, substeps in world.steps:
            self.edit(parameters)
            self.step(command, substeps)
        self.holds = world

    def _construct(self, model: Model, parameters: Parameters) -> None:
        """Build the units that differ, and those with changes that live bodies cannot take on."""
        stays = self._model == model and alike(self._parameters, parameters, rebuilt(model))
        if self._model != model:
            self.twin = Realization(model, parameters)
            self._model, self._parameters = model, parameters
            self._read_tables(reading.compiled(model))
        if stays:
            self.edit(parameters)
            return
        self.twin.edit(parameters)
        self._parameters, mj = parameters, self.twin.model
        self._units = renewed(self.engine, self._units, mj, self._shapes)
        self.bodies, self.joints, self.geoms = (
            {
                number: (unit.multibody, link)
                for unit in self._units
                for number, link in getattr(unit, kind).items()
            }
            for kind in ("bodies", "joints", "geoms")
        )
        # The engine has one rule for two links, in whichever order they are named, and keeps it.
        pairs = (sorted((self.geoms[one], self.geoms[two])) for one, two in self._touching)
        enabled = {(*first, *second) for first, second in pairs}
        for pair in sorted(self._enabled ^ enabled):
            body, link, other, its = pair
            self.engine.setCollisionFilterPair(body, other, link, its, int(pair in enabled))
        self._enabled = enabled
        self._parts = parts(self.engine, self.twin.data, self.joints, range(mj.ntree))
        self._scalar = [joint for joint in self.joints if mj.jnt_type[joint] not in (FREE, BALL)]
        self._in_force, self._trees, self._driven = [], set[int](), list[JointSet]()
        self._set_all()

    def _read_tables(self, mj: mujoco.MjModel) -> None:
        """Read from a compiled model what no parameter changes."""
        trees = Couplings(mj)
        effects = [trees.actuator(i) for i in range(mj.nactuator)]
        effects += [trees.tendon(i) for i in range(mj.ntendon)]
        reached = frozenset[int]().union(*(always for always, _ in effects))
        bodies = [body for body in range(mj.nbody) if trees.tree(body) in reached]
        self._pulled = set(mj.body_treeid[bodies].tolist())
        self._dynamic = np.flatnonzero(trees.dynamic.any(axis=1)).tolist()
        self._touching = np.argwhere(np.triu(trees.touches)).tolist()
        self._shapes = np.flatnonzero(trees.touches.any(axis=1)).tolist()
        ends = zip(mj.pair_geom1.tolist(), mj.pair_geom2.tolist(), strict=True)
        pair_of = {geom: pair for pair, both in enumerate(ends) for geom in both}
        self._paired, self._pair = list(pair_of), list(pair_of.values())
        self._usual, self._spinning = usual_friction(mj), spinning_shares(mj, self._paired)

    # --- parameters ------------------------------------------------------------------------------

    def edit(self, parameters: Parameters) -> None:
        """Change parameters that need no new bodies. Values already in force are left alone."""
        if parameters is self._parameters:
            return
        fresh = {k: v for k, v in parameters.items() if self._parameters.get(k) is not v}
        if fresh:
            self.twin.edit(fresh)
        self._parameters = parameters
        if fresh:
            self._set_all()

    def _set_all(self) -> None:
        """Set in the engine whatever differs from its last setting."""
        settings = list[Floats]()
        for number, (function, places, keys, names, rows) in enumerate(self._settings()):
            settings.append(rows)
            known = self._in_force[number] if self._in_force else np.full_like(rows, np.nan)
            if rows.tobytes() != known.tobytes():
                for index in np.flatnonzero((rows != known).any(axis=1)).tolist():
                    values = dict(zip(names, rows[index].tolist(), strict=False))
                    function(*places[keys[index]], **values)
        self._in_force = settings
        moved = self._moved()
        if self._trees != moved:
            self._trees = moved
            self._driven = parts(self.engine, self.twin.data, self.joints, moved)
        mj, kinds, own = self.twin.model, mujoco.mjtIntegrator, self.twin.model.opt.integrator
        implicit = kinds.mjINT_IMPLICITFAST if own == kinds.mjINT_RK4 else own
        self._integrator = kinds.mjINT_EULER if custom(mj, "bullet_explicit_servos") else implicit
        self._local = self._needs_joints_alone()
        self._sprung = bool(mj.jnt_stiffness.any() or mj.jnt_stiffnesspoly.any())

    def _settings(
        self,
    ) -> Iterator[
        tuple[Callable[..., Any], Mapping[int, tuple[int, ...]], list[int], tuple[str, ...], Floats]
    ]:
        """List functions of the engine: places by number, numbers, arguments, a row for each."""
        mj, engine = self.twin.model, self.engine

        def inertia(body: int, link: int, mass: float, **moments: float) -> None:
            engine.changeDynamics(body, link, mass=mass, localInertiaDiagonal=[*moments.values()])

        gravity = np.zeros(3) if disabled(mj, _OFF.mjDSBL_GRAVITY) else mj.opt.gravity.copy()
        yield engine.setGravity, {0: ()}, [0], ("gravX", "gravY", "gravZ"), gravity[None]
        # An early end, decided for all bodies together, lets bodies act on each other without
        # touching: only a model that asks for it has one.
        rows = np.array([[mj.opt.timestep, custom(mj, "bullet_early_end")]])
        names = "fixedTimeStep", "solverResidualThreshold"
        yield engine.setPhysicsEngineParameter, {0: ()}, [0], names, rows
        bodies = list(self.bodies)
        rows = np.column_stack([mj.body_mass[bodies], mj.body_inertia[bodies]])
        yield inertia, self.bodies, bodies, ("mass", "x", "y", "z"), rows
        scalar = self._scalar
        rigid = not disabled(mj, _OFF.mjDSBL_CONSTRAINT)
        if rigid and not disabled(mj, _OFF.mjDSBL_LIMIT):
            ended = [joint for joint in scalar if mj.jnt_limited[joint]]
            rows = mj.jnt_range[ended] - mj.qpos0[mj.jnt_qposadr[ended], None]
            names = "jointLowerLimit", "jointUpperLimit"
            yield engine.changeDynamics, self.joints, ended, names, rows
        loss = mj.dof_frictionloss[mj.jnt_dofadr[scalar]]
        if not rigid or disabled(mj, _OFF.mjDSBL_FRICTIONLOSS):
            loss = np.zeros(len(scalar))
        # The engine keeps it as an impulse of a step.
        rows = np.column_stack([loss, np.where(loss, mj.opt.timestep, 0.0)])
        brake = partial(
            engine.setJointMotorControl2, controlMode=engine.VELOCITY_CONTROL, targetVelocity=0.0
        )
        yield brake, self.joints, scalar, ("force",), rows
        surfaces = "lateralFriction", "spinningFriction", "restitution"
        if self._dynamic:
            rows = shares(mj, self._dynamic, self._usual)[:, None]
            yield engine.changeDynamics, self.geoms, self._dynamic, surfaces, rows
        slides, spins, _ = mj.geom_friction[self._paired].T
        damping = mj.pair_solref[self._pair, 1].tolist()
        bounces = {ratio: math.sqrt(restitution(ratio)) for ratio in {*damping}}
        rows = np.column_stack([slides, spins * self._spinning, [bounces[i] for i in damping]])
        yield engine.changeDynamics, self.geoms, self._paired, surfaces, rows

    def _moved(self) -> set[int]:
        """List the trees on which smooth forces act, other than weight."""
        mj = self.twin.model
        if mj.opt.density > 0.0 or mj.opt.viscosity > 0.0:
            return set(range(mj.ntree))
        bodies = (
            mj.dof_bodyid[mj.dof_damping != 0.0],
            mj.jnt_bodyid[mj.jnt_stiffness != 0.0],
            np.flatnonzero(mj.body_gravcomp),
            np.flatnonzero(self.twin.data.xfrc_applied.any(axis=1)),
        )
        return self._pulled.union(mj.body_treeid[np.concatenate(bodies)].tolist())

    def _needs_joints_alone(self) -> bool:
        """Return whether forces follow from coordinates of joints, and no damper is implicit."""
        mj = self.twin.model
        dampers = (mj.dof_damping, mj.dof_dampingpoly, mj.actuator_damping, mj.actuator_dampingpoly)
        return bool(self._driven) and not (
            self._integrator != mujoco.mjtIntegrator.mjINT_EULER
            or mj.na
            or mj.ntendon
            or mj.nplugin
            or mj.opt.density
            or mj.opt.viscosity
            or mj.body_gravcomp.any()
            or self.twin.data.xfrc_applied.any()
            or (mj.actuator_trntype != mujoco.mjtTrn.mjTRN_JOINT).any()
            or any((np.abs(numbers) > LEAST).any() for numbers in dampers)
            or any(isinstance(part, Free) for part in self._driven)
        )

    # --- steps -----------------------------------------------------------------------------------

    def step(self, command: Sequence[float], substeps: int) -> None:
        """Hold a command for some physics steps.

        What brakes in proportion to speed acts with the speed at the end of the step: with that
        before the step, light links would turn back faster than they came. With mass matrix M,
        bias b, forces f and slopes D, MuJoCo's integrator ``implicitfast`` has the acceleration
        ``a = (M + h D)^-1 (f - b)``, and ``Euler`` has the slopes of passive dampers alone; the
        forces ``M a + b`` let the engine's explicit step have it. Without implicit dampers these
        are f, which takes no pass over all bodies where it follows from the joints alone.
        """
        self.twin.forget()
        self.twin.command[:] = command
        mj, data, driven, local = self.twin.model, self.twin.data, self._driven, self._local
        (speeds, rates, forces), velocities, options = np.empty((3, mj.nv)), data.qvel, mj.opt
        advance, asked = self.engine.stepSimulation, (options.disableflags, options.integrator)
        lengths, motion = mujoco.mj_transmission, mujoco.mj_fwdVelocity
        servos, actuators, sprung = mujoco.mj_fwdActuation, data.qfrc_actuator, self._sprung
        if not local:
            options.disableflags, options.integrator = asked[0] | SMOOTH, self._integrator
        elif not sprung:
            forces = actuators
        for _ in range(substeps):
            for part in driven:
                part.take()
            if local:
                lengths(mj, data)
                motion(mj, data)
                servos(mj, data)
                if sprung:
                    np.add(data.qfrc_passive, actuators, out=forces)
            elif driven:
                speeds[:] = velocities
                mujoco.mj_step(mj, data)
                np.subtract(velocities, speeds, out=rates)
                rates /= options.timestep
                mujoco.mj_mulM(mj, data, forces, rates)
                forces += data.qfrc_bias
            for part in driven:
                part.drive(forces)
            advance()
        options.disableflags, options.integrator = asked

    def read(self) -> Floats:
        """Ask the engine for the state."""
        for part in self._parts:
            part.take()
        vector = np.zeros(self.twin.structure.layout.size)  # with states that the world keeps
        self.twin.read(vector)
        return vector

    def contacts(self) -> tuple[ContactPoint, ...]:
        """List the points of the last physics step that touch or press.

        The engine also keeps points of bodies that only came near; they are left out.
        """
        names = {h: self.twin.structure.owners[geom] for geom, h in self.geoms.items()}
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
        """Keep the engine's own state in this process as long as the returned object is held."""
        self._free(number for number, saved in self._saved.items() if saved() is None)
        saved = SavedState(self.engine.saveState(), self.twin.data.act.copy())
        self._saved[saved.number] = weakref.ref(saved)
        return saved

    def load(self, saved: SavedState) -> bool:
        """Restore a state if it is kept here. Parameters are not part of it."""
        if all(kept() is not saved for kept in self._saved.values()):
            return False
        self.twin.data.act[:] = saved.activations
        self.engine.restoreState(stateId=saved.number)
        return True

    def _free(self, numbers: Iterable[int]) -> None:
        for number in [*numbers]:
            self.engine.removeState(number)
            del self._saved[number]

"""Equality constraints: how far a pose is from them, and which states follow others by them.

A constraint has rows: residuals that are 0 where it holds, and their derivatives by the velocities.
States that follow are chosen so that the rows determine them from the others, and are found by
Newton's method. Source: MuJoCo, *Computation*, "Equality".
"""

from __future__ import annotations

from collections.abc import Container, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, final

import mujoco
import numpy as np
from numpy.typing import NDArray

from scm_world._types import ArrayLike, Floats, Integers
from scm_world.backends.mujoco.fields import SLIDE, element_names, tendon_unit
from scm_world.backends.mujoco.readouts import MOVING, to_compute_on
from scm_world.backends.mujoco.slots import Finder
from scm_world.backends.mujoco.sources import Source
from scm_world.backends.mujoco.trees import merged
from scm_world.models.model import Parameter, StateRow

_EQ = mujoco.mjtEq
_EXACT, _HOLDS = 1e-12, 1e-6
"""Residuals at which Newton's method ends, and up to which a constraint holds [m] or [rad]."""
BEYOND = 1e-4
"""How far beyond its limits a state may follow at the start [m] or [rad]."""
STAGES, ROUNDS = 8, 20
"""Into so many stages a way is cut, with at most so many steps of Newton's method in each."""
KEPT = 256
"""How many solutions are kept for a model, which keeps them."""

SWITCHES = ("active", "polycoef")
"""Attributes of a constraint that decide where it holds."""
Violation = tuple[str, str, float, str]


def _rows(mj: mujoco.MjModel, data: mujoco.MjData) -> tuple[Integers, Floats]:
    """Compute the constraints of a pose; return which of them are in force, and the residuals.

    Both have shape (nefc,); rows that are not of equality constraints have the number -1.
    """
    mujoco.mj_kinematics(mj, data)
    mujoco.mj_comPos(mj, data)
    mujoco.mj_flex(mj, data)
    mujoco.mj_tendon(mj, data)
    mujoco.mj_makeConstraint(mj, data)
    equal = data.efc_type == int(mujoco.mjtConstraint.mjCNSTR_EQUALITY)
    return np.where(equal, data.efc_id, -1), data.efc_pos


def violations(mj: mujoco.MjModel, data: mujoco.MjData) -> Iterator[Violation]:
    """List the equality constraints of a pose that do not hold, with sizes in [m] and [rad]."""
    names = element_names(mj)
    owners, residuals = _rows(mj, data) if mj.neq else (np.empty(0), np.empty(0))
    for number in np.unique(owners[owners >= 0]).tolist():
        own, kind = residuals[owners == number], _EQ(int(mj.eq_type[number]))
        first, second = int(mj.eq_obj1id[number]), int(mj.eq_obj2id[number])
        what, parts = f"equality {names['equality'][number]}", [(float(np.abs(own).max()), "m")]
        if kind == _EQ.mjEQ_JOINT:
            unit = "m" if mj.jnt_type[first] == SLIDE else "rad"
            joints, parts = names["joint"], [(abs(float(own[0])), unit)]
            what = f"joint {joints[first]}, which follows {joints[second]}" if second >= 0 else what
        elif kind == _EQ.mjEQ_TENDON:
            parts = [(abs(float(own[0])), tendon_unit(mj, first))]
        elif kind == _EQ.mjEQ_CONNECT:
            parts = [(float(np.linalg.norm(own)), "m")]
        elif kind == _EQ.mjEQ_WELD:  # the last three are sin(angle / 2) times a scale
            scale = float(mj.eq_data[number, 10])
            sine = np.linalg.norm(own[3:]) / scale if scale else 0.0
            turned = 2.0 * float(np.arcsin(min(sine, 1.0)))
            parts = [(float(np.linalg.norm(own[:3])), "m"), (turned, "rad")]
        yield from (("equality", what, size, unit) for size, unit in parts if size > _HOLDS)


@final
@dataclass(frozen=True)
class Follower:
    """The value of a state at which equality constraints hold, as a function of others.

    Attributes:
        names: The states and the parameters that it follows.
        source: Source of the model.
        start: The coordinates where the way to the pose begins, shape (nq,).
        leaders: Those states, each as its array and places there.
        finders: Places of those parameters.
        equalities: The constraints.
        dofs: All velocities that follow by them.
        array: Array of the state, ``"qpos"`` or ``"qvel"``.
        numbers: Its places there.
        stages: How many there are.
    """

    names: tuple[str, ...]
    source: Source
    start: tuple[float, ...]
    leaders: tuple[tuple[str, tuple[int, ...]], ...]
    finders: tuple[Finder, ...]
    equalities: tuple[int, ...]
    dofs: tuple[int, ...]
    array: str = ""
    numbers: tuple[int, ...] = ()
    stages: int = 1

    def __call__(self, *values: ArrayLike) -> Floats | float:
        """Compute the value from those of the states and of the parameters that it follows."""
        given = tuple(np.ravel(value).astype(np.float64).tobytes() for value in values)
        way = self.start, self.leaders, self.stages
        rule = *way, self.finders, self.equalities, self.dofs, given
        known: dict[Any, tuple[Floats, Floats]] = vars(self.source).setdefault("_followers", {})
        solved = known.get(rule)  # those of one constraint are found together
        if solved is None:
            if len(known) >= KEPT:
                known.clear()
            solved = known[rule] = self._solved([*map(np.frombuffer, given)])
        qpos, qvel = solved
        found = (qpos if self.array == "qpos" else qvel)[[*self.numbers]]
        return found if len(found) > 1 else float(found[0])

    def _solved(self, values: Sequence[Floats]) -> tuple[Floats, Floats]:
        """Return the coordinates, shape (nq,), and the velocities, shape (nv,), of leaders' values.

        Where leaders are set to what no pose has, others stay at the last pose on the way there.
        """
        mj, data = to_compute_on(self.source, self.finders, values[len(self.leaders) :])
        data.qpos[:], data.qvel[:], dofs = self.start, 0.0, [*self.dofs]
        ways = [
            (getattr(data, array), [*numbers], getattr(data, array)[[*numbers]], value)
            for (array, numbers), value in zip(self.leaders, values, strict=False)
        ]
        last = data.qpos.copy()
        for stage in range(1, self.stages + 1):
            for array, numbers, begin, end in ways:
                array[numbers] = begin + stage / self.stages * (end - begin)
            jacobian, apart = _settle(mj, data, self.equalities, dofs)
            if apart > _HOLDS:
                data.qpos[:] = last
                for array, numbers, _, end in ways:
                    array[numbers] = end
                break
            last[:] = data.qpos
        data.qvel[dofs] = 0.0
        data.qvel[dofs] = -np.linalg.pinv(jacobian[:, dofs], 1e-9) @ (jacobian @ data.qvel)
        return data.qpos.copy(), data.qvel.copy()

    def among(self, parameters: Container[str]) -> Follower:
        """Return the rule for a model that has some of the parameters only."""
        own = zip(self.names[len(self.leaders) :], self.finders, strict=True)
        kept = {name: finder for name, finder in own if name in parameters}
        names = (*self.names[: len(self.leaders)], *kept)
        return replace(self, names=names, finders=tuple(kept.values()))

    def carry(self, value: ArrayLike, *around: ArrayLike) -> ArrayLike:
        """Return the value after others were set: the present one where only parameters were."""
        half, states = len(around) // 2, len(self.leaders)
        before, after = around[:half], around[half:]
        same = all(map(np.array_equal, before[:states], after[:states]))
        return value if same else self(*after)


def _settle(
    mj: mujoco.MjModel, data: mujoco.MjData, equalities: Sequence[int], dofs: Sequence[int]
) -> tuple[Floats, float]:
    """Move velocities until constraints hold; return derivatives, (k, nv), and what is left."""
    for _ in range(ROUNDS):
        owners, residuals = _rows(mj, data)
        own, unit = np.isin(owners, equalities), np.eye(mj.nv)
        jacobian, column = np.zeros((int(own.sum()), mj.nv)), np.empty(len(own))
        for dof in range(mj.nv) if own.any() else ():
            mujoco.mj_mulJacVec(mj, data, column, unit[dof])
            jacobian[:, dof] = column[own]
        apart = float(np.abs(residuals[own]).max(initial=0.0))
        if apart <= _EXACT:
            break
        move = np.zeros(mj.nv)
        move[dofs] = -np.linalg.pinv(jacobian[:, dofs], 1e-9) @ residuals[own]
        mujoco.mj_integratePos(mj, data.qpos, move, 1.0)
    return jacobian, apart


def with_followers(
    states: Sequence[StateRow],
    mj: mujoco.MjModel,
    source: Source,
    start: mujoco.MjData,
    parameters: Sequence[Parameter],
    *,
    loops: bool,
) -> tuple[StateRow, ...]:
    """Return the states of a model, those that follow others with the rule by which they do.

    Joints follow others by constraints between joints; if ``loops``, states do by connect, weld and
    tendon constraints, too, but for those to mocap bodies, which pull what they hold. Of the states
    that constraints bind, those without actuators follow first, and of these the last ones.
    """
    meant = [n for n in np.flatnonzero(start.eq_active).tolist() if _binds(mj, n, loops)]
    if not meant:
        return tuple(states)
    data, generator = mujoco.MjData(mj), np.random.default_rng(0)
    data.qpos[:], data.eq_active[:] = start.qpos, start.eq_active
    for size in (0.05, 0.0):  # near the start pose, where nothing is singular by chance
        jacobian, _ = _settle(mj, data, meant, range(mj.nv))
        free = np.eye(mj.nv) - np.linalg.pinv(jacobian, 1e-9) @ jacobian
        mujoco.mj_integratePos(mj, data.qpos, size * free @ generator.standard_normal(mj.nv), 1.0)
    mimics = [n for n in meant if mj.eq_type[n] == int(_EQ.mjEQ_JOINT)]
    first = {*mj.jnt_dofadr[mj.eq_obj1id[mimics]].tolist()}
    names, stages = element_names(mj)["equality"], 1 if len(mimics) == len(meant) else STAGES
    acting = [row for row in parameters if _acts(row, [names[n] for n in meant], loops)]
    finders = tuple(row.slot for row in acting if row.slot is not None)
    found = {row.name: row for row in states}
    places = {row.name: _dofs(mj, row) for row in states if row.array == "qpos"}
    speeds = {row.numbers: row for row in states if row.array == "qvel"}
    driven = _driven(mj)
    ranks = {n: (first.isdisjoint(dofs), driven[[*dofs]].any()) for n, dofs in places.items()}
    links = [*places.values(), *(np.flatnonzero(row).tolist() for row in np.abs(jacobian) > 1e-9)]
    for group in dict.fromkeys(merged(mj.nv, links)):
        own = [name for name, dofs in reversed(places.items()) if group.issuperset(dofs)]
        dofs, follow = list[int](), list[StateRow]()
        for name in sorted(own, key=ranks.__getitem__):
            more = [*dofs, *places[name]]
            if _rank(jacobian[:, more]) > _rank(jacobian[:, dofs]):
                dofs, follow = more, [*follow, found[name]]
        lead = [found[name] for name in reversed(own) if found[name] not in follow]
        moves = [speeds[places[row.name]] for row in lead]
        for row in follow if lead else ():
            for one, others in ((row, lead), (speeds[places[row.name]], [*lead, *moves])):
                causes = tuple(other.name for other in (*others, *acting))
                ways = tuple((other.array, other.numbers) for other in others)
                rule = Follower(
                    causes, source, tuple(start.qpos.tolist()), ways, finders, tuple(meant),
                    tuple(dofs), one.array, one.numbers, stages,
                )  # fmt: skip
                begun = rule(*(other.default for other in others), *(p.default for p in acting))
                least, most = float(np.min(begun)), float(np.max(begun))
                low, high = (float(np.min(one.low)), float(np.max(one.high)))
                if max(low - least, most - high) > BEYOND:
                    break  # it cannot begin there
                found[one.name] = replace(
                    one, follows=rule, low=min(low, least), high=max(high, most)
                )
    return tuple(found.values())


def _binds(mj: mujoco.MjModel, equality: int, loops: bool) -> bool:
    """Return whether states follow others by a constraint; see ``with_followers``."""
    kind, ends = _EQ(int(mj.eq_type[equality])), [mj.eq_obj1id[equality], mj.eq_obj2id[equality]]
    if kind in (_EQ.mjEQ_CONNECT, _EQ.mjEQ_WELD):
        if mj.eq_objtype[equality] == int(mujoco.mjtObj.mjOBJ_SITE):
            ends = [mj.site_bodyid[end] for end in ends]
        return loops and not any(mj.body_mocapid[end] >= 0 for end in ends)
    return (kind == _EQ.mjEQ_TENDON and loops) or (kind == _EQ.mjEQ_JOINT and ends[1] >= 0)


def _acts(row: Parameter, equalities: Sequence[str], loops: bool) -> bool:
    """Return whether a parameter decides where constraints hold."""
    element, attribute = row.key
    own = element.removeprefix("equality:") in equalities and attribute in SWITCHES
    return own or (loops and attribute in MOVING and not row.visual)


def _driven(mj: mujoco.MjModel) -> NDArray[np.bool_]:
    """Return on which velocities actuators act by joints, or by tendons of joints, shape (nv,)."""
    kinds, targets = mj.actuator_trntype, mj.actuator_trnid[:, 0]
    joints = targets[kinds == int(mujoco.mjtTrn.mjTRN_JOINT)].tolist()
    for tendon in targets[kinds == int(mujoco.mjtTrn.mjTRN_TENDON)].tolist():
        way = slice(mj.tendon_adr[tendon], mj.tendon_adr[tendon] + mj.tendon_num[tendon])
        turned = mj.wrap_type[way] == int(mujoco.mjtWrap.mjWRAP_JOINT)
        joints += mj.wrap_objid[way][turned].tolist()
    return np.isin(mj.dof_jntid, joints)


def _rank(matrix: Floats) -> int:
    return int(np.linalg.matrix_rank(matrix, 1e-6)) if matrix.size else 0


def _dofs(mj: mujoco.MjModel, row: StateRow) -> tuple[int, ...]:
    """Return the velocities of coordinates."""
    first = min(row.numbers)
    joint = int(np.searchsorted(mj.jnt_qposadr, first, side="right")) - 1
    begin = int(mj.jnt_dofadr[joint]) + first - int(mj.jnt_qposadr[joint])
    return tuple(range(begin, begin + min(len(row.numbers), 3)))

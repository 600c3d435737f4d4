"""MuJoCo models of others, as ``scm_world.check`` asks them: Gymnasium's, and of rollouts."""

from __future__ import annotations

import copy
from abc import abstractmethod
from collections.abc import Callable, Collection, Mapping, Sequence
from functools import cache
from typing import Any, Literal, final

import mujoco
import numpy as np
from gymnasium.vector import AutoresetMode

from scm_world._types import Floats, Mask
from scm_world.backends.checkable import Checkable, commands
from scm_world.errors import UnknownOption

RESOLUTION = 1e-9
"""Smaller relative differences of a derived constant are rounding."""

USUAL = ("body_mass", "dof_damping", "dof_armature", "geom_friction", "actuator_gear")
"""Fields that are scaled where no range is declared, if they are not zero."""

SPREAD = (0.8, 1.2)  # of these fields, by their compiled values
BY_CONTACT = ("geom_friction", "geom_sol", "geom_margin", "geom_gap", "opt.o_")
DRAWN = ("cam_", "light_", "vis", "stat")  # fields that move nothing
UNITS = {
    "body_mass": "kg",
    "body_inertia": "kg m^2",
    "dof_damping": "N m s/rad",
    "dof_armature": "kg m^2",
    "dof_frictionloss": "N m",
    "jnt_stiffness": "N m/rad",
    "opt.gravity": "m/s^2",
    "opt.timestep": "s",
}
ELEMENTS = ("body", "geom", "site", "actuator", "tendon")
KINDS = {kind: getattr(mujoco.mjtObj, f"mjOBJ_{kind.upper()}") for kind in ELEMENTS}
KINDS |= dict.fromkeys(("jnt", "dof"), mujoco.mjtObj.mjOBJ_JOINT)
TURNS, SPEEDS = ("",) * 4, ("rad/s",) * 3
FREE = {
    0: (("m",) * 3 + TURNS, ("m/s",) * 3 + SPEEDS),
    1: (TURNS, SPEEDS),
    2: (("m",), ("m/s",)),
    3: (("rad",), ("rad/s",)),
}
"""Units of positions and velocities of joints, by their kind: free, ball, slide, hinge."""


class MujocoModels(Checkable):
    """Several MuJoCo models, each with a state.

    A range has the name of a field, ``"body_mass"``, of an element, ``"body_mass[torso]"``, or of a
    column, ``"geom_friction[floor, 0]"`` and ``"geom_friction[:, 0]"``; ``"opt.gravity"``, too.
    """

    by: Literal["set", "reset"] = "reset"
    given = True  # whether somebody declared ranges
    compiled: mujoco.MjModel  # the model, as its file has it

    @property
    @abstractmethod
    def models(self) -> Sequence[mujoco.MjModel]:
        """The model that each world is simulated with now."""

    @abstractmethod
    def state(self, world: int) -> tuple[Floats, Floats]:
        """Return positions and velocities of a world."""

    @abstractmethod
    def contacts(self, world: int) -> int:
        """Return the number of contacts in a world now."""

    def get(self, name: str) -> Floats:
        """Read a field in all models."""
        return np.array([_read(model, name) for model in self.models])

    def set(self, name: str, values: Floats, mask: Mask) -> None:
        """Write a field of the models of some worlds."""
        for world in np.flatnonzero(mask).tolist():
            _write(self.models[world], name, values[world])
            if self.follows:
                _derive(self.models[world])

    def reference(self, name: str) -> Floats:
        """Return the values of the file, for all worlds."""
        return np.repeat(np.array(_read(self.compiled, name))[None], self.num_envs, axis=0)

    def declared(self, ranges: Mapping[str, Any] | None) -> Mapping[str, Any]:
        """Return declared ranges, or those around the usual values of the file."""
        self.given = ranges is not None
        if ranges is not None:
            return ranges
        found = {name: np.array(_read(self.compiled, name)) for name in USUAL}
        found["opt.gravity"] = self.compiled.opt.gravity.copy()
        ends = {name: [end * value for end in SPREAD] for name, value in found.items()}
        return {
            name: (np.minimum(a, b), np.maximum(a, b)) for name, (a, b) in ends.items() if a.any()
        }

    def idle(self, name: str, *, ran: bool) -> str:
        """Return why no response was seen of what acts in contacts alone, or nothing."""
        if not ran:
            return ""
        touching = any(self.contacts(world) for world in range(self.num_envs))
        by_contact = name.startswith(BY_CONTACT) and not touching
        if by_contact:
            return "it acts in contacts, and nothing touches"
        return "" if self.given else "no number of the state differs, and nobody declared it"

    def unit(self, name: str) -> str:
        """Return the unit of a field."""
        return UNITS.get(name.partition("[")[0], "")

    def columns(self) -> list[tuple[str, str]]:
        """Return names and units of the numbers of ``observe``."""
        model, found = self.compiled, ([], [])  # type: ignore[var-annotated] # texts
        for joint in range(model.njnt):
            name = model.joint(joint).name or f"joint {joint}"
            each = zip(("position", "velocity"), FREE[int(model.jnt_type[joint])], strict=True)
            for part, (what, units) in zip(found, each, strict=True):
                several = [f"[{i}]" for i in range(len(units))] if len(units) > 1 else [""]
                part += [(f"{what} of {name}{at}", u) for at, u in zip(several, units, strict=True)]
        return [*found[0], *found[1]]

    def observe(self) -> Floats:
        """Return positions and velocities, shape (n, nq + nv)."""
        return np.array([np.concatenate(self.state(world)) for world in range(self.num_envs)])

    # --- derived constants ------------------------------------------------------------------------

    def stale(self, name: str) -> dict[str, float]:
        """Return derived constants that are not those of a fresh compilation of these values.

        Returns:
            The largest relative difference of each field that ``mj_setConst`` computes.
        """
        found: dict[str, float] = {}
        for model in {id(model): model for model in self.models}.values():
            other = copy.copy(model)
            _write(other, name, _read(self.compiled, name))
            _derive(other)
            for field, far in stale(model, other).items():
                found[field] = max(found.get(field, 0.0), far)
        return found

    def refresh(self) -> Callable[[], None]:
        """Compute derived constants anew in all models; return what writes the old ones back."""
        back = self.keep(())
        for model in self.models:
            _derive(model)
        return back

    def keep(self, names: Collection[str]) -> Callable[[], None]:
        """Return what writes all numbers of the present models again, whatever a reset draws."""
        del names
        kept = [{name: _read(model, name) for name in _fields()} for model in self.models]

        def back() -> None:
            for model, values in zip(self.models, kept, strict=True):
                for name, value in values.items():
                    _write(model, name, value)

        return back

    def remark(self, name: str) -> str:
        """Return what a user may not expect of a range."""
        if not name.startswith("body_mass"):
            return ""
        for model in self.models:
            heavy = (self.compiled.body_mass > 0.0) & (model.body_mass > 0.0)
            ratio = model.body_mass[heavy] / self.compiled.body_mass[heavy]
            inertia = self.compiled.body_inertia[heavy] * ratio[:, None]
            if not np.allclose(inertia, model.body_inertia[heavy], rtol=1e-6, atol=0.0):
                return "body_inertia does not follow body_mass, as it would in a file"
        return ""


@final
class GymnasiumModels(MujocoModels):
    """Gymnasium's vector environment of MuJoCo environments in this process.

    Args:
        envs: It has ``envs``, of each of which ``unwrapped`` has ``model`` and ``data``.
        given: Whether ranges are declared, which the environments draw from at their resets. If
            not, they are set from outside.
    """

    def __init__(self, envs: Any, *, given: bool) -> None:
        self.envs, self.num_envs = envs, envs.num_envs
        self.by = "reset" if given else "set"
        self.members = [env.unwrapped for env in envs.unwrapped.envs]
        self.actions = envs.single_action_space
        self.n_actions = int(np.prod(self.actions.shape))
        spec = getattr(envs.unwrapped.envs[0], "spec", None)
        self.title = type(envs).__name__ if spec is None else spec.id
        path = getattr(self.members[0], "fullpath", None)
        self.compiled = copy.copy(self.members[0].model)
        if path is not None:
            self.compiled = mujoco.MjModel.from_xml_path(path)

    @property
    def models(self) -> Sequence[mujoco.MjModel]:
        """The model that each environment is simulated with now."""
        return [member.model for member in self.members]

    def state(self, world: int) -> tuple[Floats, Floats]:
        """Return positions and velocities of an environment."""
        data = self.members[world].data
        return data.qpos, data.qvel

    def contacts(self, world: int) -> int:
        """Return the number of contacts in an environment now."""
        return int(self.members[world].data.ncon)

    def reset(self, seed: int, mask: Mask) -> None:
        """Begin episodes in some environments."""
        seeds = [seed + world if mask[world] else None for world in range(self.num_envs)]
        self.envs.reset(seed=seeds, options=None if mask.all() else {"reset_mask": mask.copy()})

    def step(self, actions: Floats) -> Mask:
        """Advance all environments; return which of them ended an episode."""
        shape = (self.num_envs, *self.actions.shape)
        ends = (np.ravel(self.actions.low), np.ravel(self.actions.high))
        sent = commands(actions, *ends).reshape(shape).astype(self.actions.dtype)
        _, _, terminated, truncated, _ = self.envs.step(sent)
        ended: Mask = terminated | truncated
        if ended.any() and self.envs.metadata["autoreset_mode"] is AutoresetMode.DISABLED:
            self.reset(0, ended)
        return ended

    def outdated(self) -> Floats:
        """Return by how much observations differ from those that are computed anew, shape (n,)."""
        far = np.zeros(self.num_envs)
        for world, member in enumerate(self.members):
            if hasattr(member, "_get_obs"):
                shown, kept = np.array(member._get_obs()), copy.copy(member.data)
                mujoco.mj_forward(member.model, member.data)
                far[world] = np.abs(np.array(member._get_obs()) - shown).max(initial=0.0)
                mujoco.mj_copyData(member.data, member.model, kept)
        return far


@final
class RolloutModels(MujocoModels):
    """Models that ``mujoco.rollout`` simulates.

    Args:
        models: One for each world, of one structure.
        start: The initial state of all of them, an ``MjData``, or of each, shape (n, n_state), as
            ``mujoco.rollout`` takes them; that of the file if None.
    """

    draws = False

    def __init__(
        self, models: Sequence[mujoco.MjModel], start: mujoco.MjData | Floats | None = None
    ) -> None:
        self._models, self.num_envs, self.compiled = [*models], len(models), copy.copy(models[0])
        self.title = "mujoco.rollout"
        self.n_actions = self.compiled.nu
        self.full = mujoco.mjtState.mjSTATE_FULLPHYSICS
        self.data, size = mujoco.MjData(models[0]), mujoco.mj_stateSize(models[0], self.full)
        if start is None or isinstance(start, mujoco.MjData):
            one = np.empty(size)
            mujoco.mj_getState(models[0], start or self.data, one, self.full)
            start = np.repeat(one[None], self.num_envs, axis=0)
        self.start = np.array(start, dtype=np.float64)
        if self.start.shape != (self.num_envs, size):
            wanted = f"an MjData, or numbers of shape ({self.num_envs}, {size})"
            raise UnknownOption("initial state", self.start.shape, (wanted,))
        self.states = self.start.copy()

    @property
    def models(self) -> Sequence[mujoco.MjModel]:
        """The models."""
        return self._models

    def state(self, world: int) -> tuple[Floats, Floats]:
        """Return positions and velocities of a world."""
        nq, nv = self.compiled.nq, self.compiled.nv
        numbers = self.states[world, 1:]  # the first one is the time
        return numbers[:nq], numbers[nq : nq + nv]

    def contacts(self, world: int) -> int:
        """Return the number of contacts in a world now."""
        model = self._models[world]
        mujoco.mj_setState(model, self.data, self.states[world], self.full)
        mujoco.mj_forward(model, self.data)
        return int(self.data.ncon)

    def reset(self, seed: int, mask: Mask) -> None:
        """Return some worlds to their initial state."""
        del seed
        self.states[mask] = self.start[mask]

    def step(self, actions: Floats) -> None:
        """Advance all worlds one physics step."""
        from mujoco import rollout

        model = self.compiled
        limited = model.actuator_ctrllimited.astype(bool)
        ends = [np.where(limited, model.actuator_ctrlrange[:, i], (-1.0, 1.0)[i]) for i in (0, 1)]
        control = commands(actions, *ends)[:, None, :]
        found, _ = rollout.rollout(self._models, self.data, self.states, control)
        self.states = found[:, -1].copy()


# --- fields ---------------------------------------------------------------------------------------


@cache
def _fields() -> tuple[str, ...]:
    """Name the numbers of a model that can move something: its fields, and its options."""
    model = mujoco.MjSpec().compile()
    names = [name for name in dir(model) if not name.startswith(("_", *DRAWN))]
    options = [f"opt.{name}" for name in dir(model.opt) if not name.startswith("_")]
    values = {name: getattr(*_holder(model, name), None) for name in (*names, *options)}
    return tuple(n for n, value in values.items() if np.asarray(value).dtype == np.float64)


def _holder(model: mujoco.MjModel, name: str) -> tuple[Any, str]:
    return (model.opt, name[4:]) if name.startswith("opt.") else (model, name)


def stale(model: mujoco.MjModel, other: mujoco.MjModel | None = None) -> dict[str, float]:
    """Return fields that ``mj_setConst`` would change, each with its largest relative difference.

    With ``other``, a model with another value and its constants, those that follow from the value.
    """
    fresh, found = copy.copy(model), dict[str, float]()
    _derive(fresh)
    for field in _fields():
        new, old = _read(fresh, field), _read(model, field)
        far = np.abs(new - old).max(initial=0.0) / (np.abs(new).max(initial=0.0) or 1.0)
        if far > RESOLUTION and (other is None or not np.array_equal(new, _read(other, field))):
            found[field] = float(far)
    return found


def _derive(model: mujoco.MjModel) -> None:
    mujoco.mj_setConst(model, mujoco.MjData(model))


def _place(model: mujoco.MjModel, name: str) -> tuple[Any, str, Any]:
    """Return the object with a field, its name there, and the index of the named elements."""
    field, _, rest = name.partition("[")
    if field not in _fields():
        allowed = ("a field of MjModel, such as 'body_mass[torso]'", "an option, 'opt.gravity'")
        raise UnknownOption("range", name, allowed)
    holder, attribute = _holder(model, field)
    value = getattr(holder, attribute)
    if not rest:
        return holder, attribute, ...
    parts = [part.strip() for part in rest.removesuffix("]").split(",")]
    index: list[int | slice] = []
    kind = field.partition("_")[0]
    for place, part in enumerate(parts):
        if part == ":":
            index.append(slice(None))
        elif part.isdigit():
            index.append(int(part))
        elif place == 0 and kind in KINDS:
            found = mujoco.mj_name2id(model, KINDS[kind], part)
            if found < 0:
                known = [mujoco.mj_id2name(model, KINDS[kind], i) for i in range(np.size(value, 0))]
                raise UnknownOption(f"element of {field}", part, [n for n in known if n])
            first = int(model.jnt_dofadr[found]) if kind == "dof" else found
            size = len(FREE[int(model.jnt_type[found])][1]) if kind == "dof" else 1
            index.append(slice(first, first + size) if size > 1 else first)
        else:
            raise UnknownOption("element", part, ("a name, a number, or ':'",))
    if any(isinstance(one, int) and one >= np.shape(value)[i] for i, one in enumerate(index)):
        raise UnknownOption("range", name, (f"within the shape {np.shape(value)} of {field}",))
    return holder, attribute, tuple(index)


def _read(model: mujoco.MjModel, name: str) -> Floats:
    holder, attribute, index = _place(model, name)
    return np.array(np.asarray(getattr(holder, attribute))[index], dtype=np.float64)


def _write(model: mujoco.MjModel, name: str, value: Floats) -> None:
    holder, attribute, index = _place(model, name)
    if isinstance(getattr(holder, attribute), np.ndarray):
        getattr(holder, attribute)[index] = value
    else:
        setattr(holder, attribute, float(value))

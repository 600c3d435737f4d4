"""Which kinematic trees a compiled model has, and which elements act on which of them.

A tree is everything below one child of the world (MuJoCo's ``body_rootid``) that can move. Trees
are coupled always by tendons, equality constraints and actuators that reach several of them, and
while there is contact by shapes that may touch. What cannot move passes nothing on.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator
from functools import cached_property
from typing import NamedTuple, final

import mujoco
import numpy as np
from numpy.typing import NDArray

Trees = frozenset[int]
NONE: Trees = frozenset()
Effect = tuple[Trees, Trees]
"""The trees that something acts on in every step, and those that it reaches by contact."""

NOTHING: Effect = (NONE, NONE)

_OBJ, _TRN, _WRAP, _EQ, _OFF = (
    mujoco.mjtObj,
    mujoco.mjtTrn,
    mujoco.mjtWrap,
    mujoco.mjtEq,
    mujoco.mjtDisableBit,
)

_FOLLOWS = frozenset(
    int(getattr(mujoco.mjtDyn, f"mjDYN_{kind}"))
    for kind in ("INTEGRATOR", "FILTER", "FILTEREXACT", "MUSCLE")
)
"""Dynamics of an inner state in which no motion counts."""


def disabled(mj: mujoco.MjModel, *flags: mujoco.mjtDisableBit) -> bool:
    """Return whether a part of physics is switched off by one of some flags of the model."""
    return any(mj.opt.disableflags & int(flag) for flag in flags)


def works(mj: mujoco.MjModel, actuator: int) -> bool:
    """Return whether an actuator is not switched off."""
    group = int(mj.actuator_group[actuator])
    off = 0 <= group < 31 and bool(mj.opt.disableactuator & (1 << group))
    return not (off or disabled(mj, _OFF.mjDSBL_ACTUATION))


class TreeLink(NamedTuple):
    """Something that joins trees for good: a tendon, a constraint, an actuator or a flex.

    Attributes:
        trees: The trees that it reaches.
        sites: The sites whose places count: where it ends, or on which side it passes.
        geoms: The shapes that it runs around.
        bodies: The bodies whose places count.
    """

    trees: Trees = NONE
    sites: frozenset[int] = frozenset()
    geoms: frozenset[int] = frozenset()
    bodies: frozenset[int] = frozenset()


@final
class Couplings:
    """The trees of a compiled model, and what reaches them.

    A method with the name of a kind of elements returns the effect of an element of it. The model
    is only read.

    Attributes:
        fluid: Whether a medium acts, or may be made to act; it acts in any case if it is dense.
        roots: Number of the body at the root of each tree.
        every: All trees.
        links: What joins trees, by kind and number.
        inners: Actuators with an inner state that follows the control alone: integrators, filters
            and muscles. Source: MuJoCo, *Computation, Activation dynamics*.
    """

    def __init__(self, mj: mujoco.MjModel, fluid: bool = False) -> None:
        self._mj = mj
        self.fluid = fluid or mj.opt.density > 0.0 or mj.opt.viscosity > 0.0
        self._touch = not disabled(mj, _OFF.mjDSBL_CONTACT, _OFF.mjDSBL_CONSTRAINT)
        self._moves = np.asarray(mj.body_treeid) >= 0
        self.roots = sorted({int(root) for root in mj.body_rootid[self._moves]})
        self.every = frozenset(range(len(self.roots)))
        number = {root: i for i, root in enumerate(self.roots)}
        self._tree = [number.get(root, -1) for root in mj.body_rootid.tolist()]
        self.links: dict[str, list[TreeLink]] = {}
        for kind, count in (
            ("tendon", mj.ntendon), ("flex", mj.nflex), ("equality", mj.neq),
            ("actuator", mj.nactuator),
        ):  # fmt: skip
            self.links[kind] = [getattr(self, f"_{kind}")(i) for i in range(count)]
        kinds = enumerate(mj.actuator_dyntype.tolist())
        self.inners = [actuator for actuator, kind in kinds if kind in _FOLLOWS]
        self._coupled = merged(len(self.roots), (link.trees for link in self._all_links()))
        self._effects: dict[Effect, Effect] = {}  # elements that act alike share one

    def tree(self, body: int) -> int:
        """Return the number of the tree of a body; -1 where nothing in it can move."""
        return self._tree[body]

    # --- what elements act on ------------------------------------------------------------------

    def always(self, trees: Iterable[int], shapes: Iterable[int] = ()) -> Effect:
        """Return the effect of what acts on trees in every step, and on how shapes touch."""
        found = NONE.union(*(self._coupled[tree] for tree in trees))
        return self._effect(found, found.union(*map(self._touched, shapes)))

    def touching(self, trees: Iterable[int]) -> Effect:
        """Return the effect of something that acts on some trees by contact alone."""
        return self._effect(NONE, frozenset(trees))

    def _effect(self, sure: Trees, felt: Trees) -> Effect:
        """Return the effect of what acts on trees in every step, and on those felt by contact."""
        found = self._effects.get((sure, felt))
        if found is None:
            contact = NONE.union(*(self._islands[tree] for tree in felt)) - sure
            found = self._effects[sure, felt] = sure, contact
        return found

    def body(self, body: int) -> Effect:
        """Return the effect of the inertia of a body; a static one moves the center of its tree."""
        tree = self.tree(body)
        return NOTHING if tree < 0 else self.always([tree])

    def joint(self, joint: int) -> Effect:
        """Return the effect of a joint: that of the inertia of its body."""
        return self.body(int(self._mj.jnt_bodyid[joint]))

    def frame(self, body: int) -> Effect:
        """Return the effect of the place of a body in its parent, with all that hangs from it."""
        if self._moves[body]:
            return self.body(body)
        parents, found = self._mj.body_parentid.tolist(), {body}
        for other in range(body + 1, len(parents)):
            if parents[other] in found:
                found.add(other)
        trees = {self.tree(b) for b in found if self.tree(b) >= 0}
        held = (link.trees for link in self._all_links() if not found.isdisjoint(link.bodies))
        return self.always(trees.union(*held), self._shapes(*found))

    def contact_of(self, geom: int) -> Effect:
        """Return the effect of how a shape behaves in contact."""
        return self.always((), [geom])

    def geom(self, geom: int) -> Effect:
        """Return the effect of the size or place of a shape: contact, tendons, a medium."""
        body = int(self._mj.geom_bodyid[geom])
        trees = self._joined["geoms", geom]
        if self.fluid and self._moves[body] and self._mj.geom_fluid[geom, 0] > 0.0:
            trees |= {self.tree(body)}
        return self.always(trees, [geom])

    def site(self, site: int) -> Effect:
        """Return the effect of the place of a site: on the elements attached to it."""
        return self.always(self._joined["sites", site])

    def pair(self, pair: int) -> Effect:
        """Return the effect of how a declared pair of shapes behaves in contact."""
        geoms = [self._mj.pair_geom1[pair], self._mj.pair_geom2[pair]]
        return self.touching(self._moving(self._mj.geom_bodyid[geoms])) if self._touch else NOTHING

    def tendon(self, tendon: int) -> Effect:
        """Return the effect of a tendon: on the bodies it reaches."""
        return self.always(self.links["tendon"][tendon].trees)

    def equality(self, equality: int) -> Effect:
        """Return the effect of an equality constraint: on the bodies it joins."""
        off = disabled(self._mj, _OFF.mjDSBL_EQUALITY)
        return NOTHING if off else self.always(self.links["equality"][equality].trees)

    def actuator(self, actuator: int) -> Effect:
        """Return the effect of an actuator: on what its transmission reaches."""
        if not works(self._mj, actuator):
            return NOTHING
        if self._mj.actuator_trntype[actuator] == int(_TRN.mjTRN_BODY):
            return self.always((), self._shapes(int(self._mj.actuator_trnid[actuator, 0])))
        return self.always(self.links["actuator"][actuator].trees)

    def inner(self, actuator: int) -> Trees:
        """Return the number, after those of trees, of an inner state on which no motion acts."""
        return frozenset(
            [len(self.roots) + self.inners.index(actuator)] if actuator in self.inners else ()
        )

    def option(self, _: int) -> Effect:
        """Return the effect of an option of the whole model."""
        return self.always(self.every)

    def highest_condim(self, geom: int) -> int:
        """Return the largest number of dimensions of the contacts of a shape; 0 if it has none."""
        others = np.flatnonzero(self.dynamic[geom])
        if not len(others):
            return 0
        mj = self._mj
        mine, their = mj.geom_priority[geom], mj.geom_priority[others]
        larger = np.maximum(mj.geom_condim[geom], mj.geom_condim[others])
        decided = np.where(mine > their, mj.geom_condim[geom], mj.geom_condim[others])
        return int(np.where(mine == their, larger, decided).max())

    # --- contact -------------------------------------------------------------------------------

    @cached_property
    def _masked(self) -> NDArray[np.bool_]:
        """Which geoms, and flexes after them, may touch by their masks, as MuJoCo filters them."""
        mj, n, moves = self._mj, self._mj.ngeom, self._moves
        weld = np.asarray(mj.body_weldid)
        parent = weld[mj.body_parentid[weld]]
        bodies = (moves[:, None] | moves) & (weld[:, None] != weld)
        if not disabled(mj, _OFF.mjDSBL_FILTERPARENT):
            family = (weld[:, None] == parent) | (parent[:, None] == weld)
            bodies &= ~(family & (weld != 0)[:, None] & (weld != 0))
        first, second = mj.exclude_signature >> 16, mj.exclude_signature & 0xFFFF
        bodies[first, second] = bodies[second, first] = False
        kind = np.concatenate([mj.geom_contype, mj.flex_contype])
        affinity = np.concatenate([mj.geom_conaffinity, mj.flex_conaffinity])
        one = (kind[:, None] & affinity) != 0
        found: NDArray[np.bool_] = (one | one.T) & self._touch
        found[:n, :n] &= bodies[np.ix_(mj.geom_bodyid, mj.geom_bodyid)]
        return found

    @cached_property
    def dynamic(self) -> NDArray[np.bool_]:
        """Which shapes may touch with numbers of their own, without a pair, (ngeom, ngeom)."""
        mj = self._mj
        found = self._masked[: mj.ngeom, : mj.ngeom].copy()
        found[mj.pair_geom1, mj.pair_geom2] = found[mj.pair_geom2, mj.pair_geom1] = False
        return found

    @cached_property
    def touches(self) -> NDArray[np.bool_]:
        """Which shapes may touch, by their masks or because a pair says so, (ngeom, ngeom)."""
        mj, found = self._mj, self.dynamic.copy()
        found[mj.pair_geom1, mj.pair_geom2] = found[mj.pair_geom2, mj.pair_geom1] = self._touch
        return found

    @cached_property
    def _meets(self) -> tuple[NDArray[np.bool_], list[Trees]]:
        """Which geoms, and flexes after them, may touch, and the trees of each of them."""
        found, n = self._masked.copy(), self._mj.ngeom
        found[:n, :n] = self.touches
        geoms = [self._moving([body]) for body in self._mj.geom_bodyid.tolist()]
        return found, [*geoms, *(flex.trees for flex in self.links["flex"])]

    def _touched(self, geom: int) -> Trees:
        """Return the trees that feel a shape: its own, or those that touch it if it is static."""
        meets, trees = self._meets
        others = np.flatnonzero(meets[geom]).tolist()
        return NONE if not others else trees[geom] or NONE.union(*(trees[i] for i in others))

    @cached_property
    def _islands(self) -> list[Trees]:
        """For each tree, all those that a chain of contacts and couplings may link to it."""
        meets, trees = self._meets
        numbers = {own: n for n, own in enumerate(dict.fromkeys(trees))}
        kinds, contacts = np.array([numbers[own] for own in trees], dtype=np.int64), list[Trees]()
        for own, n in numbers.items():  # shapes of the same trees at once
            met = {*kinds[meets[kinds == n].any(axis=0)].tolist()} if own else ()
            contacts += (own | other for other, m in numbers.items() if m in met and other)
        return merged(len(self.roots), [*(link.trees for link in self._all_links()), *contacts])

    # --- couplings -----------------------------------------------------------------------------

    @cached_property
    def _joined(self) -> dict[tuple[str, int], Trees]:
        """The trees that are joined at a site or a geom."""
        found: defaultdict[tuple[str, int], Trees] = defaultdict(frozenset)
        for link in self._all_links():
            for kind in ("sites", "geoms"):
                for number in getattr(link, kind):
                    found[kind, number] |= link.trees
        return found

    def _all_links(self) -> Iterator[TreeLink]:
        return (link for links in self.links.values() for link in links)

    def _shapes(self, *bodies: int) -> list[int]:
        found: list[int] = np.flatnonzero(np.isin(self._mj.geom_bodyid, bodies)).tolist()
        return found

    def _moving(self, bodies: Iterable[int]) -> Trees:
        """Return the trees of the bodies that can move."""
        return frozenset(self.tree(body) for body in bodies if self._moves[body])

    def _link(
        self,
        joints: Iterable[int] = (),
        sites: Iterable[int] = (),
        geoms: Iterable[int] = (),
        bodies: Iterable[int] = (),
        beside: Iterable[int] = (),
    ) -> TreeLink:
        """Return what joins some elements; the places of sites beside it count, too."""
        mj = self._mj
        near, ends = frozenset(map(int, geoms)), {*map(int, sites)}
        places = ends.union(map(int, beside))
        held = {*bodies, *(int(mj.site_bodyid[s]) for s in ends)}
        held |= {int(mj.geom_bodyid[geom]) for geom in near}
        trees = self._moving(held.union(int(mj.jnt_bodyid[joint]) for joint in joints))
        held |= {int(mj.site_bodyid[site]) for site in places}
        return TreeLink(trees, frozenset(places), near, frozenset(held))

    def _tendon(self, tendon: int) -> TreeLink:
        mj, first = self._mj, int(self._mj.tendon_adr[tendon])
        way = slice(first, first + int(mj.tendon_num[tendon]))
        kinds, numbers = mj.wrap_type[way], mj.wrap_objid[way]
        bends = np.isin(kinds, [int(_WRAP.mjWRAP_SPHERE), int(_WRAP.mjWRAP_CYLINDER)])
        sides = mj.wrap_prm[way][bends]
        return self._link(
            joints=numbers[kinds == int(_WRAP.mjWRAP_JOINT)],
            sites=numbers[kinds == int(_WRAP.mjWRAP_SITE)],
            geoms=numbers[bends],
            beside=sides[sides >= 0],
        )

    def _equality(self, equality: int) -> TreeLink:
        mj = self._mj
        ends = [int(e) for e in (mj.eq_obj1id[equality], mj.eq_obj2id[equality]) if e >= 0]
        match mujoco.mjtEq(int(mj.eq_type[equality])):
            case _EQ.mjEQ_CONNECT | _EQ.mjEQ_WELD:
                at_sites = mj.eq_objtype[equality] == int(_OBJ.mjOBJ_SITE)
                return self._link(sites=ends) if at_sites else self._link(bodies=ends)
            case _EQ.mjEQ_JOINT:
                return self._link(joints=ends)
            case _EQ.mjEQ_TENDON:
                return TreeLink(NONE.union(*(self.links["tendon"][end].trees for end in ends)))
            case _:
                return self.links["flex"][ends[0]]

    def _actuator(self, actuator: int) -> TreeLink:
        ends = [int(end) for end in self._mj.actuator_trnid[actuator] if end >= 0]
        match mujoco.mjtTrn(int(self._mj.actuator_trntype[actuator])):
            case _TRN.mjTRN_JOINT | _TRN.mjTRN_JOINTINPARENT:
                return self._link(joints=ends[:1])
            case _TRN.mjTRN_SO3 if len(ends) == 1:
                return self._link(joints=ends)
            case _TRN.mjTRN_TENDON:
                return TreeLink(self.links["tendon"][ends[0]].trees)
            case _TRN.mjTRN_SITE | _TRN.mjTRN_SLIDERCRANK | _TRN.mjTRN_SO3:
                return self._link(sites=ends)
            case _:
                return TreeLink()  # adhesion acts by contact

    def _flex(self, flex: int) -> TreeLink:
        mj = self._mj
        vertex, node = int(mj.flex_vertadr[flex]), int(mj.flex_nodeadr[flex])
        vertices = mj.flex_vertbodyid[vertex : vertex + int(mj.flex_vertnum[flex])]
        nodes = mj.flex_nodebodyid[node : node + int(mj.flex_nodenum[flex])]
        return TreeLink(self._moving(int(b) for b in (*vertices, *nodes) if b >= 0))


def merged(n: int, links: Iterable[Iterable[int]]) -> list[Trees]:
    """Merge linked trees, directly or through others; return the group of each."""
    group = [frozenset([i]) for i in range(n)]
    for link in links:
        apart = {group[i] for i in link}
        if len(apart) > 1:
            joined = NONE.union(*apart)
            for member in joined:
                group[member] = joined
    return group

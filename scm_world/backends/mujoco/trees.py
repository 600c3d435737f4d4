"""Which kinematic trees a compiled model has, and which elements act on which of them.

A tree is everything below one child of the world (MuJoCo's ``body_rootid``) that can move. Trees
are coupled always by tendons, equality constraints and actuators that reach several of them, and
while there is contact by shapes that may touch. What cannot move passes nothing on.
"""

from __future__ import annotations

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
_WAYS = {
    "joints": (int(_WRAP.mjWRAP_JOINT),),
    "sites": (int(_WRAP.mjWRAP_SITE),),
    "geoms": (int(_WRAP.mjWRAP_SPHERE), int(_WRAP.mjWRAP_CYLINDER)),
}
"""What tendons run through and around."""


def disabled(mj: mujoco.MjModel, flag: mujoco.mjtDisableBit) -> bool:
    """Return whether a part of physics is switched off by a flag of the model."""
    return bool(mj.opt.disableflags & int(flag))


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

    A method with the name of a kind of elements returns the effect of an element of it.

    Args:
        mj: The model. It is only read.
        fluid: Whether a medium acts, or may be made to act; it acts in any case if it is dense.

    Attributes:
        fluid: The same.
        roots: Number of the body at the root of each tree.
        links: What joins trees, by kind and number.
    """

    def __init__(self, mj: mujoco.MjModel, fluid: bool = False) -> None:
        self._mj = mj
        self.fluid = fluid or mj.opt.density > 0.0 or mj.opt.viscosity > 0.0
        self._moves = np.asarray(mj.body_treeid) >= 0
        self.roots = sorted({int(root) for root in mj.body_rootid[self._moves]})
        number = {root: i for i, root in enumerate(self.roots)}
        self._tree = np.array([number.get(int(root), -1) for root in mj.body_rootid])
        self.links: dict[str, list[TreeLink]] = {}
        for kind, count in (
            ("tendon", mj.ntendon), ("flex", mj.nflex), ("equality", mj.neq),
            ("actuator", mj.nactuator),
        ):  # fmt: skip
            self.links[kind] = [getattr(self, f"_{kind}")(i) for i in range(count)]
        self._coupled = _groups(len(self.roots), (link.trees for link in self._all_links()))
        self._known: dict[Trees, Effect] = {}

    @property
    def every(self) -> Trees:
        """All trees."""
        return frozenset(range(len(self.roots)))

    def tree(self, body: int) -> int:
        """Return the number of the tree of a body; -1 where nothing in it can move."""
        return int(self._tree[body])

    # --- what elements act on ------------------------------------------------------------------

    def always(self, trees: Iterable[int]) -> Effect:
        """Return the effect of something that acts on some trees in every step."""
        key = frozenset(trees)
        if key not in self._known:
            found = frozenset().union(*{self._coupled[tree] for tree in key})
            self._known[key] = found, self._reached(found) - found
        return self._known[key]

    def touching(self, trees: Iterable[int]) -> Effect:
        """Return the effect of something that acts on some trees by contact alone."""
        return NONE, self._reached(trees)

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
        parents, found = self._mj.body_parentid, {body}
        for other in range(body + 1, self._mj.nbody):
            if int(parents[other]) in found:
                found.add(other)
        trees = {self.tree(b) for b in found if self.tree(b) >= 0}
        held = (link.trees for link in self._all_links() if not found.isdisjoint(link.bodies))
        always, contact = self.always(trees.union(*held))
        shapes = [g for g in range(self._mj.ngeom) if int(self._mj.geom_bodyid[g]) in found]
        touched = self._reached({tree for g in shapes for tree in self._touched(g)})
        return always, (contact | touched) - always

    def contact_of(self, geom: int) -> Effect:
        """Return the effect of how a shape behaves in contact."""
        return self.touching(self._touched(geom))

    def geom(self, geom: int) -> Effect:
        """Return the effect of the size or place of a shape: contact, tendons, a medium."""
        body = int(self._mj.geom_bodyid[geom])
        trees = NONE.union(*(link.trees for link in self._all_links() if geom in link.geoms))
        if self.fluid and self._moves[body] and self._mj.geom_fluid[geom, 0] > 0.0:
            trees |= {self.tree(body)}
        always, contact = self.always(trees)
        return always, (contact | self._reached(self._touched(geom))) - always

    def site(self, site: int) -> Effect:
        """Return the effect of the place of a site: on what is attached to it."""
        return self.always(
            NONE.union(*(link.trees for link in self._all_links() if site in link.sites))
        )

    def pair(self, pair: int) -> Effect:
        """Return the effect of how a declared pair of shapes behaves in contact."""
        if not self._contacts_on:
            return NOTHING
        geoms = int(self._mj.pair_geom1[pair]), int(self._mj.pair_geom2[pair])
        return self.touching(self._moving([int(self._mj.geom_bodyid[g]) for g in geoms]))

    def tendon(self, tendon: int) -> Effect:
        """Return the effect of a tendon: on what it reaches."""
        return self.always(self.links["tendon"][tendon].trees)

    def equality(self, equality: int) -> Effect:
        """Return the effect of an equality constraint: on what it joins."""
        if disabled(self._mj, _OFF.mjDSBL_EQUALITY):
            return NOTHING
        return self.always(self.links["equality"][equality].trees)

    def actuator(self, actuator: int) -> Effect:
        """Return the effect of an actuator: on what its transmission reaches."""
        mj = self._mj
        if not works(mj, actuator):
            return NOTHING
        if mj.actuator_trntype[actuator] == int(_TRN.mjTRN_BODY):
            body = int(mj.actuator_trnid[actuator, 0])
            shapes = [g for g in range(mj.ngeom) if int(mj.geom_bodyid[g]) == body]
            return self.touching({tree for g in shapes for tree in self._touched(g)})
        return self.always(self.links["actuator"][actuator].trees)

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
    def _contacts_on(self) -> bool:
        off = (_OFF.mjDSBL_CONTACT, _OFF.mjDSBL_CONSTRAINT)
        return not any(disabled(self._mj, flag) for flag in off)

    @cached_property
    def _masked(self) -> NDArray[np.bool_]:
        """Which geoms, and flexes after them, may touch by their masks, as MuJoCo filters them."""
        mj, n = self._mj, self._mj.ngeom
        kind = np.concatenate([mj.geom_contype, mj.flex_contype])
        affinity = np.concatenate([mj.geom_conaffinity, mj.flex_conaffinity])
        one = (kind[:, None] & affinity[None, :]) != 0
        found: NDArray[np.bool_] = (one | one.T) & self._contacts_on
        found[:n, :n] &= self._may_meet[np.ix_(mj.geom_bodyid, mj.geom_bodyid)]
        return found

    def _with_pairs(self, found: NDArray[np.bool_], which: bool) -> NDArray[np.bool_]:
        """Mark the shapes that have a declared pair."""
        for first, second in zip(self._mj.pair_geom1, self._mj.pair_geom2, strict=True):
            found[first, second] = found[second, first] = which
        return found

    @cached_property
    def dynamic(self) -> NDArray[np.bool_]:
        """Which shapes may touch with numbers of their own, without a pair, (ngeom, ngeom)."""
        n = self._mj.ngeom
        return self._with_pairs(self._masked[:n, :n].copy(), False)

    @cached_property
    def touches(self) -> NDArray[np.bool_]:
        """Which shapes may touch, by their masks or because a pair says so, (ngeom, ngeom)."""
        return self._with_pairs(self.dynamic.copy(), self._contacts_on)

    @cached_property
    def _may_meet(self) -> NDArray[np.bool_]:
        """Which bodies are not kept from touching one another, shape (nbody, nbody)."""
        mj, moves = self._mj, self._moves
        weld = np.asarray(mj.body_weldid)
        parent = weld[mj.body_parentid[weld]]
        found: NDArray[np.bool_] = moves[:, None] | moves[None, :]
        found &= weld[:, None] != weld[None, :]
        if not disabled(mj, _OFF.mjDSBL_FILTERPARENT):
            free = (weld != 0)[:, None] & (weld != 0)[None, :]
            family = (weld[:, None] == parent[None, :]) | (parent[:, None] == weld[None, :])
            found &= ~(free & family)
        for signature in mj.exclude_signature.tolist():
            first, second = signature >> 16, signature & 0xFFFF
            found[first, second] = found[second, first] = False
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
        pairs = np.argwhere(np.triu(meets)).tolist()
        contacts = {
            trees[one] | trees[other] for one, other in pairs if trees[one] and trees[other]
        }
        return _groups(len(self.roots), [*(link.trees for link in self._all_links()), *contacts])

    def _reached(self, trees: Iterable[int]) -> Trees:
        return frozenset().union(*{self._islands[tree] for tree in trees})

    # --- couplings -----------------------------------------------------------------------------

    def _all_links(self) -> Iterator[TreeLink]:
        return (link for links in self.links.values() for link in links)

    def _moving(self, bodies: Iterable[int]) -> Trees:
        """Return the trees of the bodies that can move."""
        return frozenset(self.tree(body) for body in bodies if self._moves[body])

    def _link(
        self,
        *,
        joints: Iterable[int] = (),
        sites: Iterable[int] = (),
        geoms: Iterable[int] = (),
        bodies: Iterable[int] = (),
        beside: Iterable[int] = (),
    ) -> TreeLink:
        """Return what joins some elements; the places of sites beside it count, too."""
        mj, places = self._mj, {*sites, *beside}
        geoms, bodies = frozenset(geoms), {*bodies, *(int(mj.site_bodyid[s]) for s in sites)}
        bodies |= {int(mj.geom_bodyid[geom]) for geom in geoms}
        trees = self._moving({*bodies, *(int(mj.jnt_bodyid[joint]) for joint in joints)})
        bodies |= {int(mj.site_bodyid[site]) for site in beside}
        return TreeLink(trees, frozenset(places), geoms, frozenset(bodies))

    def _tendon(self, tendon: int) -> TreeLink:
        mj, first = self._mj, int(self._mj.tendon_adr[tendon])
        way = range(first, first + int(mj.tendon_num[tendon]))
        of = {kind: [i for i in way if mj.wrap_type[i] in kinds] for kind, kinds in _WAYS.items()}
        found = {kind: [int(mj.wrap_objid[i]) for i in places] for kind, places in of.items()}
        sides = (int(mj.wrap_prm[i]) for i in of["geoms"])
        return self._link(**found, beside=[side for side in sides if side >= 0])

    def _equality(self, equality: int) -> TreeLink:
        mj = self._mj
        ends = [int(e) for e in (mj.eq_obj1id[equality], mj.eq_obj2id[equality]) if e >= 0]
        match mujoco.mjtEq(int(mj.eq_type[equality])):
            case _EQ.mjEQ_CONNECT | _EQ.mjEQ_WELD:
                if mj.eq_objtype[equality] == int(_OBJ.mjOBJ_SITE):
                    return self._link(sites=ends)
                return self._link(bodies=ends)
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


def _groups(n: int, links: Iterable[Iterable[int]]) -> list[Trees]:
    """Merge what is linked, directly or through others; return the group of each."""
    group = [{i} for i in range(n)]
    for link in links:
        joined = {id(group[i]): group[i] for i in link}
        if len(joined) > 1:
            members = set().union(*joined.values())
            for member in members:
                group[member] = members
    shared = {id(members): frozenset(members) for members in group}
    return [shared[id(members)] for members in group]

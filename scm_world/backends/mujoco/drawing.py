"""What MuJoCo shows of a model, as shapes that any renderer can draw.

Geoms come from the arrays of the model, all else from MuJoCo's abstract scene, without OpenGL.
Groups, colors and decorations are the ones that MuJoCo shows by default.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Iterator
from functools import cached_property, lru_cache
from typing import Any, final

import mujoco
import numpy as np
from numpy.typing import NDArray

from scm_world._types import Floats
from scm_world.backends.mujoco.fields import SHOWN
from scm_world.backends.mujoco.realization import Realization
from scm_world.backends.mujoco.slots import GRAY
from scm_world.models.camera import Camera
from scm_world.models.model import Model
from scm_world.models.scene import Scene
from scm_world.models.shapes import (
    BOX,
    CAPSULE,
    CYLINDER,
    ELLIPSOID,
    MESH,
    PLAIN,
    PLANE,
    Mesh,
    Shapes,
    ShapeTable,
    mesh_of,
)

MOST_SHAPES = 10_000  # of the abstract scene
MOST_STAGES = 16  # models that are kept compiled
SHARP = 0.75  # the cosine between the normals of a corner and of its triangle that shows an edge
FAR = 100.0  # times the height of the picture of an orthographic camera: it is drawn from there

_GEOM, _OBJECT, _ROLE = mujoco.mjtGeom, mujoco.mjtObj, mujoco.mjtTextureRole
_KINDS: dict[int, tuple[int, tuple[int, int, int]]] = {
    int(_GEOM.mjGEOM_PLANE): (PLANE, (0, 1, 2)),
    int(_GEOM.mjGEOM_SPHERE): (ELLIPSOID, (0, 0, 0)),
    int(_GEOM.mjGEOM_CAPSULE): (CAPSULE, (0, 0, 1)),
    int(_GEOM.mjGEOM_ELLIPSOID): (ELLIPSOID, (0, 1, 2)),
    int(_GEOM.mjGEOM_CYLINDER): (CYLINDER, (0, 0, 1)),
    int(_GEOM.mjGEOM_BOX): (BOX, (0, 1, 2)),
    int(_GEOM.mjGEOM_MESH): (MESH, (0, 1, 2)),
    int(_GEOM.mjGEOM_SDF): (MESH, (0, 1, 2)),
    int(_GEOM.mjGEOM_HFIELD): (MESH, (0, 1, 2)),
}
"""How we draw a type of MuJoCo's, and which of its three sizes are half its edges."""


@final
class VisibleModel:
    """What can be seen of a model.

    Where a model says of a body how it looks besides how it collides, in groups of geoms that are
    both shown, only how it looks is.
    """

    def __init__(self, structure: Model) -> None:
        self._now = now = Realization(structure, structure.defaults)
        self._given: tuple[Any, bytes] = ((), b"")  # the parameters that were written last
        self.model, self.data = now.model, now.data
        model, whole = now.model, structure.source.whole
        mocap = model.body_mocapid[model.body_rootid] >= 0
        self._moves: NDArray[np.bool_] = (model.body_weldid != 0) | mocap
        self._rows = rows = np.flatnonzero(np.isin(model.geom_type, list(_KINDS)) & _looks(model))
        known = [_KINDS[code] for code in model.geom_type[rows].tolist()]
        self._kinds = np.array([kind for kind, _ in known], dtype=np.int64)
        columns = [columns for _, columns in known]
        self._columns = np.array(columns, dtype=np.int64).reshape(-1, 3)
        self._materials = model.geom_matid[rows]
        self._bodies = model.geom_bodyid[rows].astype(np.int64)
        self._meshes = _meshes(whole, rows.tolist())
        self._textures = [_texture(whole, i) for i in range(model.nmat)]
        sites = (model.site_group < SHOWN).any()
        self._more = bool(sites or model.ntendon or model.nflex or model.nskin)

    def place(self, scene: Scene) -> None:
        """Write parameters and state of a scene of the same structure."""
        now, parameters = self._now, scene.parameters
        given = tuple(parameters), b"".join(value.tobytes() for value in parameters.values())
        if given != self._given:
            now.edit(parameters)
            self._given = given
        now.place(scene.state.vector)
        mujoco.mj_kinematics(self.model, self.data)

    def shapes(self) -> Shapes:
        """Copy all visible parts: geoms, sites, tendons, height fields, flexes and skins."""
        model, data, rows, kinds = self.model, self.data, self._rows, self._kinds
        halves = model.geom_size[rows[:, None], self._columns]
        halves[kinds == CAPSULE, 2] += halves[kinds == CAPSULE, 0]
        colors, tiles = model.geom_rgba[rows], np.empty((len(rows), 5))
        tiles[:] = PLAIN
        if self._textures:
            plain = (colors == GRAY).all(axis=1) & (self._materials >= 0)
            colors[plain] = model.mat_rgba[self._materials[plain]]
        colors = colors.astype(np.float64)
        for row, material in enumerate(self._materials.tolist() if self._textures else ()):
            texture = self._textures[material] if material >= 0 else None
            if texture is not None and kinds[row] == PLANE:
                repeat = np.maximum(model.mat_texrepeat[material], 1e-6)
                whole = np.ones(2) if model.mat_texuniform[material] else halves[row, :2]
                tiles[row, :2] = np.where(whole > 0.0, whole, 1.0) / repeat  # a texture has 2 by 2
                tiles[row, 2:] = colors[row, :3] * texture[1]
                colors[row, :3] *= texture[0]
            elif texture is not None:
                colors[row, :3] *= texture.mean(axis=0)
        places = data.geom_xpos[rows], data.geom_xmat[rows].reshape(-1, 3, 3)
        moves = self._moves[self._bodies]
        table = ShapeTable(kinds, halves, *places, colors, self._bodies, moves, tiles)
        found = Shapes(table, self._meshes)
        return found.joined(self._others()) if self._more else found

    @property
    def cameras(self) -> tuple[str, ...]:
        """Names of the model's own cameras."""
        names = (self.model.camera(i).name for i in range(self.model.ncam))
        return tuple(name for name in names if name)

    def camera(self, name: str, size: tuple[int, int]) -> Camera:
        """Return one of the model's own cameras, where it stands now."""
        model, data, i = self.model, self.data, self.model.camera(name).id
        mujoco.mj_comPos(model, data)
        mujoco.mj_camlight(model, data)
        _, up, back = data.cam_xmat[i].reshape(3, 3).T
        eye, extent = data.cam_xpos[i], float(model.stat.extent)
        near, far = (extent * float(ratio) for ratio in (model.vis.map.znear, model.vis.map.zfar))
        opening = float(model.cam_fovy[i])  # [deg], or the height of an orthographic picture [m]
        if model.cam_projection[i] == mujoco.mjtProjection.mjPROJ_ORTHOGRAPHIC:
            distance = FAR * opening
            eye, near, far = eye + distance * back, near + distance, far + distance
            opening = math.degrees(2.0 * math.atan(0.5 / FAR))
        target, places = (eye - back).tolist(), (eye.tolist(), up.tolist())
        return Camera(
            name, tuple(places[0]), tuple(target), tuple(places[1]), opening, size[1], size[0],
            near, far,
        )  # fmt: skip

    @cached_property
    def _abstract(self) -> tuple[mujoco.MjvScene, mujoco.MjvOption]:
        """The abstract scene, here without geoms."""
        option = mujoco.MjvOption()
        option.geomgroup[:] = 0
        return mujoco.MjvScene(self.model, MOST_SHAPES), option

    def _others(self) -> Shapes:
        """Collect sites, tendons, flexes and skins."""
        model, data, (scene, option) = self.model, self.data, self._abstract
        mujoco.mj_comPos(model, data)
        mujoco.mj_flex(model, data)
        mujoco.mj_tendon(model, data)
        everything, camera = int(mujoco.mjtCatBit.mjCAT_ALL), mujoco.MjvCamera()
        mujoco.mjv_updateScene(model, data, option, None, camera, everything, scene)
        rows, meshes = list[Any](), dict[int, Mesh]()
        for geom in scene.geoms[: scene.ngeom]:
            halves, *place, color = (
                np.array(numbers, dtype=np.float64)
                for numbers in (geom.size, geom.pos, geom.mat, geom.rgba)
            )
            texture = self._textures[geom.matid] if geom.matid >= 0 else None
            if texture is not None:
                color[:3] *= texture.mean(axis=0)
            body, moves = -1, True
            if geom.objtype == _OBJECT.mjOBJ_SITE:
                body = int(model.site_bodyid[geom.objid])
                moves = bool(self._moves[body])
            if geom.type == _GEOM.mjGEOM_FLEX and scene.flexfaceused[geom.objid] == 0:
                rows += [(CAPSULE, *edge, color, -1, True) for edge in self._edges(scene, geom)]
            elif geom.type in (_GEOM.mjGEOM_FLEX, _GEOM.mjGEOM_SKIN):  # they stand in the world
                meshes[len(rows)] = self._surface(scene, geom)
                rows.append((MESH, halves, np.zeros(3), np.eye(3), color, -1, True))
            elif geom.type in _KINDS:
                kind = _KINDS[geom.type][0]
                halves[2] += halves[0] if kind == CAPSULE else 0.0
                rows.append((kind, halves, *place, color, body, moves))
        columns: Any = zip(*rows, strict=True) if rows else [()] * 7
        return Shapes.of(*columns)._replace(meshes=meshes)

    def _edges(
        self, scene: mujoco.MjvScene, geom: mujoco.MjvGeom
    ) -> Iterator[tuple[Floats, Floats, Floats]]:
        """Return the edges of a flex without faces, a cable, as capsules."""
        flex, radius = geom.objid, float(self.model.flex_radius[geom.objid])
        first, n = scene.flexvertadr[flex], scene.flexvertnum[flex]
        begin, m = scene.flexedgeadr[flex], scene.flexedgenum[flex]
        vertices = scene.flexvert[3 * first : 3 * (first + n)].reshape(-1, 3).astype(np.float64)
        for start, end in vertices[scene.flexedge[2 * begin : 2 * (begin + m)].reshape(-1, 2)]:
            turn, rotation, length = np.empty(4), np.empty(9), float(np.linalg.norm(end - start))
            mujoco.mju_quatZ2Vec(turn, end - start)
            mujoco.mju_quat2Mat(rotation, turn)
            halves = np.array([radius, radius, radius + length / 2.0])
            yield halves, (start + end) / 2.0, rotation.reshape(3, 3)

    def _surface(self, scene: mujoco.MjvScene, geom: mujoco.MjvGeom) -> Mesh:
        """Copy the triangles of a flex or of a skin, in the world."""
        number = geom.objid
        if geom.type == _GEOM.mjGEOM_FLEX:
            first, n = 3 * scene.flexfaceadr[number], 3 * scene.flexfaceused[number]
            faces = np.arange(n).reshape(-1, 3)
            vertices, normals = scene.flexface, scene.flexnormal
        else:
            first, n = scene.skinvertadr[number], scene.skinvertnum[number]
            begin, m = self.model.skin_faceadr[number], self.model.skin_facenum[number]
            faces = self.model.skin_face[begin : begin + m]
            vertices, normals = scene.skinvert, scene.skinnormal
        part = slice(3 * first, 3 * (first + n))
        return mesh_of(vertices[part].reshape(-1, 3), faces, normals[part].reshape(-1, 3)[faces])


@lru_cache(maxsize=MOST_STAGES)
def _stage(structure: Model, thread: int) -> VisibleModel:
    """Compile a structure once in each thread."""
    return VisibleModel(structure)


def visible(scene: Scene) -> VisibleModel:
    """Put a scene into MuJoCo, until the next call in this thread.

    Where its structure was seen before, that costs little.
    """
    shown = _stage(scene.structure, threading.get_ident())
    shown.place(scene)
    return shown


def _looks(model: mujoco.MjModel) -> NDArray[np.bool_]:
    """Return which geoms are shown, shape (ngeom,)."""
    shown: NDArray[np.bool_] = model.geom_group < SHOWN
    collides = (model.geom_contype != 0) | (model.geom_conaffinity != 0)
    for body in range(1, model.nbody):
        mine = shown & (model.geom_bodyid == body)
        looks, touches = (set(model.geom_group[mine & kind]) for kind in (~collides, collides))
        if looks - touches:
            shown = shown & ~(mine & collides)
    return shown


def _meshes(model: mujoco.MjModel, geoms: list[int]) -> dict[int, Mesh]:
    """Copy the triangles of meshes and height fields among geoms, by place in the list."""
    found: dict[int, Mesh] = {}
    known: dict[tuple[int, int], Mesh] = {}
    for row, geom in enumerate(geoms):
        kind, number = int(model.geom_type[geom]), int(model.geom_dataid[geom])
        if _KINDS[kind][0] != MESH:
            continue
        if (kind, number) not in known:
            read = _height_field if kind == _GEOM.mjGEOM_HFIELD else _triangles
            known[kind, number] = read(model, number)
        found[row] = known[kind, number]
    return found


def _triangles(model: mujoco.MjModel, mesh: int) -> Mesh:
    """Copy a mesh of a model; edges that the smooth normals of MuJoCo would hide are seen."""
    first, n = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
    begin, m = model.mesh_faceadr[mesh], model.mesh_facenum[mesh]
    at, k = model.mesh_normaladr[mesh], model.mesh_normalnum[mesh]
    faces = model.mesh_face[begin : begin + m]
    flat = mesh_of(model.mesh_vert[first : first + n], faces)
    smooth = model.mesh_normal[at : at + k][model.mesh_facenormal[begin : begin + m]]
    cosines = (flat.normals * smooth).sum(axis=2, keepdims=True)
    return flat._replace(normals=np.where(cosines < SHARP, flat.normals, smooth))


def _height_field(model: mujoco.MjModel, field: int) -> Mesh:
    """Make the upper side of a height field of two triangles per cell."""
    rows, columns = int(model.hfield_nrow[field]), int(model.hfield_ncol[field])
    first = model.hfield_adr[field]
    x_half, y_half, top, _ = model.hfield_size[field]
    x, y = np.meshgrid(np.linspace(-x_half, x_half, columns), np.linspace(-y_half, y_half, rows))
    z = top * model.hfield_data[first : first + rows * columns].astype(np.float64)
    corner = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).ravel()
    one = np.stack([corner, corner + 1, corner + columns + 1], axis=1)
    other = np.stack([corner, corner + columns + 1, corner + columns], axis=1)
    return mesh_of(np.column_stack([x.ravel(), y.ravel(), z]), np.concatenate([one, other]))


def _texture(model: mujoco.MjModel, material: int) -> Floats | None:
    """Return the two colors of the checkerboard closest to a texture, shape (2, 3), if any."""
    roles = model.mat_texid[material]
    texture = max(int(roles[_ROLE.mjTEXROLE_RGB]), int(roles[_ROLE.mjTEXROLE_RGBA]))
    if texture < 0:
        return None
    shape = model.tex_height[texture], model.tex_width[texture], model.tex_nchannel[texture]
    first = model.tex_adr[texture]
    texels = model.tex_data[first : first + int(np.prod(shape))].reshape(shape)[..., :3] / 255.0
    texels = np.broadcast_to(texels, (*shape[:2], 3))
    h, w = (max(int(n) // 2, 1) for n in shape[:2])
    upper, lower = texels[:h], texels[h:] if shape[0] > 1 else texels
    quarters = [half[:, part] for half in (upper, lower) for part in (slice(0, w), slice(w, None))]
    means = [
        quarter.mean(axis=(0, 1)) if quarter.size else texels.mean(axis=(0, 1))
        for quarter in quarters
    ]
    found: Floats = np.array([means[0] + means[3], means[1] + means[2]]) / 2.0
    return found

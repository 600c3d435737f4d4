"""What MuJoCo shows of a model, as shapes that any renderer can draw.

They come from MuJoCo's abstract scene, which needs no OpenGL: groups, colors and decorations are
the ones that MuJoCo shows by default.
"""

from __future__ import annotations

import math
import threading
from collections import OrderedDict
from collections.abc import Iterator
from typing import Any, final
from weakref import WeakKeyDictionary

import mujoco
import numpy as np

from scm_world._types import Floats
from scm_world.backends.mujoco.backend import MujocoBackend
from scm_world.backends.mujoco.reading import body_names
from scm_world.models.camera import Camera
from scm_world.models.scene import Scene
from scm_world.models.shapes import Kind, Mesh, Shape, Tiles, mesh_of

MOST_SHAPES = 10_000
MOST_STAGES = 4  # models that are kept compiled, in each thread
SHOWN_GROUPS, HIDDEN_GROUP = 3, 5  # Source: MuJoCo, mjv_defaultOption
FAR = 100.0  # times the height of the picture of an orthographic camera: it is drawn from there

_GEOM, _OBJECT, _ROLE = mujoco.mjtGeom, mujoco.mjtObj, mujoco.mjtTextureRole
_KINDS: dict[int, Kind] = {
    int(_GEOM.mjGEOM_PLANE): "plane",
    int(_GEOM.mjGEOM_SPHERE): "sphere",
    int(_GEOM.mjGEOM_CAPSULE): "capsule",
    int(_GEOM.mjGEOM_ELLIPSOID): "ellipsoid",
    int(_GEOM.mjGEOM_CYLINDER): "cylinder",
    int(_GEOM.mjGEOM_BOX): "box",
}


@final
class VisibleModel:
    """What can be seen of a compiled model.

    Where a model says of a body how it looks besides how it collides, in groups of geoms that are
    both shown, only how it looks is: the geoms that collide are moved to a group that is hidden.

    Args:
        model: Its colors, sizes and poses may change afterwards; its meshes and textures may not.

    Attributes:
        model: What was given.
        names: Of the bodies, by number.
    """

    def __init__(self, model: mujoco.MjModel) -> None:
        self.model = model
        self.names = body_names(model)
        collides = (model.geom_contype != 0) | (model.geom_conaffinity != 0)
        shown = model.geom_group < SHOWN_GROUPS
        for body in range(1, model.nbody):
            mine = shown & (model.geom_bodyid == body)
            looks, touches = (set(model.geom_group[mine & kind]) for kind in (~collides, collides))
            if looks - touches:
                model.geom_group[mine & collides] = HIDDEN_GROUP
        self._scene = mujoco.MjvScene(model, MOST_SHAPES)
        self._option, self._camera = mujoco.MjvOption(), mujoco.MjvCamera()
        self._meshes: dict[tuple[int, int], Mesh] = {}
        self._textures = [_texture(model, i) for i in range(model.nmat)]

    @property
    def cameras(self) -> tuple[str, ...]:
        """Names of the model's own cameras."""
        names = (self.model.camera(i).name for i in range(self.model.ncam))
        return tuple(name for name in names if name)

    def scene(self, data: mujoco.MjData) -> mujoco.MjvScene:
        """Fill the abstract scene with what stands in the coordinates; nothing moves by that."""
        model = self.model
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_camlight(model, data)
        mujoco.mj_flex(model, data)
        mujoco.mj_tendon(model, data)
        everything = int(mujoco.mjtCatBit.mjCAT_ALL)
        mujoco.mjv_updateScene(
            model, data, self._option, None, self._camera, everything, self._scene
        )
        return self._scene

    def shapes(self, data: mujoco.MjData) -> list[Shape]:
        """List what is shown: geoms, sites, tendons, height fields, flexes and skins."""
        scene = self.scene(data)
        found: list[Shape | None] = []
        for geom in scene.geoms[: scene.ngeom]:
            if geom.type == _GEOM.mjGEOM_FLEX and scene.flexfaceused[geom.objid] == 0:
                found += self._edges(scene, geom)
            else:
                found.append(self._shape(scene, geom))
        return [shape for shape in found if shape is not None]

    def camera(self, data: mujoco.MjData, name: str, size: tuple[int, int]) -> Camera:
        """Give one of the model's own cameras, where it stands now.

        Args:
            data: Coordinates.
            name: One of ``cameras``.
            size: Height and width of its picture [pixels].
        """
        self._camera.type = mujoco.mjtCamera.mjCAMERA_FIXED
        self._camera.fixedcamid = self.model.camera(name).id
        left, right = self.scene(data).camera
        self._camera.type = mujoco.mjtCamera.mjCAMERA_FREE
        eye = (np.array(left.pos, dtype=np.float64) + right.pos) / 2.0
        forward = np.array(left.forward, dtype=np.float64)
        half = (float(left.frustum_top) - float(left.frustum_bottom)) / 2.0
        near = distance = float(left.frustum_near)
        if left.orthographic:
            distance = FAR * 2.0 * half
            eye, near = eye - distance * forward, distance + near
        return Camera(
            name,
            tuple(eye.tolist()),
            tuple((eye + forward).tolist()),
            tuple(np.array(left.up, dtype=np.float64).tolist()),
            math.degrees(2.0 * math.atan(half / distance)),
            size[1],
            size[0],
            near,
            near + float(left.frustum_far),
        )

    def _shape(self, scene: mujoco.MjvScene, geom: mujoco.MjvGeom) -> Shape | None:
        """Translate one element of the scene; None if we do not draw its kind."""
        kind = _KINDS.get(geom.type, "mesh")
        halves, mesh, tiles = np.array(geom.size, dtype=np.float64), None, None
        position = np.array(geom.pos, dtype=np.float64)
        rotation = np.array(geom.mat, dtype=np.float64)
        if kind == "capsule":
            halves[2] += halves[0]
        elif kind == "mesh":
            mesh = self._mesh(scene, geom)
            if mesh is None:
                return None
            if geom.type in (_GEOM.mjGEOM_FLEX, _GEOM.mjGEOM_SKIN):  # they stand in the world
                position, rotation = np.zeros(3), np.eye(3)
        color = np.array(geom.rgba, dtype=np.float64)
        texture = self._textures[geom.matid] if geom.matid >= 0 else None
        if texture is not None and kind == "plane":
            # A texture holds two by two tiles.
            repeat = np.maximum(self.model.mat_texrepeat[geom.matid], 1e-6)
            whole = np.array(geom.size[:2], dtype=np.float64)
            if self.model.mat_texuniform[geom.matid]:
                whole[:] = 1.0
            first, second = (np.where(whole > 0.0, whole, 1.0) / repeat).tolist()
            tiles = Tiles((first, second), tuple((color[:3] * texture[1]).tolist()))
            color[:3] *= texture[0]
        elif texture is not None:
            color[:3] *= texture.mean(axis=0)
        body, moves = self._body(geom)
        return Shape(kind, halves, position, rotation, color, body, moves, mesh, tiles)

    def _edges(self, scene: mujoco.MjvScene, geom: mujoco.MjvGeom) -> Iterator[Shape]:
        """Give a flex without faces, a cable, as a capsule for each edge."""
        flex, radius = geom.objid, float(self.model.flex_radius[geom.objid])
        first, n = scene.flexvertadr[flex], scene.flexvertnum[flex]
        begin, m = scene.flexedgeadr[flex], scene.flexedgenum[flex]
        vertices = scene.flexvert[3 * first : 3 * (first + n)].reshape(-1, 3).astype(np.float64)
        for start, end in vertices[scene.flexedge[2 * begin : 2 * (begin + m)].reshape(-1, 2)]:
            turn, length = np.empty(4), float(np.linalg.norm(end - start))
            rotation = np.empty(9)
            mujoco.mju_quatZ2Vec(turn, end - start)
            mujoco.mju_quat2Mat(rotation, turn)
            halves = np.array([radius, radius, radius + length / 2.0])
            color = np.array(geom.rgba, dtype=np.float64)
            middle = (start + end) / 2.0
            yield Shape("capsule", halves, middle, rotation.reshape(3, 3), color, moves=True)

    def _body(self, geom: mujoco.MjvGeom) -> tuple[int, bool]:
        """Find the body that something belongs to, and whether it moves."""
        model = self.model
        if geom.objtype == _OBJECT.mjOBJ_GEOM:
            body = int(model.geom_bodyid[geom.objid])
        elif geom.objtype == _OBJECT.mjOBJ_SITE:
            body = int(model.site_bodyid[geom.objid])
        else:
            return -1, True
        welded = int(model.body_weldid[body])
        return body, welded != 0 or int(model.body_mocapid[model.body_rootid[body]]) >= 0

    def _mesh(self, scene: mujoco.MjvScene, geom: mujoco.MjvGeom) -> Mesh | None:
        """Find the triangles of an element of the scene; None if it has none."""
        if geom.type == _GEOM.mjGEOM_FLEX:
            first, n = 9 * scene.flexfaceadr[geom.objid], 9 * scene.flexfaceused[geom.objid]
            faces = np.arange(n // 3).reshape(-1, 3)
            vertices = scene.flexface[first : first + n].reshape(-1, 3)
            normals = scene.flexnormal[first : first + n].reshape(-1, 3)
            return mesh_of(vertices, faces, normals[faces]) if n else None
        if geom.type == _GEOM.mjGEOM_SKIN:
            first, n = scene.skinvertadr[geom.objid], scene.skinvertnum[geom.objid]
            begin, m = self.model.skin_faceadr[geom.objid], self.model.skin_facenum[geom.objid]
            faces = self.model.skin_face[begin : begin + m]
            vertices = scene.skinvert[3 * first : 3 * (first + n)].reshape(-1, 3)
            normals = scene.skinnormal[3 * first : 3 * (first + n)].reshape(-1, 3)
            return mesh_of(vertices, faces, normals[faces])
        if geom.type not in (_GEOM.mjGEOM_MESH, _GEOM.mjGEOM_SDF, _GEOM.mjGEOM_HFIELD):
            return None
        key = geom.type, geom.dataid
        if key not in self._meshes:
            field = geom.type == _GEOM.mjGEOM_HFIELD
            self._meshes[key] = (
                _height_field(self.model, geom.dataid)
                if field
                else _triangles(self.model, geom.dataid // 2)
            )
        return self._meshes[key]


_local = threading.local()
"""What each thread has drawn last."""


def drawn(scene: Scene) -> tuple[VisibleModel, mujoco.MjData]:
    """Put the scene of a ``Model`` into MuJoCo; where it was built before, that costs little.

    Args:
        scene: Whose structure is a ``Model`` that was read by MuJoCo.

    Returns:
        What is drawn, and the coordinates. They are valid until the next call in this thread.
    """
    stages: OrderedDict[Any, MujocoBackend] = _local.__dict__.setdefault("stages", OrderedDict())
    shown: WeakKeyDictionary[Any, VisibleModel]
    shown = _local.__dict__.setdefault("shown", WeakKeyDictionary())
    backend = stages.pop(scene.structure, None) or MujocoBackend()
    stages[scene.structure] = backend
    if len(stages) > MOST_STAGES:
        stages.popitem(last=False)
    backend.build(scene)
    now = backend.realization
    if now not in shown:
        shown[now] = VisibleModel(now.model)
    return shown[now], now.data


def _triangles(model: mujoco.MjModel, mesh: int) -> Mesh:
    """Copy a mesh of a model."""
    first, n = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
    begin, m = model.mesh_faceadr[mesh], model.mesh_facenum[mesh]
    at, k = model.mesh_normaladr[mesh], model.mesh_normalnum[mesh]
    corners = model.mesh_facenormal[begin : begin + m]
    return mesh_of(
        model.mesh_vert[first : first + n],
        model.mesh_face[begin : begin + m],
        model.mesh_normal[at : at + k][corners],
    )


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
    """Give the two colors of the checkerboard closest to a texture, shape (2, 3); None without."""
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

"""MuJoCo as a renderer: a scene becomes a model, a camera pose becomes a gray image or depth and instances.

The only file that touches mujoco and GL. mujoco is optional and imported late, after MUJOCO_GL is settled.
"""

from __future__ import annotations

import ctypes.util
import os
import sys
from types import TracebackType
from typing import Any, Self

import cv2
import numpy as np
from numpy.typing import NDArray

from viflow_anomaly.errors import MissingDependencyError
from viflow_anomaly.sensor_data import Float64Array, PinholeCamera, Uint8Array
from viflow_anomaly.simulator.scene import Material, Scene, Solid

NEAR_M = 0.05
SKY_FACES = 6
PLANE_CELLS = 10
HIDDEN_GROUP = 5  # of MuJoCo's geom groups: not drawn by default
# MuJoCo cameras look along -z with y up; ours along +z with y down.
R_CAMERA_GL = np.diag([1.0, -1.0, -1.0])


def load_mujoco() -> Any:
    """Import mujoco with an offscreen GL backend: MUJOCO_GL as the user set it, else EGL, else OSMesa.

    Raises:
        MissingDependencyError: ``mujoco_missing`` (with the install line) or ``gl_missing`` (with the packages).
    """
    if sys.platform == "linux" and not os.environ.get("MUJOCO_GL"):
        os.environ["MUJOCO_GL"] = _offscreen_backend()
    try:
        import mujoco  # noqa: PLC0415
    except ModuleNotFoundError as err:
        if err.name != "mujoco":
            raise
        raise MissingDependencyError(
            'the simulator needs mujoco, which is not installed: pip install "viflow-anomaly[simulate]"',
            code="mujoco_missing",
        ) from err
    except (ImportError, AttributeError, OSError, RuntimeError) as err:  # PyOpenGL without its library
        raise _gl_missing(str(err)) from err
    return mujoco


def _offscreen_backend() -> str:
    for backend, library in (("egl", "EGL"), ("osmesa", "OSMesa")):
        if ctypes.util.find_library(library):
            return backend
    raise _gl_missing("neither libEGL nor libOSMesa was found")


def _gl_missing(problem: str) -> MissingDependencyError:
    return MissingDependencyError(
        "the simulator needs OpenGL without a display: install the Debian packages libegl1 and libgl1-mesa-dri, or "
        f"libosmesa6, or set MUJOCO_GL yourself (now {os.environ.get('MUJOCO_GL')!r}); found: {problem}",
        code="gl_missing",
    )


def _quaternion(rotation: Float64Array) -> Float64Array:
    """[3, 3] -> unit quaternion w x y z, by the largest of the four (never divides by a small number)."""
    m = rotation
    squares = np.array(
        [
            1 + m[0, 0] + m[1, 1] + m[2, 2],
            1 + m[0, 0] - m[1, 1] - m[2, 2],
            1 - m[0, 0] + m[1, 1] - m[2, 2],
            1 - m[0, 0] - m[1, 1] + m[2, 2],
        ]
    )
    a, b, c = m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]
    d, e, f = m[1, 0] + m[0, 1], m[0, 2] + m[2, 0], m[2, 1] + m[1, 2]
    rows = np.array([[squares[0], a, b, c], [a, squares[1], d, e], [b, d, squares[2], f], [c, e, f, squares[3]]])
    best = rows[int(np.argmax(squares))]
    return np.asarray(best / np.linalg.norm(best))


def quaternions_wxyz(rotations: Float64Array) -> Float64Array:
    """[N, 3, 3] -> [N, 4] unit quaternions w x y z, each on its predecessor's side."""
    result = np.stack([_quaternion(rotation) for rotation in rotations])
    flips = np.cumprod(np.where((result[1:] * result[:-1]).sum(axis=1) < 0, -1.0, 1.0))
    result[1:] *= flips[:, None]
    return result


def _add_texture(spec: Any, name: str, image: Uint8Array, kind: Any, faces: int) -> None:
    side = image.shape[0]
    texture = spec.add_texture(name=name, type=kind, width=side, height=side * faces, nchannel=3)
    texture.data = np.repeat(np.tile(image, (faces, 1))[..., None], 3, axis=2).tobytes()


def _add_material(mujoco: Any, spec: Any, material: Material) -> None:
    kinds = mujoco.mjtTexture
    kind = kinds.mjTEXTURE_CUBE if material.mapping == "wrap" else kinds.mjTEXTURE_2D
    _add_texture(spec, material.name, material.image, kind, 1)
    made = spec.add_material(name=material.name)
    made.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = material.name
    made.texrepeat = list(material.repeat)
    made.specular = material.specular
    made.shininess = 0.3
    made.reflectance = 0.0


def _add_solid(mujoco: Any, body: Any, solid: Solid) -> None:
    shapes = mujoco.mjtGeom
    size = list(solid.size_m)
    if solid.shape == "plane":
        size[2] = max(size[:2]) / PLANE_CELLS  # the third size is the spacing of the drawn grid
    body.add_geom(
        type=getattr(shapes, f"mjGEOM_{solid.shape.upper()}"),
        size=size,
        pos=solid.position_m,
        quat=_quaternion(solid.rotation),
        material=solid.material,
        contype=0,
        conaffinity=0,
    )


def _add_strips(mujoco: Any, spec: Any, scene: Scene) -> None:
    for index, strip in enumerate(scene.strips):
        mesh = spec.add_mesh(name=f"strip{index}")
        mesh.uservert = strip.vertices_m.ravel()
        mesh.userface = strip.faces.ravel().astype(np.int32)
        mesh.usertexcoord = strip.texture_coordinates.ravel()
        mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
        spec.worldbody.add_geom(
            type=mujoco.mjtGeom.mjGEOM_MESH,
            meshname=f"strip{index}",
            material=strip.material,
            contype=0,
            conaffinity=0,
        )


def _add_lights(mujoco: Any, spec: Any, scene: Scene) -> None:
    headlight = spec.visual.headlight
    headlight.ambient = [scene.ambient] * 3
    headlight.diffuse = [scene.headlight] * 3
    headlight.specular = [0.0] * 3
    kinds = mujoco.mjtLightType
    for light in scene.lights:
        made = spec.worldbody.add_light()
        made.type = kinds.mjLIGHT_DIRECTIONAL if light.position_m is None else kinds.mjLIGHT_POINT
        made.pos = np.zeros(3) if light.position_m is None else light.position_m
        made.dir = light.direction
        made.diffuse = [light.diffuse] * 3
        made.ambient = [0.0] * 3
        made.specular = [0.2] * 3
        made.attenuation = [1.0, 0.0, 0.0] if light.position_m is None else [0.6, 0.05, 0.01]
        made.castshadow = False


def _add_camera(spec: Any, camera: PinholeCamera) -> None:
    body = spec.worldbody.add_body(name="camera", mocap=True)
    body.add_camera(
        name="camera",
        resolution=[camera.width, camera.height],
        sensor_size=[camera.width, camera.height],
        focal_pixel=[camera.fx, camera.fy],
        # Offsets from the middle of the image; integer pixel centres put that at (size - 1) / 2. Signs are tested.
        principal_pixel=[camera.cx - (camera.width - 1) / 2, camera.cy - (camera.height - 1) / 2],
    )


def build_model(mujoco: Any, scene: Scene, camera: PinholeCamera, supersampling: int) -> Any:
    """Compile the scene; mocap bodies: ``camera`` and ``mover1``..``moverN``."""
    spec = mujoco.MjSpec()
    spec.visual.global_.offwidth = camera.width * supersampling
    spec.visual.global_.offheight = camera.height * supersampling
    spec.visual.quality.offsamples = 0
    spec.visual.quality.shadowsize = 0
    spec.visual.quality.numslices, spec.visual.quality.numstacks = 20, 12
    spec.visual.map.znear, spec.visual.map.zfar = NEAR_M, scene.far_m
    spec.stat.extent = 1.0
    for material in scene.materials:
        _add_material(mujoco, spec, material)
    if scene.sky is not None:
        _add_texture(spec, "sky", scene.sky, mujoco.mjtTexture.mjTEXTURE_SKYBOX, SKY_FACES)
    for solid in scene.solids:
        _add_solid(mujoco, spec.worldbody, solid)
    _add_strips(mujoco, spec, scene)
    _add_lights(mujoco, spec, scene)
    _add_camera(spec, camera)
    for number, mover in enumerate(scene.movers, start=1):
        body = spec.worldbody.add_body(name=f"mover{number}", mocap=True)
        for solid in mover.solids:
            _add_solid(mujoco, body, solid)
    return spec.compile()


class SceneRenderer:
    """A scene on the GPU (or Mesa). A context manager: GL objects are freed on exit.

    Raises:
        MissingDependencyError: see ``load_mujoco``.
    """

    def __init__(self, scene: Scene, camera: PinholeCamera, *, supersampling: int) -> None:
        self._mujoco = mujoco = load_mujoco()
        self._scene, self._camera, self._supersampling = scene, camera, supersampling
        width, height = camera.width * supersampling, camera.height * supersampling
        self._model = build_model(mujoco, scene, camera, supersampling)
        self._data = mujoco.MjData(self._model)
        try:
            self._gl = mujoco.GLContext(width, height)
            self._gl.make_current()
        except (ImportError, AttributeError, OSError, RuntimeError) as err:
            raise _gl_missing(str(err)) from err
        self._context = mujoco.MjrContext(self._model, mujoco.mjtFontScale.mjFONTSCALE_100)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._context)
        self._context.readDepthMap = mujoco.mjtDepthMap.mjDEPTH_ZEROFAR
        self._view = mujoco.MjvScene(self._model, maxgeom=self._model.ngeom + 50)
        for flag in (mujoco.mjtRndFlag.mjRND_SHADOW, mujoco.mjtRndFlag.mjRND_REFLECTION, mujoco.mjtRndFlag.mjRND_HAZE):
            self._view.flags[flag] = False
        self._view_camera = mujoco.MjvCamera()
        self._view_camera.type = mujoco.mjtCamera.mjCAMERA_FIXED
        self._view_camera.fixedcamid = self._model.camera("camera").id
        self._instances_of_geoms = self._number_geoms()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, err: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._context.free()
        self._gl.free()

    def _number_geoms(self) -> Uint8Array:
        """[ngeom] instance number of every geom: 0 static, 1.. movers."""
        numbers = np.zeros(self._model.ngeom, np.uint8)
        for number in range(1, len(self._scene.movers) + 1):
            numbers[self._model.geom_bodyid == self._model.body(f"mover{number}").id] = number
        return numbers

    def _set_mocap(self, body: str, position: Float64Array, rotation: Float64Array) -> None:
        index = int(self._model.body(body).mocapid[0])
        self._data.mocap_pos[index] = position
        self._data.mocap_quat[index] = _quaternion(rotation)

    def place(self, T_world_cam: Float64Array, frame: int) -> None:
        """Put the camera there and every mover where it is at that frame."""
        mujoco = self._mujoco
        self._set_mocap("camera", T_world_cam[:3, 3], T_world_cam[:3, :3] @ R_CAMERA_GL)
        for number, mover in enumerate(self._scene.movers, start=1):
            self._set_mocap(f"mover{number}", mover.positions_m[frame], mover.rotations[frame])
        mujoco.mj_kinematics(self._model, self._data)
        mujoco.mj_camlight(self._model, self._data)
        option, perturbation = mujoco.MjvOption(), mujoco.MjvPerturb()
        self._model.geom_group[:] = np.where(self._in_view(T_world_cam), 0, HIDDEN_GROUP)
        every = int(mujoco.mjtCatBit.mjCAT_ALL)
        mujoco.mjv_updateScene(self._model, self._data, option, perturbation, self._view_camera, every, self._view)

    def _in_view(self, T_world_cam: Float64Array) -> NDArray[np.bool_]:
        """[ngeom]: not wholly outside the image by its bounding sphere. Mesa processes what nobody sees otherwise."""
        radii = np.asarray(self._model.geom_rbound)
        points = (np.asarray(self._data.geom_xpos) - T_world_cam[:3, 3]) @ T_world_cam[:3, :3]
        camera = self._camera
        corners = np.array([[-0.5, -0.5], [camera.width - 0.5, camera.height - 0.5]])
        low, high = (corners - (camera.cx, camera.cy)) / (camera.fx, camera.fy)
        planes = np.array([[1, 0, -low[0]], [-1, 0, high[0]], [0, 1, -low[1]], [0, -1, high[1]], [0, 0, 1.0]])
        inside = points @ (planes / np.linalg.norm(planes, axis=1, keepdims=True)).T
        return np.asarray((inside >= -radii[:, None] - 0.01).all(axis=1) | (radii == 0))  # planes are unbounded: 0

    def gray(self) -> Uint8Array:
        """[H, W] uint8, rendered at the supersampled size and averaged."""
        mujoco, scale = self._mujoco, self._supersampling
        width, height = self._camera.width * scale, self._camera.height * scale
        pixels = np.empty((height, width, 3), np.uint8)
        rect = mujoco.MjrRect(0, 0, width, height)
        mujoco.mjr_render(rect, self._view, self._context)
        mujoco.mjr_readPixels(pixels, None, rect, self._context)
        # Textures and lights are white: the channels are equal. GL's first row is the lowest.
        channel = np.ascontiguousarray(pixels[::-1, :, 0])
        size = (self._camera.width, self._camera.height)
        return channel if scale == 1 else np.asarray(cv2.resize(channel, size, interpolation=cv2.INTER_AREA))

    def depth_and_instances(self) -> tuple[NDArray[np.float32], Uint8Array]:
        """Depth along the optical axis [H, W] in metres (inf: sky) and instance numbers [H, W] at pixel centres."""
        mujoco, view = self._mujoco, self._view
        height, width = self._camera.height, self._camera.width
        buffer, colours = np.empty((height, width), np.float32), np.empty((height, width, 3), np.uint8)
        rect = mujoco.MjrRect(0, 0, width, height)
        segment_flags = (mujoco.mjtRndFlag.mjRND_SEGMENT, mujoco.mjtRndFlag.mjRND_IDCOLOR)
        for flag in segment_flags:
            view.flags[flag] = True
        mujoco.mjr_render(rect, view, self._context)
        mujoco.mjr_readPixels(colours, buffer, rect, self._context)
        for flag in segment_flags:
            view.flags[flag] = False
        codes = colours[::-1].astype(np.uint32) @ np.array([1, 2**8, 2**16], np.uint32)
        near, far = np.float64(NEAR_M), np.float64(self._scene.far_m)
        z = buffer[::-1].astype(np.float64)  # reversed depth: 1 near, 0 far
        depth = near * far / (z * (far - near) + near)
        hit = codes > 0
        return np.where(hit, depth, np.inf).astype(np.float32), self._instances_by_code()[codes]

    def _instances_by_code(self) -> Uint8Array:
        """Segmentation colour (0 is the sky, geom's segment number + 1 otherwise) -> instance number."""
        table = np.zeros(self._view.ngeom + 1, np.uint8)
        for geom in self._view.geoms[: self._view.ngeom]:
            is_geom = geom.objtype == int(self._mujoco.mjtObj.mjOBJ_GEOM)
            if geom.segid >= 0 and is_geom:
                table[geom.segid + 1] = self._instances_of_geoms[geom.objid]
        return table

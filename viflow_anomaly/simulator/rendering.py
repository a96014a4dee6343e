"""A camera pose becomes a gray image, or depth and instance numbers, drawn by MuJoCo."""

from __future__ import annotations

from types import TracebackType
from typing import Self

import cv2
import numpy as np
from numpy.typing import NDArray

from viflow_anomaly.sensor_data import Float64Array, PinholeCamera, Uint8Array
from viflow_anomaly.simulator.gl import gl_missing, load_mujoco
from viflow_anomaly.simulator.motion import quaternion_wxyz
from viflow_anomaly.simulator.mujoco_model import NEAR_M, build_model
from viflow_anomaly.simulator.scene import Scene

HIDDEN_GROUP = 5  # of MuJoCo's geom groups: not drawn by default
# MuJoCo cameras look along -z with y up; ours along +z with y down.
R_CAMERA_GL = np.diag([1.0, -1.0, -1.0])


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
            raise gl_missing(str(err)) from err
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
        self._data.mocap_quat[index] = quaternion_wxyz(rotation)

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

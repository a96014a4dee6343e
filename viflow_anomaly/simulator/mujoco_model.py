"""A scene and a camera as a MuJoCo model, which is used for drawing only: nothing collides, nothing is simulated."""

from __future__ import annotations

from typing import Any

import numpy as np

from viflow_anomaly.sensor_data import PinholeCamera, Uint8Array
from viflow_anomaly.simulator.motion import quaternion_wxyz
from viflow_anomaly.simulator.scene import Material, Scene, Solid

NEAR_M = 0.05
SKY_FACES = 6
PLANE_CELLS = 10


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
        quat=quaternion_wxyz(solid.rotation),
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
        # MuJoCo's offset is that of the image's middle from the principal point (tests/simulator/test_rendering.py);
        # with integer pixel centres the middle is at (size - 1) / 2.
        principal_pixel=[(camera.width - 1) / 2 - camera.cx, (camera.height - 1) / 2 - camera.cy],
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

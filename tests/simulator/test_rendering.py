"""Pictures land where the camera model says, and missing software is named."""

from __future__ import annotations

import builtins
import ctypes.util
import os
import sys
from typing import Any

import numpy as np
import pytest

from viflow_anomaly.errors import MissingDependencyError
from viflow_anomaly.sensor_data import PinholeCamera
from viflow_anomaly.simulator.gl import load_mujoco
from viflow_anomaly.simulator.rendering import SceneRenderer
from viflow_anomaly.simulator.scene import Material, Mover, Scene, Solid

CAMERA = PinholeCamera(fx=110.0, fy=100.0, cx=52.3, cy=27.6, width=96, height=64)
POINT = np.array([0.11, -0.07, 2.0])  # in the camera; the world is the camera's here


def ball_scene() -> Scene:
    ball = Solid("sphere", (0.12, 0.0, 0.0), np.zeros(3), np.eye(3), "white")
    wall = Solid("box", (20.0, 20.0, 0.5), np.array([0.0, 0.0, 5.5]), np.eye(3), "black")
    return Scene(
        materials=(
            Material("white", np.full((8, 8), 255, np.uint8), specular=0.0),
            Material("black", np.zeros((8, 8), np.uint8), specular=0.0),
        ),
        solids=(wall,),
        lights=(),
        ambient=1.0,
        headlight=0.0,
        far_m=50.0,
        movers=(Mover((ball,), POINT[None], np.eye(3)[None]),),
    )


def centroid(weights: np.ndarray) -> tuple[float, float]:
    v, u = np.mgrid[0 : weights.shape[0], 0 : weights.shape[1]]
    return float((u * weights).sum() / weights.sum()), float((v * weights).sum() / weights.sum())


@pytest.mark.parametrize("supersampling", [1, 2, 3])
def test_a_known_point_projects_where_the_intrinsics_say(gl: None, supersampling: int) -> None:
    u = CAMERA.fx * POINT[0] / POINT[2] + CAMERA.cx
    v = CAMERA.fy * POINT[1] / POINT[2] + CAMERA.cy
    with SceneRenderer(ball_scene(), CAMERA, supersampling=supersampling) as renderer:
        renderer.place(np.eye(4), 0)
        gray = renderer.gray()
        depth, instances = renderer.depth_and_instances()
    assert gray.shape == (64, 96)
    assert gray.max() > 200
    assert gray.min() == 0
    assert centroid(gray.astype(float)) == pytest.approx((u, v), abs=0.12)
    assert centroid((instances == 1).astype(float)) == pytest.approx((u, v), abs=0.25)
    assert depth[round(v), round(u)] == pytest.approx(1.88, abs=0.01)
    np.testing.assert_allclose(depth[instances == 0], 5.0, rtol=1e-4)


def test_culling_changes_no_pixel(gl: None, monkeypatch: pytest.MonkeyPatch) -> None:
    with SceneRenderer(ball_scene(), CAMERA, supersampling=1) as renderer:
        for shift in (0.0, 0.6, 1.0, 1.2):
            pose = np.eye(4)
            pose[0, 3] = shift
            renderer.place(pose, 0)
            culled = renderer.gray()
            with monkeypatch.context() as patch:
                patch.setattr(renderer, "_in_view", lambda _: np.ones(2, bool))
                renderer.place(pose, 0)
                np.testing.assert_array_equal(renderer.gray(), culled)


def test_missing_mujoco_names_the_install_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "mujoco", None)
    monkeypatch.setenv("MUJOCO_GL", "egl")
    with pytest.raises(MissingDependencyError, match=r'pip install "viflow-anomaly\[simulate\]"') as raised:
        load_mujoco()
    assert raised.value.code == "mujoco_missing"


@pytest.mark.parametrize("problem", [ImportError("no libEGL"), AttributeError("eglQueryString"), OSError("libGL")])
def test_broken_gl_names_the_packages(monkeypatch: pytest.MonkeyPatch, problem: Exception) -> None:
    real_import = builtins.__import__

    def refuse(name: str, *args: Any, **kwargs: Any) -> Any:
        if name == "mujoco":
            raise problem
        return real_import(name, *args, **kwargs)

    monkeypatch.setenv("MUJOCO_GL", "egl")
    monkeypatch.setattr(builtins, "__import__", refuse)
    with pytest.raises(MissingDependencyError, match=r"libegl1.*libosmesa6") as raised:
        load_mujoco()
    assert raised.value.code == "gl_missing"


def test_a_module_that_mujoco_misses_is_not_called_mujoco(monkeypatch: pytest.MonkeyPatch) -> None:
    real_import = builtins.__import__

    def refuse(name: str, *args: Any, **kwargs: Any) -> Any:
        if name == "mujoco":
            raise ModuleNotFoundError("No module named 'glfw'", name="glfw")
        return real_import(name, *args, **kwargs)

    monkeypatch.setenv("MUJOCO_GL", "egl")
    monkeypatch.setattr(builtins, "__import__", refuse)
    with pytest.raises(ModuleNotFoundError, match="glfw"):
        load_mujoco()


@pytest.mark.skipif(sys.platform != "linux", reason="the backend is chosen on Linux only")
def test_backend_is_chosen_by_the_library_that_is_there(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "mujoco", None)
    for present, backend in (("EGL", "egl"), ("OSMesa", "osmesa")):
        monkeypatch.setenv("MUJOCO_GL", "")
        monkeypatch.setattr(ctypes.util, "find_library", lambda name, there=present: "lib" if name == there else None)
        with pytest.raises(MissingDependencyError):
            load_mujoco()
        assert os.environ["MUJOCO_GL"] == backend
    monkeypatch.setenv("MUJOCO_GL", "")
    monkeypatch.setattr(ctypes.util, "find_library", lambda _: None)
    with pytest.raises(MissingDependencyError, match="neither libEGL nor libOSMesa") as raised:
        load_mujoco()
    assert raised.value.code == "gl_missing"


def test_a_context_that_cannot_be_made_names_the_packages(gl: None, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: Any) -> None:
        raise RuntimeError("no EGL device")

    monkeypatch.setattr(load_mujoco(), "GLContext", refuse)
    with pytest.raises(MissingDependencyError, match="no EGL device") as raised:
        SceneRenderer(ball_scene(), CAMERA, supersampling=1)
    assert raised.value.code == "gl_missing"

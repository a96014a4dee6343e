"""Worlds are clear of the camera, movers are in view, textures are textures."""

from __future__ import annotations

import numpy as np
import pytest
from small_sequences import small

from viflow_anomaly.simulator import textures
from viflow_anomaly.simulator.scene import Solid
from viflow_anomaly.simulator.sequence import build_world


@pytest.mark.parametrize(("rig", "clearance_m"), [("drone", 0.49), ("car", 2.1)])
@pytest.mark.parametrize("seed", range(4))
def test_nothing_static_comes_near_the_camera(rig: str, clearance_m: float, seed: int) -> None:
    world = build_world(small(rig, frames=30), seed)
    path = world.camera_poses[:, :3, 3]
    assert len(world.scene.solids) > 20
    for solid in world.scene.solids:
        if solid.shape != "plane":
            assert solid.clearance_m(path) >= clearance_m


@pytest.mark.parametrize("rig", ["drone", "car"])
@pytest.mark.parametrize("seed", range(4))
def test_movers_keep_clear_of_the_camera_and_are_in_view(rig: str, seed: int) -> None:
    world = build_world(small(rig, frames=30, movers=(3, 3)), seed)
    camera = world.rig.camera
    assert 1 <= len(world.scene.movers) <= 3
    seen = 0
    for mover in world.scene.movers:
        relative = mover.positions_m - world.camera_poses[:, :3, 3]
        assert np.linalg.norm(relative, axis=1).min() > 0.6
        x, y, z = np.einsum("fji,fj->if", world.camera_poses[:, :3, :3], relative)
        u, v = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
        seen += int(((z > 0) & (u > 0) & (u < 63) & (v > -10) & (v < 58)).sum())
        speeds = np.linalg.norm(np.diff(mover.positions_m, axis=0), axis=1) * world.rig.frame_rate_hz
        assert speeds.max() < (6.0 if rig == "drone" else 25.0)
    assert seen > 15


def test_a_world_without_movers_has_none() -> None:
    assert build_world(small("drone", movers=(0, 0)), 1).scene.movers == ()


@pytest.mark.parametrize(
    "kind",
    [
        textures.fractal,
        textures.smooth,
        textures.masonry,
        textures.stripes,
        textures.pebbles,
        textures.facade,
        textures.photograph,
        textures.asphalt,
    ],
)
def test_textures_are_exposed_and_repeatable(kind: object) -> None:
    assert callable(kind)
    image = kind(np.random.default_rng(3), 128)
    assert image.shape == (128, 128)
    assert image.dtype == np.uint8
    assert 50 < image.mean() < 210
    assert image.std() > 2
    np.testing.assert_array_equal(image, kind(np.random.default_rng(3), 128))


def test_scikit_image_ships_photographs() -> None:
    assert len(textures.photographs()) >= 10


def test_photograph_falls_back_to_noise_when_there_are_none(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(textures, "photographs", lambda: ())
    assert textures.photograph(np.random.default_rng(0), 64).std() > 5


def test_photographs_that_are_missing_are_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(textures, "PHOTOGRAPHS", ("no_such_picture.png", "camera.png"))
    textures.photographs.cache_clear()
    try:
        assert len(textures.photographs()) == 1
    finally:
        textures.photographs.cache_clear()


@pytest.mark.parametrize(
    ("shape", "size", "point", "distance"),
    [
        ("box", (1.0, 2.0, 3.0), (0.0, 0.0, 5.0), 2.0),
        ("sphere", (1.0, 0.0, 0.0), (3.0, 0.0, 0.0), 2.0),
        ("capsule", (0.5, 1.0, 0.0), (0.0, 0.0, 2.5), 1.0),
        ("cylinder", (0.5, 1.0, 0.0), (0.0, 0.0, 2.5), 1.5),
        ("ellipsoid", (1.0, 2.0, 3.0), (0.0, 0.0, 0.0), 0.0),
        ("plane", (1.0, 1.0, 0.0), (0.0, 0.0, -1.0), 1.0),
    ],
)
def test_clearance_of_a_solid(
    shape: str, size: tuple[float, float, float], point: tuple[float, float, float], distance: float
) -> None:
    solid = Solid(shape, size, np.array([10.0, 0.0, 0.0]), np.eye(3), "any")  # type: ignore[arg-type]
    assert solid.clearance_m(np.array([point]) + np.array([10.0, 0.0, 0.0])) == pytest.approx(distance)

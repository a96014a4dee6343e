"""One sequence, from a seed to a directory: rig, motion, scene, then frame by frame image and ground truth."""

from __future__ import annotations

import shutil
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from viflow_anomaly.datasets.ground_truth_folder import OBJECT_COLUMNS
from viflow_anomaly.datasets.ground_truth_png import write_depth_png, write_flow_png, write_instances_png
from viflow_anomaly.sensor_data import Float64Array, Uint8Array
from viflow_anomaly.simulator import foliage
from viflow_anomaly.simulator.config import SimulatorConfig
from viflow_anomaly.simulator.drive import drive, park
from viflow_anomaly.simulator.euroc_writer import write_camera, write_imu, write_motor, write_states
from viflow_anomaly.simulator.flight import fly
from viflow_anomaly.simulator.ground_truth import flow_truth, visible_objects
from viflow_anomaly.simulator.imu import measure
from viflow_anomaly.simulator.motion import BodyMotion
from viflow_anomaly.simulator.motor import MotorRecord, record_car, record_drone
from viflow_anomaly.simulator.movers import airborne_movers
from viflow_anomaly.simulator.photometry import draw_photometry
from viflow_anomaly.simulator.rendering import SceneRenderer
from viflow_anomaly.simulator.rigs import Rig, draw_rig
from viflow_anomaly.simulator.road import Road
from viflow_anomaly.simulator.roadside import Layout
from viflow_anomaly.simulator.scene import Scene
from viflow_anomaly.simulator.street import street
from viflow_anomaly.simulator.surroundings import object_materials, open_air, room
from viflow_anomaly.simulator.thin_structures import along_the_road, beside_the_path
from viflow_anomaly.simulator.traffic import Traffic

EPOCH_NS = 1_500_000_000_000_000_000
LEAD_S = 0.5  # of IMU before the first frame and after the last
OBJECT_MATERIALS = 14
# One generator for each concern, so that a draw added to one does not change the others.
STREAMS = {
    name: index
    for index, name in enumerate(
        ("rig", "motion", "movers", "scene", "imu", "camera", "noise", "motor", "thin", "foliage")
    )
}


@dataclass(frozen=True, eq=False)
class World:
    """Everything that a sequence is rendered and written from."""

    rig: Rig
    motion: BodyMotion
    stamps_ns: NDArray[np.int64]
    frame_indices: NDArray[np.int64]
    camera_poses: Float64Array
    scene: Scene

    @property
    def frame_stamps_ns(self) -> NDArray[np.int64]:
        return self.stamps_ns[self.frame_indices]


def _stream(seed: int, name: str) -> np.random.Generator:
    return np.random.default_rng((seed, STREAMS[name]))


def _timeline(config: SimulatorConfig, rig: Rig) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """IMU stamps [N] and the indices of the frames among them [F]."""
    lead = int(LEAD_S * rig.imu_rate_hz)
    stride = rig.imu_rate_hz // rig.frame_rate_hz
    frame_indices = lead + stride * np.arange(config.frames, dtype=np.int64)
    count = int(frame_indices[-1]) + lead + 1
    stamps = EPOCH_NS + np.arange(count, dtype=np.int64) * (1_000_000_000 // rig.imu_rate_hz)
    return stamps, frame_indices


def _move(
    config: SimulatorConfig, seed: int, rig: Rig, times_s: Float64Array
) -> tuple[BodyMotion, Road | None, Float64Array]:
    """The motion, and for a car its road and where it is along it [N]."""
    rng = _stream(seed, "motion")
    moves, rotates = config.motion == "normal", config.motion != "static"
    if config.rig == "drone":
        return fly(rng, times_s, rig.R_vehicle_imu, translates=moves, rotates=rotates), None, times_s
    camera_in_vehicle = rig.R_vehicle_imu @ rig.T_imu_cam[:3, 3]
    motion, road, arc = drive(rng, times_s, rig.R_vehicle_imu, float(camera_in_vehicle[2]))
    if moves:
        return motion, road, arc
    return park(rng, motion, rig.R_vehicle_imu, rotates=rotates), road, np.zeros_like(arc)


def build_world(config: SimulatorConfig, seed: int) -> World:
    """Draw one sequence's rig, motion, movers and surroundings; no GL is needed for that."""
    rig = draw_rig(_stream(seed, "rig"), config)
    stamps, frame_indices = _timeline(config, rig)
    times_s = (stamps - stamps[frame_indices[0]]) * 1e-9
    motion, road, arc = _move(config, seed, rig, times_s)
    camera_poses = motion.poses()[frame_indices] @ rig.T_imu_cam
    rng_movers, rng_scene, rng_thin, rng_leaves = (
        _stream(seed, name) for name in ("movers", "scene", "thin", "foliage")
    )
    count = int(rng_movers.integers(config.movers[0], config.movers[1] + 1))
    materials = object_materials(rng_scene, OBJECT_MATERIALS)
    names = [material.name for material in materials]
    frame_times, camera_path = times_s[frame_indices], camera_poses[:, :3, 3]
    if road is None:
        movers = airborne_movers(rng_movers, count, rig.camera, camera_poses, frame_times, names)
        surroundings = room if rng_scene.random() < 0.7 else open_air
        scene = surroundings(rng_scene, camera_path, movers, materials)
        thin = beside_the_path(rng_thin, config.thin_structures, camera_poses, movers, names)
        trunks, leaves = foliage.beside_the_path(rng_leaves, config.foliage, camera_poses, movers)
    else:
        layout = Layout.draw(rng_scene)
        oncoming = (layout.left_edge * 2 + layout.right_edge) / 3
        arc_at_frames = arc[frame_indices]
        traffic = Traffic(
            rng_movers, road, camera_path, arc_at_frames, frame_times, oncoming, -layout.right_edge, names
        )
        movers = traffic.draw(count)
        scene = street(rng_scene, road, layout, camera_path, movers, materials)
        thin = along_the_road(rng_thin, config.thin_structures, road, layout, arc_at_frames, camera_path, movers, names)
        trunks, leaves = foliage.along_the_road(
            rng_leaves, config.foliage, road, layout, arc_at_frames, camera_path, movers
        )
    scene = replace(scene, solids=(*scene.solids, *thin, *trunks), strips=(*scene.strips, *leaves))
    if leaves:
        scene = replace(scene, materials=(*scene.materials, *foliage.leaf_materials(rng_leaves)))
    return World(rig, motion, stamps, frame_indices, camera_poses, scene)


def record_motor(config: SimulatorConfig, seed: int, world: World) -> MotorRecord:
    """The platform's speed or command at the IMU's rate, from a generator of its own."""
    rng, motion, rig = _stream(seed, "motor"), world.motion, world.rig
    if config.rig == "car":
        R_world_vehicle = motion.R_world_body @ rig.R_vehicle_imu.T
        return record_car(rng, world.stamps_ns, motion.velocities_m_s, R_world_vehicle, errors=config.imu_errors)
    return record_drone(
        rng,
        world.stamps_ns,
        motion.velocities_m_s,
        motion.R_world_body,
        rate_hz=rig.imu_rate_hz,
        errors=config.imu_errors,
    )


def write_sequence(config: SimulatorConfig, seed: int, folder: Path) -> None:
    """Write the sequence of that seed into an empty directory.

    Raises:
        MissingDependencyError: ``mujoco_missing``, ``gl_missing``.
    """
    world = build_world(config, seed)
    record = measure(_stream(seed, "imu"), world.motion, world.rig.imu_errors, world.rig.imu_rate_hz)
    mav0 = folder / "mav0"
    write_camera(mav0, world.rig, world.frame_stamps_ns)
    write_imu(mav0, world.rig, world.stamps_ns, record)
    write_states(mav0, world.stamps_ns, world.motion, record)
    write_motor(mav0, record_motor(config, seed, world))
    with SceneRenderer(world.scene, world.rig.camera, supersampling=config.supersampling) as renderer:
        _write_images(config, seed, world, renderer, mav0)


def _write_images(config: SimulatorConfig, seed: int, world: World, renderer: SceneRenderer, mav0: Path) -> None:
    rng = _stream(seed, "camera")
    times_s = world.motion.times_s[world.frame_indices]
    photometry = draw_photometry(rng, world.rig.camera, _probes(world, renderer), times_s)
    truth = mav0 / "groundtruth0"
    object_rows = [",".join(OBJECT_COLUMNS)]
    if config.ground_truth:
        for name in ("depth", "static_flow", "flow", "instances"):
            (truth / name).mkdir(parents=True)
    for frame, stamp in enumerate(world.frame_stamps_ns.tolist()):
        renderer.place(world.camera_poses[frame], frame)
        noise = np.random.default_rng((seed, STREAMS["noise"], frame))
        image = photometry.develop(renderer.gray(), float(times_s[frame]), noise)
        _save(mav0 / "cam0" / "data" / f"{stamp}.png", image)
        if config.ground_truth:
            object_rows += _write_truth(truth, world, renderer, frame, stamp)
    if config.ground_truth:
        (truth / "objects.csv").write_text("\n".join(object_rows) + "\n", encoding="ascii")


def _probes(world: World, renderer: SceneRenderer) -> list[Uint8Array]:
    """A few frames for the exposure."""
    probes = []
    for frame in sorted({0, len(world.camera_poses) // 2, len(world.camera_poses) - 1}):
        renderer.place(world.camera_poses[frame], frame)
        probes.append(renderer.gray())
    return probes


def _save(path: Path, image: NDArray[Any]) -> None:
    encoded, data = cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, 1])
    assert encoded
    path.write_bytes(data.tobytes())


def _write_truth(truth: Path, world: World, renderer: SceneRenderer, frame: int, stamp: int) -> list[str]:
    """Depth and instances of a frame, its flow to the next, and the rows of objects.csv."""
    depth, instances = renderer.depth_and_instances()
    write_depth_png(truth / "depth" / f"{stamp}.png", depth)
    write_instances_png(truth / "instances" / f"{stamp}.png", instances)
    if frame + 1 == len(world.camera_poses):
        return []
    source, target = world.camera_poses[frame], world.camera_poses[frame + 1]
    flows = flow_truth(world.rig.camera, depth, instances, world.scene.movers, frame, source, target)
    write_flow_png(truth / "static_flow" / f"{stamp}.png", flows.static_flow, flows.static_valid)
    if instances.any():
        write_flow_png(truth / "flow" / f"{stamp}.png", flows.flow, flows.valid)
    else:  # equal without movers, and encoding is what takes the time
        shutil.copyfile(truth / "static_flow" / f"{stamp}.png", truth / "flow" / f"{stamp}.png")
    return [
        f"{stamp},{thing.instance_id},{thing.area_px},{thing.u_min},{thing.v_min},{thing.u_max},{thing.v_max},"
        f"{thing.independent_flow_px:.4f}"
        for thing in visible_objects(instances, flows, len(world.scene.movers))
    ]

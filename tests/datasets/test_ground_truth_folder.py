"""Ground-truth files: round trips, what does not fit, and malformed ones. Needs no simulator."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from viflow_anomaly.config import ImageLimits
from viflow_anomaly.datasets import ground_truth_png
from viflow_anomaly.datasets.ground_truth_folder import (
    OBJECT_COLUMNS,
    GroundTruthFolder,
    MovingObject,
    ground_truth_folder,
)
from viflow_anomaly.datasets.ground_truth_png import (
    read_depth_png,
    read_flow_png,
    write_depth_png,
    write_flow_png,
    write_instances_png,
    write_mask_png,
)
from viflow_anomaly.errors import DatasetError

STAMPS = (1_000_000_000, 1_050_000_000, 1_100_000_000)
SENSOR_YAML = """
T_BS:
  cols: 4
  rows: 4
  data: [1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0]
resolution: [40, 32]
intrinsics: [50.0, 50.0, 20.0, 16.0]
"""


def make_truth(folder: Path) -> Path:
    """A wall 4 m ahead; the camera moves 0.1 m to the right every frame; one mover in the first frame."""
    truth = folder / "mav0" / "groundtruth0"
    for name in ("depth", "static_flow", "flow", "instances"):
        (truth / name).mkdir(parents=True)
    shift = np.zeros((32, 40, 2), np.float32)
    shift[..., 0] = -50.0 * 0.1 / 4.0
    instances = np.zeros((32, 40), np.uint8)
    instances[4:9, 5:11] = 1
    for index, stamp in enumerate(STAMPS):
        write_depth_png(truth / f"depth/{stamp}.png", np.full((32, 40), 4.0, np.float32))
        write_instances_png(truth / f"instances/{stamp}.png", instances)
        if index < 2:
            for name in ("static_flow", "flow"):
                write_flow_png(truth / f"{name}/{stamp}.png", shift, np.ones((32, 40), bool))
    (truth / "objects.csv").write_text(f"{','.join(OBJECT_COLUMNS)}\n{STAMPS[0]},1,30,5,4,10,8,1.5\n")
    for name, text in (
        ("cam0/sensor.yaml", SENSOR_YAML),
        (
            "state_groundtruth_estimate0/data.csv",
            "#timestamp,p,q\n" + "".join(f"{stamp},{0.1 * k},0,0,1,0,0,0\n" for k, stamp in enumerate(STAMPS)),
        ),
    ):
        (folder / "mav0" / name).parent.mkdir()
        (folder / "mav0" / name).write_text(text)
    return folder


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return make_truth(tmp_path / "sequence")


def test_flow_round_trip_is_exact_to_a_128th(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    flow = rng.uniform(-500, 500, (20, 30, 2)).astype(np.float32)
    valid = rng.random((20, 30)) < 0.8
    write_flow_png(tmp_path / "flow.png", flow, valid)
    again, valid_again = read_flow_png(tmp_path / "flow.png")
    np.testing.assert_array_equal(valid_again, valid)
    assert np.abs(again - flow)[valid].max() <= 1 / 128 + 1e-4
    assert not again[~valid].any()
    assert again.dtype == np.float32


def test_flow_png_is_laid_out_as_kitti(tmp_path: Path) -> None:
    flow = np.zeros((4, 4, 2), np.float32)
    flow[1, 2] = (3.0, -2.0)
    write_flow_png(tmp_path / "flow.png", flow, np.ones((4, 4), bool))
    stored = cv2.imread(str(tmp_path / "flow.png"), cv2.IMREAD_UNCHANGED)
    assert stored is not None
    assert stored.dtype == np.uint16
    assert stored[1, 2].tolist() == [1, 2**15 - 128, 2**15 + 192]  # OpenCV's order: B valid, G v, R u
    assert list(tmp_path.iterdir()) == [tmp_path / "flow.png"]


@pytest.mark.parametrize("value", [512.0, -512.1, np.nan, np.inf])
@pytest.mark.parametrize("channel", [0, 1])
def test_flow_that_does_not_fit_is_invalid(tmp_path: Path, value: float, channel: int) -> None:
    flow = np.zeros((4, 4, 2), np.float32)
    flow[1, 2, channel] = value
    write_flow_png(tmp_path / "flow.png", flow, np.ones((4, 4), bool))
    again, valid = read_flow_png(tmp_path / "flow.png")
    assert not valid[1, 2]
    assert valid.sum() == 15
    assert not again.any()


def test_depth_round_trip(tmp_path: Path) -> None:
    depth = np.array([[0.5, 1.2345, 255.9], [np.inf, 300.0, np.nan]], np.float32)
    write_depth_png(tmp_path / "depth.png", depth)
    again = read_depth_png(tmp_path / "depth.png")
    np.testing.assert_allclose(again[0], depth[0], atol=1 / 512)
    assert np.isinf(again[1]).all()
    assert again.dtype == np.float32


@pytest.mark.parametrize("content", [b"", b"not a png", b"\x89PNG\r\n\x1a\n"])
@pytest.mark.parametrize("read", [read_flow_png, read_depth_png])
def test_malformed_pngs_are_named(tmp_path: Path, content: bytes, read: object) -> None:
    assert callable(read)
    path = tmp_path / "broken.png"
    path.write_bytes(content)
    with pytest.raises(DatasetError, match=r"broken\.png") as raised:
        read(path)
    assert raised.value.code == "ground_truth_malformed"


def test_a_png_that_ends_early_is_named(tmp_path: Path) -> None:
    path = tmp_path / "flow.png"
    noise = np.random.default_rng(0).uniform(-9, 9, (64, 64, 2)).astype(np.float32)
    write_flow_png(path, noise, np.ones((64, 64), bool))
    path.write_bytes(path.read_bytes()[:-40])
    with pytest.raises(DatasetError, match="last chunk") as raised:
        read_flow_png(path)
    assert raised.value.code == "ground_truth_malformed"


def test_a_png_that_opencv_refuses_is_named(tmp_path: Path) -> None:
    path = tmp_path / "depth.png"
    write_depth_png(path, np.ones((4, 4), np.float32))
    data = path.read_bytes()
    path.write_bytes(data[:33] + data[-12:])  # header and end, nothing between
    with pytest.raises(DatasetError, match="bytes that are none") as raised:
        read_depth_png(path)
    assert raised.value.code == "ground_truth_malformed"


@pytest.mark.parametrize(("limits", "found"), [({"max_bytes": 50}, "bytes"), ({"max_pixels": 15}, "4x4")])
def test_a_png_beyond_the_limits_is_not_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, limits: dict[str, int], found: str
) -> None:
    monkeypatch.setattr(ground_truth_png, "LIMITS", ImageLimits(**limits))
    write_depth_png(tmp_path / "depth.png", np.ones((4, 4), np.float32))
    with pytest.raises(DatasetError, match=found) as raised:
        read_depth_png(tmp_path / "depth.png")
    assert raised.value.code == "ground_truth_malformed"


def test_pngs_of_the_wrong_kind_are_named(tmp_path: Path, root: Path) -> None:
    write_depth_png(tmp_path / "depth.png", np.ones((4, 4), np.float32))
    with pytest.raises(DatasetError, match="3 channel") as channels:
        read_flow_png(tmp_path / "depth.png")
    assert channels.value.code == "ground_truth_malformed"
    cv2.imwrite(str(tmp_path / "gray.png"), np.ones((4, 4), np.uint8))
    with pytest.raises(DatasetError, match="found 1 of uint8") as depths:
        read_depth_png(tmp_path / "gray.png")
    assert depths.value.code == "ground_truth_malformed"


def test_missing_pngs_are_named(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="cannot read it") as raised:
        read_flow_png(tmp_path / "none.png")
    assert raised.value.code == "ground_truth_missing"


def test_found_at_root_and_mav0_and_nowhere_else(root: Path, tmp_path: Path) -> None:
    for place in (root, root / "mav0"):
        truth = GroundTruthFolder.find(place)
        assert truth is not None
        assert truth.folder == root / "mav0" / "groundtruth0"
    assert GroundTruthFolder.find(tmp_path) is None
    with pytest.raises(DatasetError, match="groundtruth0") as raised:
        GroundTruthFolder(tmp_path)
    assert raised.value.code == "ground_truth_missing"


def test_found_beside_mav0_where_that_has_none(root: Path) -> None:
    """``groundtruth euroc X --out X``, read by both ways."""
    rendered(root)
    beside = root / "groundtruth0"
    assert ground_truth_folder(root) == root / "mav0" / "groundtruth0"
    shutil.rmtree(root / "mav0" / "groundtruth0")
    found = GroundTruthFolder.find(root)
    assert found is not None
    assert found.folder == GroundTruthFolder(root).folder == ground_truth_folder(root) == beside
    assert found.is_rendered


def test_static_flow_of_neighbours_is_the_stored_one(root: Path) -> None:
    flow, valid = GroundTruthFolder(root).static_flow(STAMPS[0], STAMPS[1])
    np.testing.assert_allclose(flow[..., 0], -1.25)
    assert valid.all()


@pytest.mark.parametrize(("source", "target", "expected"), [(0, 2, -2.5), (1, 0, 1.25), (2, 0, 2.5), (1, 1, 0.0)])
def test_static_flow_of_any_two_frames_comes_from_depth_and_poses(
    root: Path, source: int, target: int, expected: float
) -> None:
    flow, valid = GroundTruthFolder(root).static_flow(STAMPS[source], STAMPS[target])
    np.testing.assert_allclose(flow[..., 0], expected, atol=1e-4)
    np.testing.assert_allclose(flow[..., 1], 0.0, atol=1e-4)
    assert valid.all()


def test_static_flow_without_its_png_comes_from_depth(root: Path) -> None:
    (root / f"mav0/groundtruth0/static_flow/{STAMPS[0]}.png").unlink()
    flow, _ = GroundTruthFolder(root).static_flow(STAMPS[0], STAMPS[1])
    np.testing.assert_allclose(flow[..., 0], -1.25, atol=1e-4)


def test_flow_instances_and_objects(root: Path) -> None:
    truth = GroundTruthFolder(root)
    assert truth.flow(STAMPS[0])[0].shape == (32, 40, 2)
    assert truth.instances(STAMPS[0]).sum() == 30
    assert truth.objects(STAMPS[0]) == [MovingObject(STAMPS[0], 1, 30, 5, 4, 10, 8, 1.5)]
    assert truth.objects(STAMPS[2]) == []


@pytest.mark.parametrize("stamp", [STAMPS[0] - 1, STAMPS[0] + 1, STAMPS[2] + 1])
def test_unknown_stamps_are_named(root: Path, stamp: int) -> None:
    with pytest.raises(DatasetError, match=str(stamp)) as raised:
        GroundTruthFolder(root).camera_pose(stamp)
    assert raised.value.code == "ground_truth_missing"


@pytest.mark.parametrize("line", ["1,2,3", "x,0,0,0,1,0,0,0", "1,0,0,a,1,0,0,0"])
def test_malformed_states_are_named_with_their_line(root: Path, line: str) -> None:
    (root / "mav0/state_groundtruth_estimate0/data.csv").write_text(f"#header\n{line}\n")
    with pytest.raises(DatasetError, match="line 2") as raised:
        GroundTruthFolder(root).camera_pose(STAMPS[0])
    assert raised.value.code == "ground_truth_malformed"


@pytest.mark.parametrize("line", ["1,2,3", f"{STAMPS[0]},one,30,5,4,10,8,1.5", f"{STAMPS[0]},1,30,5,4,10,8,much"])
def test_malformed_objects_are_named_with_their_line(root: Path, line: str) -> None:
    (root / "mav0/groundtruth0/objects.csv").write_text(f"header\n{line}\n")
    with pytest.raises(DatasetError, match=r"objects\.csv, line 2") as raised:
        GroundTruthFolder(root).objects(STAMPS[0])
    assert raised.value.code == "ground_truth_malformed"


@pytest.mark.parametrize("content", [b"header\n\xff\xfe\n", b'header\n"' + b"x" * 200_000])
def test_objects_that_are_no_csv_are_named(root: Path, content: bytes) -> None:
    (root / "mav0/groundtruth0/objects.csv").write_bytes(content)
    with pytest.raises(DatasetError, match=r"objects\.csv: expected a CSV") as raised:
        GroundTruthFolder(root).objects(STAMPS[0])
    assert raised.value.code == "ground_truth_malformed"


def test_missing_objects_file_is_named(root: Path) -> None:
    (root / "mav0/groundtruth0/objects.csv").unlink()
    with pytest.raises(DatasetError, match=r"objects\.csv") as raised:
        GroundTruthFolder(root).objects(STAMPS[0])
    assert raised.value.code == "ground_truth_missing"


@pytest.mark.parametrize(
    "text",
    [
        None,
        "a: [",
        "resolution: [4, 4]",
        SENSOR_YAML.replace("[40, 32]", "[40]"),
        SENSOR_YAML.replace("50.0, 50.0,", "fifty, 50.0,"),
        "just text",
        SENSOR_YAML.replace("50.0, 50.0,", "-50.0, 50.0,"),
    ],
)
def test_unusable_calibration_is_named(root: Path, text: str | None) -> None:
    path = root / "mav0/cam0/sensor.yaml"
    path.unlink() if text is None else path.write_text(text)
    with pytest.raises(DatasetError, match=r"sensor\.yaml") as raised:
        _ = GroundTruthFolder(root).camera
    assert raised.value.code == "ground_truth_malformed"


def test_poses_need_the_states_and_the_mounting(root: Path) -> None:
    sensor, states = root / "mav0/cam0/sensor.yaml", root / "mav0/state_groundtruth_estimate0/data.csv"
    sensor.write_text(SENSOR_YAML.replace("data: [1.0,", "data: ["))
    with pytest.raises(DatasetError, match=r"sensor\.yaml: data: expected 16") as malformed:
        GroundTruthFolder(root).camera_pose(STAMPS[0])
    assert malformed.value.code == "ground_truth_malformed"
    sensor.write_text(SENSOR_YAML)
    states.unlink()
    with pytest.raises(DatasetError, match=r"data\.csv: expected the simulated states") as missing:
        GroundTruthFolder(root).camera_pose(STAMPS[0])
    assert missing.value.code == "ground_truth_missing"


def test_opencvs_yaml_and_a_lens_are_read_as_the_recordings(root: Path) -> None:
    lens = "distortion_model: radial-tangential\ndistortion_coefficients: [-0.28, 0.07, 2e-4, 1.8e-5]\n"
    (root / "mav0/cam0/sensor.yaml").write_text("%YAML:1.0" + SENSOR_YAML + lens)
    assert GroundTruthFolder(root).camera.distortion_coeffs == (-0.28, 0.07, 2e-4, 1.8e-5)


def test_camera_of_the_sequence(root: Path) -> None:
    truth = GroundTruthFolder(root)
    camera = truth.camera
    assert (truth.camera_name, truth.is_rendered, truth.has_instances) == ("cam0", False, True)
    assert (camera.fx, camera.cx, camera.width, camera.height) == (50.0, 20.0, 40, 32)


def rendered(folder: Path, record: str | None = None) -> GroundTruthFolder:
    """What was rendered for a recording: camera and poses in the folder; depth of the first frame only, half known."""
    truth = folder / "groundtruth0"
    (truth / "depth").mkdir(parents=True)
    depth = np.full((32, 40), 4.0, np.float32)
    depth[:16] = np.inf
    write_depth_png(truth / f"depth/{STAMPS[0]}.png", depth)
    camera = {"fx": 50.0, "fy": 50.0, "cx": 20.0, "cy": 16.0, "width": 40, "height": 32}
    (truth / "ground_truth.json").write_text(json.dumps({"camera": camera}) if record is None else record)
    (truth / "poses.csv").write_text(
        "#pose\n" + "".join(f"{stamp},{0.1 * k},0,0,1,0,0,0\n" for k, stamp in enumerate(STAMPS))
    )
    return GroundTruthFolder(folder)


@pytest.mark.parametrize(("target", "expected"), [(1, -1.25), (2, -2.5)])
def test_rendered_ground_truth_is_valid_only_where_depth_is_known(tmp_path: Path, target: int, expected: float) -> None:
    flow, valid = rendered(tmp_path).static_flow(STAMPS[0], STAMPS[target])
    assert valid[16:].all()
    assert not valid[:16].any()
    np.testing.assert_allclose(flow[16:, :, 0], expected, atol=1e-4)
    assert not flow[:16].any()


def test_rendered_ground_truth_without_its_poses(tmp_path: Path) -> None:
    truth = rendered(tmp_path)
    assert (truth.camera_name, truth.has_instances) == (None, False)
    (truth.folder / "poses.csv").unlink()
    with pytest.raises(DatasetError, match=r"poses\.csv") as raised:
        truth.camera_pose(STAMPS[0])
    assert raised.value.code == "ground_truth_missing"


def test_the_next_frame_is_the_next_pose_not_the_next_depth(tmp_path: Path) -> None:
    """LiDAR scans belong to every twelfth frame of some drives."""
    truth = rendered(tmp_path)
    stored = np.full((32, 40, 2), 3.0, np.float32)
    (truth.folder / "static_flow").mkdir()
    write_flow_png(truth.folder / f"static_flow/{STAMPS[0]}.png", stored, np.ones((32, 40), bool))
    write_depth_png(truth.folder / f"depth/{STAMPS[2]}.png", np.full((32, 40), 4.0, np.float32))
    assert truth.source_stamps == (STAMPS[0], STAMPS[2])
    assert truth.static_flow(STAMPS[0], STAMPS[1])[0].min() == 3.0
    assert truth.static_flow(STAMPS[0], STAMPS[2])[0].min() == pytest.approx(-2.5, abs=1e-4)


def test_occluded_is_stored_or_comes_from_both_depths(root: Path) -> None:
    truth = GroundTruthFolder(root)
    assert not truth.occluded(STAMPS[0], STAMPS[1]).any()
    near = np.full((32, 40), 4.0, np.float32)
    near[:, 20:] = 2.0
    write_depth_png(truth.folder / f"depth/{STAMPS[1]}.png", near)
    # What goes to columns 19 to 20 is between the two.
    assert truth.occluded(STAMPS[0], STAMPS[1])[:, 22:].all()
    assert not truth.occluded(STAMPS[0], STAMPS[1])[:, :21].any()
    (truth.folder / "occluded").mkdir()
    mask = np.zeros((32, 40), bool)
    mask[3, 4] = True
    write_mask_png(truth.folder / f"occluded/{STAMPS[0]}.png", mask)
    np.testing.assert_array_equal(truth.occluded(STAMPS[0], STAMPS[1]), mask)
    with pytest.raises(DatasetError) as raised:
        truth.occluded(STAMPS[0], STAMPS[2] + 1)
    assert raised.value.code == "ground_truth_missing"


CAMERA = '{"fx": 50.0, "fy": 50.0, "cx": 20.0, "cy": 16.0, "width": 40, "height": 32}'


def test_the_recorded_camera(tmp_path: Path) -> None:
    assert rendered(tmp_path, f'{{"camera": {CAMERA}, "camera_name": "cam1"}}').camera_name == "cam1"


@pytest.mark.parametrize(
    "record",
    [f'{{"camera": {CAMERA}, "camera_name": 1}}', "{}", "[]", "{", '{"camera": {"fx": 1}}', "[" * 100_000, '"camera"'],
)
def test_a_malformed_record_is_named(tmp_path: Path, record: str) -> None:
    truth = rendered(tmp_path, record)
    with pytest.raises(DatasetError, match=r"ground_truth\.json") as raised:
        _ = truth.camera
    assert raised.value.code == "ground_truth_malformed"

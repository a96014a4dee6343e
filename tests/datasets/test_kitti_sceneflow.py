"""Scene flow pairs: which images have an IMU, what the pair and its truth are, and what is said of the others."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from kitti_worlds import FRAME_NS, START_NS, frame_stamps, imu_stamps, write_raw_drive, write_sceneflow
from worlds import textured_image, write_lines

from viflow_anomaly.datasets import kitti_drives, kitti_files
from viflow_anomaly.datasets.kitti_sceneflow import PAPER_WINDOW, KittiSceneFlow
from viflow_anomaly.errors import DatasetError, InvalidInputError
from viflow_anomaly.motion_input import build_motion_window

DRIVE = "2011_09_26_drive_0005"


def line(frame: int, drive: str = DRIVE) -> str:
    return f"2011_09_26 {drive}_sync {frame:010d}"


@pytest.fixture
def root(tmp_path: Path) -> Path:
    write_raw_drive(tmp_path / "raw_data", DRIVE)
    return write_sceneflow(tmp_path / "data_scene_flow", [line(2), "", line(4)])


def expect(root: Path, code: str, where: str) -> None:
    with pytest.raises(DatasetError) as caught:
        KittiSceneFlow(root)
    assert caught.value.code == code
    assert where in caught.value.message


def test_images_with_a_drive_and_continuous_imu(root: Path) -> None:
    flows = KittiSceneFlow(root)
    assert len(flows) == 2
    assert [flows.number(k) for k in range(2)] == [0, 2]
    assert [flows.sequence(k) for k in range(2)] == [DRIVE] * 2
    assert flows.excluded == {"no_raw_drive": 1}


def test_a_pair_is_both_images_and_what_was_recorded_around_them(root: Path) -> None:
    flows = KittiSceneFlow(root)
    pair = flows.pair(1)
    assert (pair.source.timestamp_ns, pair.target.timestamp_ns) == tuple(frame_stamps(6)[4:])
    np.testing.assert_array_equal(pair.source.image, textured_image(96, 64, seed=30))
    np.testing.assert_array_equal(pair.target.image, textured_image(96, 64, seed=31))
    assert pair.camera is not None
    assert pair.camera.fx == 82
    nearest = int(np.argmin(np.abs(imu_stamps(9) - pair.source.timestamp_ns)))
    np.testing.assert_allclose(pair.motor_command, [nearest / 10])
    window = build_motion_window(pair, PAPER_WINDOW)
    assert window.values.shape == (20, 6)
    assert window.faults == ()
    anchor = int(np.searchsorted(pair.imu.timestamps_ns, pair.source.timestamp_ns - 1_000_000))
    rows = slice(anchor - 10, anchor + 10)
    np.testing.assert_array_equal(window.values[:, :3], pair.imu.gyro_rad_s[rows].astype(np.float32))


def test_mounting_of_the_day_and_of_the_pair(root: Path) -> None:
    of_the_day = KittiSceneFlow(root).pair(0).camera
    assert of_the_day is not None
    assert of_the_day.T_cam_imu is not None
    # imu (1, 2, 3) -> velodyne -> (-1.9, -2.8, 1.3) in camera 0; camera 2 lies 8 / 80 m beside it.
    np.testing.assert_allclose(of_the_day.T_cam_imu[:3, 3], (-1.8, -2.8, 1.3))
    write_lines(root / "training/calib_imu_to_velo/000000.txt", ["R: 1 0 0 0 1 0 0 0 1", "T: 1 0 3"])
    own = KittiSceneFlow(root).pair(0).camera
    assert own is not None
    assert own.T_cam_imu is not None
    np.testing.assert_allclose(own.T_cam_imu[:3, 3], (0.2, -2.8, 1.3))
    shutil.rmtree(root / "training" / "calib_cam_to_cam")
    assert KittiSceneFlow(root).pair(0).camera is None


def test_truth(root: Path) -> None:
    flow, valid = KittiSceneFlow(root).truth(1)
    assert flow.shape == (64, 96, 2)
    assert not valid[10:20, 10:30].any()
    assert valid.sum() == 64 * 96 - 200
    np.testing.assert_array_equal(flow[valid], np.broadcast_to((4.5, 1.0), (valid.sum(), 2)))
    assert not KittiSceneFlow(root, flow="noc").truth(1)[1].any()


def test_truth_is_read_as_kitti_writes_it(root: Path) -> None:
    # Channels R, G, B are u, v, valid; the value of a component is 64 * flow + 2^15.
    image = np.zeros((64, 96, 3), np.uint16)
    image[5, 7] = (1, 2**15 - 64 * 3, 2**15 + 32)  # OpenCV's order: B, G, R
    assert cv2.imwrite(str(root / "training/flow_occ/000000_10.png"), image)
    flow, valid = KittiSceneFlow(root).truth(0)
    assert np.argwhere(valid).tolist() == [[5, 7]]
    assert flow[5, 7].tolist() == [0.5, -3.0]


def test_moving_objects(root: Path) -> None:
    moving = KittiSceneFlow(root).moving(0)
    assert moving[12, 12] == 1
    assert (moving > 0).sum() == 200
    path = root / "training/obj_map/000000_10.png"
    for broken in (b"", b"x", path.with_name("000002_10.png").read_bytes()[:40]):
        path.write_bytes(broken)
        with pytest.raises(DatasetError, match=r"000000_10\.png") as caught:
            KittiSceneFlow(root).moving(0)
        assert caught.value.code == "ground_truth_malformed"
    path.unlink()
    with pytest.raises(DatasetError, match=r"000000_10\.png") as caught:
        KittiSceneFlow(root).moving(0)
    assert caught.value.code == "ground_truth_missing"


@pytest.mark.parametrize(("image", "dtype"), [((64, 96, 3), np.uint8), ((64, 96), np.uint16)])
def test_a_map_of_objects_in_another_format(image: tuple[int, ...], dtype: type, root: Path) -> None:
    assert cv2.imwrite(str(root / "training/obj_map/000000_10.png"), np.zeros(image, dtype))
    with pytest.raises(DatasetError, match=r"1 channel\(s\) of uint8") as caught:
        KittiSceneFlow(root).moving(0)
    assert caught.value.code == "ground_truth_malformed"


def test_a_drives_lists_are_read_once(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    listed: list[str] = []
    for name in ("numbered_files", "read_stamps"):
        for module in (kitti_files, kitti_drives):
            if hasattr(module, name):
                monkeypatch.setattr(module, name, counted(getattr(module, name), listed))
    assert len(KittiSceneFlow(root)) == 2
    extract, sync = (f"{DRIVE}_{kind}" for kind in ("extract", "sync"))
    assert sorted(listed) == [
        f"{extract}/oxts/data",
        f"{extract}/oxts/timestamps.txt",
        f"{sync}/image_02/timestamps.txt",
    ]


def counted(read: Callable[..., object], paths: list[str]) -> Callable[..., object]:
    def reading(path: Path, *arguments: object) -> object:
        paths.append("/".join(path.parts[-3:]))
        return read(path, *arguments)

    return reading


def test_reasons_are_counted(tmp_path: Path) -> None:
    stamps = imu_stamps(20)
    stamps[120] = stamps[119]  # 0.7 s after the first frame: around frames 6 and 7
    order = np.arange(stamps.size)
    order[[161, 162]] = order[[162, 161]]  # 1.1 s: around frames 10 and 11
    keep = np.delete(order, range(190, 196))  # 1.4 to 1.5 s: around frames 13 and 14
    write_raw_drive(tmp_path / "raw_data", DRIVE, frames=20, stamps=stamps[keep])
    mapping = [line(2), "", line(6), line(10), line(13), line(16), line(3, "2011_09_26_drive_0099"), line(19), line(55)]
    flows = KittiSceneFlow(write_sceneflow(tmp_path / "data", mapping))
    assert [flows.number(k) for k in range(len(flows))] == [0, 5]
    assert flows.excluded == {
        "no_raw_drive": 1,
        "imu_duplicate_timestamps": 1,
        "imu_unsorted": 1,
        "imu_window_count": 1,
        "kitti_raw_missing": 1,
        "timestamps_missing": 2,
    }


def test_an_imu_that_ends_before_the_image(tmp_path: Path) -> None:
    write_raw_drive(tmp_path / "raw_data", DRIVE, stamps=imu_stamps(9)[:80])  # up to 0.3 s after the first frame
    flows = KittiSceneFlow(write_sceneflow(tmp_path / "data", [line(1), line(7)]))
    assert flows.excluded == {"imu_not_covering": 1}


def test_raw_data_may_be_elsewhere(root: Path, tmp_path: Path) -> None:
    elsewhere = (tmp_path / "raw_data").rename(tmp_path / "disk")
    assert len(KittiSceneFlow(root, raw_data=elsewhere)) == 2
    expect(root, "kitti_raw_missing", str(root / "raw_data"))
    elsewhere.rename(root / "raw_data")
    assert len(KittiSceneFlow(root)) == 2


def test_the_mapping_may_lie_beside_training(root: Path) -> None:
    (root / "devkit" / "mapping").rename(root / "mapping")
    assert len(KittiSceneFlow(root)) == 2
    shutil.rmtree(root / "mapping")
    expect(root, "file_missing", "devkit/mapping/train_mapping.txt")


@pytest.mark.parametrize(
    "text",
    [
        "2011_09_26 2011_09_26_drive_0005_sync",
        "2011_09_28 2011_09_26_drive_0005_sync 0000000059",
        "2011_09_26 2011_09_26_drive_0005_extract 0000000059",
        "2011_09_26 2011_09_26_drive_0005_sync 59",
    ],
)
def test_mapping_malformed(text: str, root: Path) -> None:
    write_lines(root / "devkit/mapping/train_mapping.txt", [line(2), text, line(4)])
    expect(root, "mapping_malformed", "train_mapping.txt, line 2: expected 2011_09_26")


def test_a_mapping_that_is_too_short(root: Path) -> None:
    write_lines(root / "devkit/mapping/train_mapping.txt", [line(2)])
    expect(root, "mapping_malformed", "expected a line for image 000002, found 1 lines")


def test_a_last_line_that_is_empty(root: Path) -> None:
    (root / "devkit/mapping/train_mapping.txt").write_text(f"{line(2)}\n{line(4)}\n")
    assert KittiSceneFlow(root).excluded == {"no_raw_drive": 1}


def test_no_usable_pair(root: Path) -> None:
    write_lines(root / "devkit/mapping/train_mapping.txt", ["", "", ""])
    expect(root, "no_usable_pairs", "{'no_raw_drive': 3}")


def test_no_images(root: Path) -> None:
    shutil.rmtree(root / "training" / "image_2")
    expect(root, "no_frames", "image_2")


def test_a_broken_record_is_an_error_not_a_reason(root: Path, tmp_path: Path) -> None:
    folder = tmp_path / "raw_data/2011_09_26" / f"{DRIVE}_extract/oxts/data"
    (folder / "0000000070.txt").write_text("1 2 3")
    expect(root, "oxts_malformed", "0000000070.txt, line 1: expected 30 numbers, found 3")


def test_a_missing_or_broken_image(root: Path) -> None:
    flows = KittiSceneFlow(root)
    target = root / "training/image_2/000000_11.png"
    target.write_bytes(b"x")
    with pytest.raises(InvalidInputError):
        flows.pair(0)
    target.unlink()
    with pytest.raises(DatasetError, match=r"000000_11\.png") as caught:
        flows.pair(0)
    assert caught.value.code == "image_missing"
    assert len(flows) == 2


def test_outside_is_an_index_error(root: Path) -> None:
    flows = KittiSceneFlow(root)
    for read in (flows.pair, flows.truth, flows.sequence, flows.moving):
        with pytest.raises(IndexError):
            read(2)


def test_stamps_are_of_the_sync_drive(root: Path) -> None:
    assert KittiSceneFlow(root).pair(0).source.timestamp_ns == START_NS + 2 * FRAME_NS

"""Pictures: even sides, colours where the boxes are, one size a recording; videos appear whole or not at all."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from viflow_anomaly import drawing
from viflow_anomaly.detection import (
    OWN_VELOCITY_NAMES,
    AnalyzedRegion,
    Detection,
    ImageSize,
    ModelInfo,
    Reason,
    ResidualSummary,
    Roi,
)
from viflow_anomaly.drawing import OverlayVideo, draw_overlay, draw_thumbnail
from viflow_anomaly.errors import InvalidInputError, MissingDependencyError
from viflow_anomaly.regions import BoundingBox, RegionLabel

TITLE_PX = drawing.LINE_HEIGHT_PX + 4


def make_roi(x: int, y: int, width: int, height: int, *, label: RegionLabel = "independent_motion") -> Roi:
    return Roi(1, label, 0.8, BoundingBox(x, y, width, height), width, height, width * height, 5.0, 30.0, 60.0)


def make_detection(width: int, height: int, *rois: Roi) -> Detection:
    return Detection(
        source_timestamp_ns=1_000_000_000,
        target_timestamp_ns=1_050_000_000,
        image=ImageSize(width, height),
        status="ok",
        reasons=(),
        model=ModelInfo("compact", "0.1.0", "ab" * 32),
        rois=rois,
        region_analyzed=AnalyzedRegion(0, 0, width, height),
        residual=ResidualSummary(1.0, 1.0, 2.0),
    )


def draw(detection: Detection, *, residual: np.ndarray | None = None, gray: int = 128) -> np.ndarray:
    size = (detection.image.height, detection.image.width)
    if residual is None:
        residual = np.zeros(size, np.float32)
    return draw_overlay(np.full(size, gray, np.uint8), detection, residual=residual)


def has_color(picture: np.ndarray, color: tuple[int, int, int]) -> bool:
    return bool((picture == np.array(color)).all(axis=-1).any())


@pytest.mark.parametrize(
    ("size", "panel", "stacked"),
    [
        ((224, 224), (672, 672), False),
        ((752, 480), (752, 480), False),
        ((1242, 375), (1242, 375), True),
        ((400, 120), (1200, 360), True),
        ((3200, 2400), (1600, 1200), False),
        ((33, 35), (660, 700), False),
    ],
)
def test_small_images_grow_huge_ones_shrink_wide_ones_stack(
    size: tuple[int, int], panel: tuple[int, int], stacked: bool
) -> None:
    picture = draw(make_detection(*size))
    height, width, channels = picture.shape
    assert (picture.dtype, channels) == (np.uint8, 3)
    assert height % 2 == width % 2 == 0
    columns, rows = (1, 2) if stacked else (2, 1)
    assert columns * panel[0] <= width <= columns * panel[0] + 5
    assert rows * (panel[1] + TITLE_PX) < height < rows * (panel[1] + TITLE_PX) + 80


def test_motion_is_a_solid_vermillion_box_and_model_error_a_dashed_blue_one() -> None:
    roi = make_roi(100, 200, 300, 100)
    motion = draw(make_detection(752, 480, roi))[TITLE_PX:, :752]
    error = draw(make_detection(752, 480, replace(roi, label="model_error")))[TITLE_PX:, :752]
    assert (motion[200:300, 100] == drawing.VERMILLION).all()
    edge = error[200:300, 100]
    blue, dark = (edge == drawing.SKY_BLUE).all(axis=1), (edge == drawing.DARK_BLUE).all(axis=1)
    assert (blue | dark).all()
    assert blue.any()
    assert dark.any()
    assert not has_color(error, drawing.VERMILLION)


def test_boxes_grow_with_the_picture() -> None:
    picture = draw(make_detection(224, 224, make_roi(50, 100, 20, 30)))[TITLE_PX:, :672]
    assert (picture[300:390, 150] == drawing.VERMILLION).all()
    assert (picture[300:390, 209] == drawing.VERMILLION).all()


@pytest.mark.parametrize("corner", [(0, 0), (740, 0), (0, 470), (740, 470)])
def test_labels_stay_inside_the_picture(corner: tuple[int, int]) -> None:
    panel = draw(make_detection(752, 480, make_roi(*corner, 10, 10)))[TITLE_PX : TITLE_PX + 480, :752]
    ys, xs = np.nonzero((panel == np.array(drawing.VERMILLION)).all(axis=-1))
    assert ys.size > 500
    assert np.ptp(xs) > 60


def test_a_track_is_named() -> None:
    roi = make_roi(100, 200, 300, 100)
    plain = draw(make_detection(752, 480, roi))
    tracked = draw(make_detection(752, 480, replace(roi, track_id=12)))
    assert (plain != tracked).any()


def tracked_roi(*velocity_px_s: float, label: RegionLabel = "independent_motion") -> Roi:
    roi = make_roi(300, 200, 41, 41, label=label)
    return replace(roi, track_id=12, evidence=dict(zip(OWN_VELOCITY_NAMES, velocity_px_s, strict=True)))


def test_an_arrow_shows_where_a_tracked_thing_goes_by_itself() -> None:
    panel = draw(make_detection(752, 480, tracked_roi(400.0, -200.0)))[TITLE_PX : TITLE_PX + 480, :752]
    ys, xs = np.nonzero((panel == np.array(drawing.YELLOW)).all(axis=-1))
    assert xs.min() == pytest.approx(320, abs=3)  # the middle of the box
    assert xs.max() == pytest.approx(420, abs=3)  # a quarter of a second later
    assert ys[xs == xs.min()].mean() == pytest.approx(220, abs=3)
    assert ys[xs == xs.max()].mean() == pytest.approx(170, abs=3)


@pytest.mark.parametrize("roi", [tracked_roi(4.0, 4.0), tracked_roi(90.0, 0.0, label="model_error")])
def test_what_hardly_moves_or_is_no_motion_has_no_arrow(roi: Roi) -> None:
    assert not has_color(draw(make_detection(752, 480, roi)), drawing.YELLOW)


def test_the_residual_is_drawn_to_a_fixed_scale() -> None:
    residual = np.zeros((480, 752), np.float32)
    residual[100:200, 100:200] = drawing.HEAT_MAX_GRAY / 2
    residual[100:200, 300:400] = drawing.HEAT_MAX_GRAY
    residual[100:200, 500:600] = 255
    heat = draw(make_detection(752, 480), residual=residual)[TITLE_PX:, 756:]
    dark, half, full, beyond = (heat[150, u].astype(int).sum() for u in (50, 150, 350, 550))
    assert dark < half < full == beyond


@pytest.mark.parametrize("residual", [None, np.zeros((0, 0), np.float32)])
def test_without_a_residual_the_picture_keeps_its_size(residual: np.ndarray | None) -> None:
    detection = make_detection(752, 480)
    picture = draw_overlay(np.zeros((480, 752), np.uint8), detection, residual=residual)
    assert picture.shape == draw(detection).shape


def test_what_the_model_did_not_see_is_dimmed() -> None:
    detection = replace(make_detection(752, 480), region_analyzed=AnalyzedRegion(264, 128, 224, 224))
    panel = draw(detection, gray=120)[TITLE_PX : TITLE_PX + 480, :752]
    assert (panel[128:352, 264:488] == 120).all()
    assert (panel[:128] == 40).all()
    assert (panel[:, 488:] == 40).all()


def test_abstaining_is_written_over_the_image() -> None:
    detection = make_detection(752, 480)
    abstained = replace(detection, status="abstained", residual=None, reasons=(Reason("imu_accel_zero", "Zero."),))
    panel = draw(abstained)[TITLE_PX : TITLE_PX + 480, :752]
    assert has_color(panel, drawing.YELLOW)
    assert not has_color(draw(detection)[TITLE_PX : TITLE_PX + 480, :752], drawing.YELLOW)


def test_all_pictures_of_a_recording_have_one_size() -> None:
    detection = make_detection(224, 224)
    long = Reason("imu_gap", "A very long sentence about a gap, " * 20 + "\N{DEGREE SIGN}")
    pictures = [draw(replace(detection, reasons=(long,) * count)) for count in (0, 1, 2, 5)]
    assert len({picture.shape for picture in pictures}) == 1
    assert not np.array_equal(pictures[1], pictures[3])


class TestOverlayVideo:
    @staticmethod
    def picture(gray: int, *, width: int = 96, height: int = 64) -> np.ndarray:
        return np.full((height, width, 3), gray, np.uint8)

    def test_the_pictures_come_back_in_order(self, tmp_path: Path) -> None:
        path = tmp_path / "overlay.mp4"
        with OverlayVideo(path, frames_per_second=5.0) as video:
            for gray in (20, 120, 220):
                video.write(self.picture(gray))
            assert not path.exists()
        assert [file.name for file in tmp_path.iterdir()] == ["overlay.mp4"]
        capture = cv2.VideoCapture(str(path))
        assert capture.get(cv2.CAP_PROP_FPS) == pytest.approx(5.0)
        means = []
        while (frame := capture.read()[1]) is not None:
            means.append(float(frame.mean()))
        capture.release()
        assert means == [pytest.approx(gray, abs=8) for gray in (20, 120, 220)]

    def test_odd_sides_are_padded(self, tmp_path: Path) -> None:
        with OverlayVideo(tmp_path / "odd.mp4") as video:
            video.write(self.picture(50, width=97, height=65))
        capture = cv2.VideoCapture(str(tmp_path / "odd.mp4"))
        assert capture.get(cv2.CAP_PROP_FRAME_WIDTH) == 98
        assert capture.get(cv2.CAP_PROP_FRAME_HEIGHT) == 66
        capture.release()

    def test_an_error_leaves_no_file_and_the_old_video(self, tmp_path: Path) -> None:
        path = tmp_path / "overlay.mp4"
        path.write_bytes(b"old")
        video = OverlayVideo(path)
        video.write(self.picture(20))
        video.__exit__(KeyError, KeyError("something else"), None)
        assert [file.name for file in tmp_path.iterdir()] == ["overlay.mp4"]
        assert path.read_bytes() == b"old"

    def test_no_pictures_no_file(self, tmp_path: Path) -> None:
        with OverlayVideo(tmp_path / "overlay.mp4"):
            pass
        assert list(tmp_path.iterdir()) == []

    @pytest.mark.parametrize("size", [(98, 64), (96, 66)])
    def test_pictures_of_another_size(self, tmp_path: Path, size: tuple[int, int]) -> None:
        with OverlayVideo(tmp_path / "v.mp4") as video:
            video.write(self.picture(20))
            with pytest.raises(InvalidInputError, match="96x64") as caught:
                video.write(self.picture(20, width=size[0], height=size[1]))
        assert caught.value.code == "video_frame_size"

    def test_a_missing_codec_is_named(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        class ClosedWriter:
            def __init__(self, *_: object) -> None: ...

            @staticmethod
            def fourcc(*_: str) -> int:
                return 0

            @staticmethod
            def isOpened() -> bool:
                return False

        monkeypatch.setattr(cv2, "VideoWriter", ClosedWriter)
        with pytest.raises(MissingDependencyError, match="FFmpeg") as caught, OverlayVideo(tmp_path / "v.mp4") as video:
            video.write(self.picture(20))
        assert caught.value.code == "video_codec_missing"
        assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("size", "expected"), [((800, 400), (320, 160)), ((100, 500), (64, 320)), ((96, 64), (96, 64))]
)
def test_a_thumbnail_is_small_and_has_the_boxes_alone(size: tuple[int, int], expected: tuple[int, int]) -> None:
    width, height = size
    detection = make_detection(width, height, make_roi(width // 4, height // 4, width // 2, height // 2))
    picture = draw_thumbnail(np.full((height, width), 128, dtype=np.uint8), detection, longest_side_px=320)
    assert picture.shape == (expected[1], expected[0], 3)
    assert has_color(picture, drawing.VERMILLION)

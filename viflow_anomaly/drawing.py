"""Pictures of a detection that a person can judge at a glance, and videos of them. Everything is [H, W, 3] BGR uint8.

One picture: the source image in gray with its boxes, the residual map beside it (below it for wide images), a caption.
The colours are Okabe and Ito's, told apart by colour-blind readers too, and the line style says the same again:
independent motion is a solid vermillion box with label and score, model error a thin dashed blue one.
"""

from __future__ import annotations

from pathlib import Path
from types import TracebackType
from typing import NamedTuple, Self

import cv2
import numpy as np
from numpy.typing import NDArray

from viflow_anomaly.detection import OWN_VELOCITY_NAMES, Detection, Roi
from viflow_anomaly.errors import InvalidInputError, MissingDependencyError
from viflow_anomaly.geometry import Float32Array
from viflow_anomaly.sensor_data import Uint8Array

Color = tuple[int, int, int]
Picture = NDArray[np.uint8]

VERMILLION: Color = (0, 94, 213)
SKY_BLUE: Color = (233, 180, 86)
DARK_BLUE: Color = (110, 60, 0)
YELLOW: Color = (66, 228, 240)
WHITE: Color = (255, 255, 255)
LIGHT_GRAY: Color = (190, 190, 190)
BACKGROUND: Color = (24, 24, 24)

MIN_PANEL_WIDTH_PX = 640
MIN_WIDE_PANEL_WIDTH_PX = 960
MAX_PANEL_WIDTH_PX = 1600
WIDE_ASPECT_RATIO = 2.0
HEAT_MAX_GRAY = 80.0
"""Fixed, so that pictures of one recording can be compared; brighter residuals saturate."""
FONT = cv2.FONT_HERSHEY_SIMPLEX
FONT_SCALE = 0.5
LINE_HEIGHT_PX = 22
MARGIN_PX = 8
DASH_PX = 6
ARROW_S = 0.25
"""The arrow of a tracked thing shows its own way in this time."""
MIN_ARROW_PX = 3.0
CAPTION_LINES = 3
"""Always as many, so that all pictures of a recording have one size."""


class _Scale(NamedTuple):
    """Source pixels -> picture pixels."""

    x: float
    y: float

    def corners(self, x: int, y: int, width: int, height: int) -> tuple[tuple[int, int], tuple[int, int]]:
        """Left-top and right-bottom picture pixel of a box in source pixels."""
        left_top = round(x * self.x), round(y * self.y)
        return left_top, (round((x + width) * self.x) - 1, round((y + height) * self.y) - 1)


def draw_overlay(source: Uint8Array, detection: Detection, *, residual: Float32Array | None) -> Picture:
    """Source with boxes, residual map and caption in one picture.

    Args:
        source: [H, W] uint8 gray image I_i.
        detection: made from it.
        residual: [H, W] gray levels, or None when none was computed.

    Returns:
        BGR picture with even sides (video codecs want them).
    """
    height, width = source.shape
    stacked = width > WIDE_ASPECT_RATIO * height
    size = _panel_size(width, height, MIN_WIDE_PANEL_WIDTH_PX if stacked else MIN_PANEL_WIDTH_PX)
    scale = _Scale(size[0] / width, size[1] / height)
    panels = [
        np.vstack([_source_title(size[0], detection), _source_panel(source, detection, size, scale)]),
        np.vstack([_heat_title(size[0]), _heat_panel(residual, detection, size, scale)]),
    ]
    body = np.vstack(panels) if stacked else np.hstack(_with_gap(panels))
    picture = np.vstack([body, _caption(body.shape[1], detection)])
    return _with_even_sides(picture)


def draw_thumbnail(source: Uint8Array, detection: Detection, *, longest_side_px: int) -> Picture:
    """The source with its boxes alone, for lists; never larger than the source.

    Args:
        source: [H, W] uint8 gray image I_i.
        detection: made from it.
    """
    height, width = source.shape
    factor = min(1.0, longest_side_px / max(width, height))
    size = max(1, round(width * factor)), max(1, round(height * factor))
    scale = _Scale(size[0] / width, size[1] / height)
    picture = np.repeat(_resized(source, size)[:, :, None], 3, axis=2)
    for roi in sorted(detection.rois, key=lambda roi: (roi.label == "independent_motion", roi.score)):
        _draw_box(picture, roi, scale)
    return picture


def _panel_size(width: int, height: int, min_width: int) -> tuple[int, int]:
    """Small images grow by a whole factor (every pixel stays a square), huge ones shrink to the maximum."""
    if width > MAX_PANEL_WIDTH_PX:
        return MAX_PANEL_WIDTH_PX, max(1, round(height * MAX_PANEL_WIDTH_PX / width))
    factor = -(-min_width // width)
    return factor * width, factor * height


def _with_gap(panels: list[Picture]) -> list[Picture]:
    gap = np.full((panels[0].shape[0], 4, 3), BACKGROUND, dtype=np.uint8)
    return [panels[0], gap, panels[1]]


def _source_panel(source: Uint8Array, detection: Detection, size: tuple[int, int], scale: _Scale) -> Picture:
    panel = np.repeat(_resized(source, size)[:, :, None], 3, axis=2)
    part = detection.region_analyzed
    (left, top), (right, bottom) = scale.corners(part.x, part.y, part.width, part.height)
    analyzed = np.zeros(panel.shape[:2], dtype=np.bool_)
    analyzed[top : bottom + 1, left : right + 1] = True
    panel[~analyzed] //= 3
    for draw in (_draw_box, _draw_arrow, _draw_label):
        for roi in sorted(detection.rois, key=lambda roi: (roi.label == "independent_motion", roi.score)):
            draw(panel, roi, scale)
    if detection.status == "abstained":
        _draw_tag(panel, "ABSTAINED: not judged", (MARGIN_PX, MARGIN_PX + LINE_HEIGHT_PX), fill=YELLOW, ink=(0, 0, 0))
    return panel


def _heat_panel(residual: Float32Array | None, detection: Detection, size: tuple[int, int], scale: _Scale) -> Picture:
    if residual is None or not residual.size:
        panel = np.full((size[1], size[0], 3), BACKGROUND, dtype=np.uint8)
        _put_text(panel, "no residual was computed", (MARGIN_PX, 2 * LINE_HEIGHT_PX), LIGHT_GRAY)
        return panel
    levels = np.clip(residual * np.float32(255.0 / HEAT_MAX_GRAY), 0, 255).astype(np.uint8)
    panel = np.asarray(cv2.applyColorMap(_resized(levels, size), cv2.COLORMAP_INFERNO), dtype=np.uint8)
    for roi in detection.rois:
        if roi.label == "independent_motion":
            cv2.rectangle(panel, *scale.corners(*roi.bbox), WHITE, 1)
    return panel


def _resized(image: Uint8Array, size: tuple[int, int]) -> Uint8Array:
    """Enlarged without inventing detail, shrunk without aliasing."""
    shrinks = size[0] < image.shape[1]
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_NEAREST), np.uint8)


def _draw_box(panel: Picture, roi: Roi, scale: _Scale) -> None:
    left_top, right_bottom = scale.corners(*roi.bbox)
    if roi.label == "model_error":
        _draw_dashed_box(panel, left_top, right_bottom)
    else:
        cv2.rectangle(panel, left_top, right_bottom, VERMILLION, 2)


def _draw_label(panel: Picture, roi: Roi, scale: _Scale) -> None:
    """Above the box, or below it at the image's upper edge."""
    if roi.label == "model_error":
        return
    (left, top), (_, bottom) = scale.corners(*roi.bbox)
    y = top - 2 if top > LINE_HEIGHT_PX else bottom + LINE_HEIGHT_PX
    track = "" if roi.track_id is None else f"#{roi.track_id} "
    _draw_tag(panel, f"{track}motion {roi.score:.2f}", (left - 1, y), fill=VERMILLION, ink=WHITE)


def _draw_arrow(panel: Picture, roi: Roi, scale: _Scale) -> None:
    """Where a tracked thing would be in ``ARROW_S`` over a world that rests, from the middle of its box."""
    velocity = [roi.evidence.get(name) for name in OWN_VELOCITY_NAMES]
    if roi.label == "model_error" or not all(isinstance(value, (int, float)) for value in velocity):
        return
    u, v = roi.bbox.middle_px
    x, y = (u + 0.5) * scale.x, (v + 0.5) * scale.y
    right, down = (float(value or 0.0) * ARROW_S * factor for value, factor in zip(velocity, scale, strict=True))
    if float(np.hypot(right, down)) >= MIN_ARROW_PX:
        tip = round(x + right), round(y + down)
        cv2.arrowedLine(panel, (round(x), round(y)), tip, YELLOW, 2, tipLength=0.3)


def _draw_dashed_box(panel: Picture, left_top: tuple[int, int], right_bottom: tuple[int, int]) -> None:
    cv2.rectangle(panel, left_top, right_bottom, DARK_BLUE, 1)  # between the dashes, for bright surroundings
    (left, top), (right, bottom) = left_top, right_bottom
    for x in range(left, right + 1, 2 * DASH_PX):
        for y in (top, bottom):
            cv2.line(panel, (x, y), (min(x + DASH_PX, right), y), SKY_BLUE, 1)
    for y in range(top, bottom + 1, 2 * DASH_PX):
        for x in (left, right):
            cv2.line(panel, (x, y), (x, min(y + DASH_PX, bottom)), SKY_BLUE, 1)


def _draw_tag(panel: Picture, text: str, left_bottom: tuple[int, int], *, fill: Color, ink: Color) -> None:
    """Text on a filled box, moved inside the panel where it would stick out."""
    (width, height), baseline = cv2.getTextSize(text, FONT, FONT_SCALE, 1)
    box_width, box_height = width + 6, height + baseline + 3
    x = max(0, min(left_bottom[0], panel.shape[1] - box_width))
    y = max(box_height, min(left_bottom[1], panel.shape[0] - 1))
    cv2.rectangle(panel, (x, y - box_height), (x + box_width, y), fill, cv2.FILLED)
    _put_text(panel, text, (x + 3, y - baseline), ink)


def _put_text(panel: Picture, text: str, left_bottom: tuple[int, int], ink: Color) -> None:
    """One line, cut with dots where the panel ends. Hershey fonts know ASCII only."""
    line = text.encode("ascii", "replace").decode("ascii")
    room_px = panel.shape[1] - left_bottom[0] - 2
    while len(line) > 4 and cv2.getTextSize(line, FONT, FONT_SCALE, 1)[0][0] > room_px:
        line = line.removesuffix("...")[:-1] + "..."
    cv2.putText(panel, line, left_bottom, FONT, FONT_SCALE, ink, 1, cv2.LINE_AA)


def _strip(width: int, lines: int) -> Picture:
    return np.full((lines * LINE_HEIGHT_PX + 4, width, 3), BACKGROUND, dtype=np.uint8)


def _source_title(width: int, detection: Detection) -> Picture:
    """What the two kinds of boxes mean, with their numbers."""
    strip = _strip(width, 1)
    moving = sum(roi.label == "independent_motion" for roi in detection.rois)
    cv2.rectangle(strip, (MARGIN_PX, 6), (MARGIN_PX + 22, 19), VERMILLION, 2)
    _put_text(strip, f"independent motion: {moving}", (MARGIN_PX + 30, 18), WHITE)
    middle = MARGIN_PX + 240
    _draw_dashed_box(strip, (middle, 6), (middle + 22, 19))
    _put_text(strip, f"model error: {len(detection.rois) - moving}", (middle + 30, 18), WHITE)
    return strip


def _heat_title(width: int) -> Picture:
    """What the heat map shows, and its scale."""
    strip = _strip(width, 1)
    _put_text(strip, "residual, gray levels", (MARGIN_PX, 18), WHITE)
    left, right = width - 230, width - 70
    ramp = np.tile(np.linspace(0, 255, right - left).astype(np.uint8), (12, 1))
    strip[7:19, left:right] = cv2.applyColorMap(ramp, cv2.COLORMAP_INFERNO)
    _put_text(strip, "0", (left - 16, 18), WHITE)
    _put_text(strip, f"{HEAT_MAX_GRAY:.0f}+", (right + 8, 18), WHITE)
    return strip


def _caption(width: int, detection: Detection) -> Picture:
    """When, which model, and what was said about the pair."""
    interval_ms = (detection.target_timestamp_ns - detection.source_timestamp_ns) * 1e-6
    seconds, nanoseconds = divmod(detection.source_timestamp_ns, 1_000_000_000)
    model = detection.model
    head = (
        f"t = {seconds}.{nanoseconds // 1_000_000:03d} s   target {interval_ms:+.1f} ms   status {detection.status}   "
        f"model {model.name} {model.version} ({model.sha256[:8]})"
    )
    strip = _strip(width, CAPTION_LINES)
    _put_text(strip, head, (MARGIN_PX, 18), WHITE)
    for row, line in enumerate(_reason_lines(detection), start=1):
        _put_text(strip, line, (MARGIN_PX, 18 + row * LINE_HEIGHT_PX), YELLOW)
    return strip


def _reason_lines(detection: Detection) -> list[str]:
    """At most two lines: one or two reasons in full, of more the codes."""
    lines = [f"{reason.code}: {reason.message}" for reason in detection.reasons]
    if len(lines) < CAPTION_LINES:
        return lines
    return [lines[0], "also: " + ", ".join(reason.code for reason in detection.reasons[1:])]


def _with_even_sides(picture: Picture) -> Picture:
    bottom, right = picture.shape[0] % 2, picture.shape[1] % 2
    return np.asarray(cv2.copyMakeBorder(picture, 0, bottom, 0, right, cv2.BORDER_REPLICATE), dtype=np.uint8)


class OverlayVideo:
    """An mp4 that appears at ``path`` when the ``with`` block ends well, and not at all otherwise.

    The first picture fixes the size. Without a picture no file is written.

    Args:
        path: ends in ``.mp4``; its folder exists.
        frames_per_second: of the video.
    """

    def __init__(self, path: Path, *, frames_per_second: float = 10.0) -> None:
        self._path = path
        self._partial_path = path.with_name(f".{path.stem}.partial.mp4")
        self._frames_per_second = frames_per_second
        self._writer: cv2.VideoWriter | None = None
        self._size = (0, 0)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, error_type: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        if self._writer is None:
            return
        self._writer.release()
        self._writer = None
        if error_type is None:
            self._partial_path.replace(self._path)
        else:
            self._partial_path.unlink(missing_ok=True)

    def write(self, picture: Picture) -> None:
        """Append one BGR picture [H, W, 3].

        Raises:
            InvalidInputError: ``video_frame_size``, another size than the first picture's.
            MissingDependencyError: ``video_codec_missing``, this OpenCV build cannot write the file.
        """
        frame = _with_even_sides(picture)
        size = (frame.shape[1], frame.shape[0])
        if self._writer is None:
            self._writer, self._size = self._opened(size), size
        if size != self._size:
            raise InvalidInputError(
                f"video: expected pictures of {self._size[0]}x{self._size[1]} px as the first one, "
                f"found {size[0]}x{size[1]}",
                code="video_frame_size",
            )
        self._writer.write(frame)

    def _opened(self, size: tuple[int, int]) -> cv2.VideoWriter:
        codec = cv2.VideoWriter.fourcc(*"mp4v")
        writer = cv2.VideoWriter(str(self._partial_path), codec, self._frames_per_second, size)
        if not writer.isOpened():
            raise MissingDependencyError(
                f"video: OpenCV {cv2.__version__} could not open {self._partial_path} for mp4v video of "
                f"{size[0]}x{size[1]} px; the folder must exist and OpenCV needs its FFmpeg backend: "
                "pip install --force-reinstall opencv-python-headless",
                code="video_codec_missing",
            )
        return writer

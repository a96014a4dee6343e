"""The pictures of a batch run: overlays as PNG, and a video whose frames wait on disk until all are there."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Literal, Protocol

import cv2
import numpy as np

from viflow_anomaly.batch_files import OVERLAYS_NAME, VIDEO_FRAMES_NAME, VIDEO_NAME
from viflow_anomaly.checkpoint_record import write_atomically
from viflow_anomaly.config import ImageLimits
from viflow_anomaly.detection import Detection
from viflow_anomaly.drawing import OverlayVideo, draw_overlay
from viflow_anomaly.geometry import Float32Array
from viflow_anomaly.images import read_image_size
from viflow_anomaly.prediction import PredictedFlow
from viflow_anomaly.sensor_data import FramePair, Uint8Array


class PairAnalysis(Protocol):
    """What a picture needs besides the pair: the detection and the residual [H, W] it came from.

    ``predicted`` says how the camera turned; None for a detector that does not know.
    """

    @property
    def detection(self) -> Detection: ...

    @property
    def residual(self) -> Float32Array | None: ...

    @property
    def predicted(self) -> PredictedFlow | None: ...


class Pictures:
    """Knows which pictures are wanted, which are there already, and where they go.

    Args:
        out_dir: of the run.
        count: pairs in the run.
        overlays: how many pictures to spread evenly over the run, or ``"all"``.
        video: also make ``overlay.mp4`` of all pairs.
        complete: nothing is left to detect, so that an existing video is up to date.
    """

    def __init__(
        self, out_dir: Path, count: int, *, overlays: int | Literal["all"], video: bool, complete: bool
    ) -> None:
        self._overlays_dir = out_dir / OVERLAYS_NAME
        self._frames_dir = out_dir / VIDEO_FRAMES_NAME
        self._video_path = out_dir / VIDEO_NAME
        self._wanted = spread_indices(count, count if overlays == "all" else overlays)
        self._video = video and not (complete and self._video_path.exists())

    @property
    def any(self) -> bool:
        """Whether any picture is asked for."""
        return self._video or bool(self._wanted)

    def missing(self, index: int, source_ns: int) -> bool:
        """Whether the picture of pair ``index`` is asked for and not there yet."""
        path = self._path(index, source_ns)
        return path is not None and not path.exists()

    def write(self, index: int, source_ns: int, picture: Uint8Array) -> None:
        """Write the picture [H, W, 3] (BGR) of pair ``index``."""
        path = self._path(index, source_ns)
        assert path is not None
        path.parent.mkdir(exist_ok=True)
        write_png(path, picture)

    def finish(self, source_stamps_ns: Sequence[int]) -> None:
        """Put the video together from the pictures of all pairs, given by their stamps; failed pairs have none.

        It plays in the recording's own time.

        Raises:
            MissingDependencyError: ``video_codec_missing``.
        """
        if not self._video:
            return
        paths = [self._path(index, source_ns) for index, source_ns in enumerate(source_stamps_ns)]
        frames = [path for path in paths if path is not None and path.exists()]
        # The caption under a picture has as many lines as there are reasons.
        sizes = [read_image_size(path, limits=ImageLimits(), field="overlay") for path in frames]
        height = max((size[1] for size in sizes), default=0)
        with OverlayVideo(self._video_path, frames_per_second=_frames_per_second(source_stamps_ns)) as video:
            for path in frames:
                picture = np.asarray(cv2.imread(str(path)), dtype=np.uint8)
                video.write(np.pad(picture, ((0, height - picture.shape[0]), (0, 0), (0, 0))))
        shutil.rmtree(self._frames_dir, ignore_errors=True)

    def _path(self, index: int, source_ns: int) -> Path | None:
        if index in self._wanted:
            return self._overlays_dir / f"{source_ns}.png"
        return self._frames_dir / f"{source_ns}.png" if self._video else None


def _frames_per_second(stamps_ns: Sequence[int]) -> float:
    intervals_s = np.diff(np.array(stamps_ns, dtype=np.float64)) * 1e-9
    return float(np.clip(1.0 / np.median(intervals_s), 1.0, 60.0)) if intervals_s.size else 10.0


def spread_indices(count: int, wanted: int) -> frozenset[int]:
    """``wanted`` indices below ``count``, evenly spread, first and last among them."""
    if wanted >= count:
        return frozenset(range(count))
    return frozenset(round(index) for index in np.linspace(0, count - 1, wanted).tolist())


def overlay_of(pair: FramePair, analysis: PairAnalysis, tracked: Detection | None = None) -> Uint8Array:
    """The picture of one pair, [H, W, 3] BGR; with the boxes of ``tracked`` where its tracks are known."""
    return draw_overlay(pair.source.image, tracked or analysis.detection, residual=analysis.residual)


def write_png(path: Path, picture: Uint8Array) -> None:
    """Write a picture whole or not at all.

    Raises:
        OSError: the disk is full or the folder cannot be written.
    """
    _, data = cv2.imencode(".png", picture)
    write_atomically(path, data.tobytes())

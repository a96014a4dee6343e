"""Which detections get a small picture, and its bytes. Made in a worker's thread, kept beside the detection."""

from __future__ import annotations

from typing import Final

from viflow_anomaly.detection import Detection
from viflow_anomaly.drawing import draw_thumbnail
from viflow_anomaly.sensor_data import Uint8Array
from viflow_anomaly_service.picture_files import MEDIA_TYPES, picture_file
from viflow_anomaly_service.settings import ServiceSettings

THUMBNAIL_MEDIA_TYPE: Final = MEDIA_TYPES["jpg"]
LONGEST_SIDE_PX: Final = 320
_QUALITY: Final = 80


def wanted_thumbnail(settings: ServiceSettings, source: Uint8Array, detection: Detection) -> bytes | None:
    """A JPEG of the source image with its regions; None where none is kept.

    Args:
        settings: which are wanted; without a store none is.
        source: [H, W] uint8, which the detection was made from.
    """
    choice = "none" if settings.store_url is None else settings.thumbnails
    moves = any(roi.label == "independent_motion" for roi in detection.rois)
    if choice == "none" or (choice == "motion" and not moves):
        return None
    picture = draw_thumbnail(source, detection, longest_side_px=LONGEST_SIDE_PX)
    return picture_file(picture, "jpg", jpeg_quality=_QUALITY)

"""A detector that says what its source image says: one region with the score in the first pixel, or none at 0."""

from __future__ import annotations

from typing import Any

import numpy as np
from rule_detector import MODEL, RuleDetector
from service_world import INTERVAL_NS, T0, base64_text, png

from viflow_anomaly.detection import AnalyzedRegion, Detection, ImageSize, ResidualSummary, Roi
from viflow_anomaly.regions import BoundingBox
from viflow_anomaly.sensor_data import FramePair

WIDTH, HEIGHT = 64, 48


class ScriptedDetector(RuleDetector):
    def detect(self, pair: FramePair, *, decode_ms: float = 0.0) -> Detection:
        score = round(float(pair.source.image[0, 0]) / 255, 4)
        box = BoundingBox(20, 16, 12, 10)
        rois = (Roi(1, "independent_motion", score, box, 12, 10, 120, 10, 90.0, 99.0),) if score else ()
        return Detection(
            source_timestamp_ns=pair.source.timestamp_ns,
            target_timestamp_ns=pair.target.timestamp_ns,
            image=ImageSize(WIDTH, HEIGHT),
            status="ok",
            reasons=(),
            model=MODEL,
            rois=rois,
            region_analyzed=AnalyzedRegion(0, 0, WIDTH, HEIGHT),
            residual=ResidualSummary(1.0, 1.0, 2.0),
            timings_ms={"decode": decode_ms},
        )


def scripted_call(number: int, score: float) -> dict[str, Any]:
    """The frame of a number with its samples; what it says is said of the pair that begins with it."""
    image = np.full((HEIGHT, WIDTH), 100, np.uint8)
    image[0, 0] = round(score * 255)
    now_ns = T0 + number * INTERVAL_NS
    stamps = list(range(now_ns - INTERVAL_NS + 5_000_000 - (250_000_000 if not number else 0), now_ns + 1, 5_000_000))
    return {
        "frame": {"timestamp_ns": now_ns, "image_base64": base64_text(png(image))},
        "imu": {
            "timestamps_ns": stamps,
            "gyro_rad_s": [[0.0, 0.0, 0.0]] * len(stamps),
            "accel_m_s2": [[0.0, 0.0, 9.81]] * len(stamps),
        },
    }

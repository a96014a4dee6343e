"""A pair of frames, and a live service with keys, for the client's tests."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

sys.path.append(str(Path(__file__).parents[1] / "service"))

from rule_detector import RuleDetector
from service_world import INTERVAL_NS, T0, camera_part, gray_image, imu_part, live_server

from viflow_anomaly.datasets.camera_json import camera_from_mapping
from viflow_anomaly.sensor_data import Frame, FramePair, ImuSamples
from viflow_anomaly_service.api_keys import new_key


def frame_pair() -> FramePair:
    imu = imu_part()
    return FramePair(
        source=Frame(T0, gray_image(seed=0)),
        target=Frame(T0 + INTERVAL_NS, gray_image(seed=1)),
        imu=ImuSamples(np.array(imu["timestamps_ns"]), np.array(imu["gyro_rad_s"]), np.array(imu["accel_m_s2"])),
        camera=camera_from_mapping(camera_part()),
    )


@contextmanager
def guarded_service(folder: Path) -> Iterator[tuple[str, dict[str, str]]]:
    """Its address, and the keys ``drone`` (detect), ``reader`` (read) and ``poor`` (one detection a day)."""
    made = {
        name: new_key(name, [scope]) for name, scope in (("drone", "detect"), ("reader", "read"), ("poor", "detect"))
    }
    lines = [made["drone"][1], made["reader"][1], made["poor"][1] + " daily=1"]
    (folder / "keys.txt").write_text("\n".join(lines))
    with live_server(lambda settings: RuleDetector(), key_file=folder / "keys.txt") as server:
        yield f"http://127.0.0.1:{server.port}", {name: key for name, (key, _) in made.items()}

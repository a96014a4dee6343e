"""Time from a prepared image pair to its regions on one core, beside OpenCV's DIS flow (medium) in the same run.

The images are the bundled simulator sample, seen through three cameras at each size: one without a calibration, one
without distortion, one with EuRoC's lens (cam0 of the MAV dataset). The repetitions of both methods alternate, so that
a change of clock speed or load meets both.

    python benchmarks/latency.py --out benchmarks/results/latency.json
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import subprocess
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from importlib.metadata import version
from itertools import pairwise
from pathlib import Path
from typing import Any, get_args

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # read once, when torch loads
os.environ.setdefault("OMP_NUM_THREADS", "1")

import cv2
import numpy as np

from viflow_anomaly.alignment import align, remaining_evidence
from viflow_anomaly.allocator import keep_freed_memory
from viflow_anomaly.checkpoint_record import source_commit, write_atomically
from viflow_anomaly.cli.pair_files import PairFiles, load_pair
from viflow_anomaly.config import ImageLimits, RuntimeName
from viflow_anomaly.detection import ImageSize, rois_from_regions
from viflow_anomaly.detector import AnomalyDetector
from viflow_anomaly.errors import ViflowError
from viflow_anomaly.evaluation.flow_report import cpu_model
from viflow_anomaly.evidence_cues import evidence_cues
from viflow_anomaly.explanation import explain
from viflow_anomaly.geometry import Float32Array, pixel_grid, unproject_pixels
from viflow_anomaly.model_input import prepare
from viflow_anomaly.motion_evidence import judge_cues, knows_depth, regions_of, takes_head
from viflow_anomaly.prediction import correct
from viflow_anomaly.runtime.loading import load_evidence, load_runtime
from viflow_anomaly.sensor_data import Frame, FramePair, PinholeCamera, Uint8Array

ROOT = Path(__file__).resolve().parents[1]
SIZES = ((224, 224), (752, 480))
CAMERAS = ("none", "pinhole", "radtan")
EUROC_HEIGHT_PX, EUROC_FOCAL_PX = 480, (458.654, 457.296)
EUROC_RADTAN = (-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05)
MIN_REPEATS = 50
STAGES = ("view", "network", "correction", "align", "reconstruct", "cues", "head", "regions")


@dataclass(frozen=True)
class Case:
    """One size and camera; ``pair.camera`` is None where the detector is told nothing about it."""

    width: int
    height: int
    camera: str
    pair: FramePair


def make_case(sample: FramePair, width: int, height: int, camera: str) -> Case:
    """The sample as a width x height camera sees it: every pixel's ray looked up in the sample's images.

    Rays beyond the sample's border meet its mirror image (only with EuRoC's lens).
    """
    known = sample.camera
    if known is None:
        raise SystemExit("the sample has no camera.json")
    scale = max(1.0, width / known.width, height / known.height)
    seen_by = PinholeCamera(
        fx=known.fx * scale,
        fy=known.fy * scale,
        cx=(width - 1) / 2,
        cy=(height - 1) / 2,
        width=width,
        height=height,
        T_cam_imu=known.T_cam_imu,
        time_offset_s=known.time_offset_s,
    )
    if camera == "radtan":
        fx, fy = (focal * height / EUROC_HEIGHT_PX for focal in EUROC_FOCAL_PX)
        seen_by = replace(seen_by, fx=fx, fy=fy, distortion_model="radtan", distortion_coeffs=EUROC_RADTAN)
    rays = unproject_pixels(seen_by, pixel_grid(height, width))
    lookup = np.asarray(rays * (known.fx, known.fy) + (known.cx, known.cy), dtype=np.float32)
    source, target = (
        Frame(frame.timestamp_ns, look_up(frame.image, lookup)) for frame in (sample.source, sample.target)
    )
    told = None if camera == "none" else seen_by
    return Case(width, height, camera, FramePair(source=source, target=target, imu=sample.imu, camera=told))


def look_up(image: Uint8Array, lookup: Float32Array) -> Uint8Array:
    """``image`` at the (u, v) of ``lookup`` [h, w, 2], bicubic."""
    seen = cv2.remap(image, lookup, None, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT_101)  # type: ignore[call-overload]
    return np.asarray(seen, dtype=np.uint8)


class Stages:
    """The detector's steps one by one, each with its own clock; the same functions in the same order."""

    def __init__(self, checkpoint: Path | None, detector: AnomalyDetector, runtime: RuntimeName) -> None:
        self._runtime, self._record = load_runtime(checkpoint, runtime=runtime, threads=1)
        self._head = load_evidence(None, runtime=runtime, threads=1)
        self._detector, self._config = detector, detector.config

    def run(self, pair: FramePair) -> list[float]:
        """Milliseconds of ``STAGES``; view is both images, at their internal size, and the IMU window."""
        clock = [time.perf_counter()]

        def lap() -> None:
            clock.append(time.perf_counter())

        size = self._detector.internal_size(pair)
        image = ImageSize(*pair.source.image.shape[::-1])
        pair = pair if size is None else size.reduce(pair)
        model_input = prepare(pair, self._record.model)
        lap()
        hypotheses = self._runtime.predict(model_input)
        lap()
        focal_px = self._record.model.view.focal_px
        predicted = correct(hypotheses, model_input, self._config.correction, focal_px=focal_px)
        lap()
        takes = takes_head(self._head, self._config, depth_is_known=knows_depth(predicted))
        alignment = align(pair, model_input, predicted, focal_px=focal_px) if takes else None
        lap()
        coordinates = None if alignment is None else alignment.target_coordinates
        explained = explain(pair, model_input, predicted, self._config, coordinates=coordinates)
        lap()
        cues = None if alignment is None else evidence_cues(remaining_evidence(explained, alignment))
        lap()
        judged = None if cues is None else judge_cues(self._head, cues, explained)
        lap()
        regions = regions_of(explained, judged, self._head, self._config)
        rois_from_regions(regions if size is None else [size.region(region) for region in regions], image)
        lap()
        return [(after - before) * 1e3 for before, after in pairwise(clock)]


def milliseconds(call: Callable[[], object]) -> float:
    started = time.perf_counter()
    call()
    return (time.perf_counter() - started) * 1e3


def spread(samples: Sequence[float]) -> dict[str, float]:
    low, median, high = np.percentile(samples, (25, 50, 75))
    return {"median": round(float(median), 3), "q1": round(float(low), 3), "q3": round(float(high), 3)}


def measure(case: Case, detector: AnomalyDetector, stages: Stages, *, repeats: int, warm_up: int) -> dict[str, Any]:
    """Alternating repetitions of detector, DIS and the detector's stages on one case."""
    pair = case.pair
    dis = cv2.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)  # type: ignore[attr-defined]

    def flow() -> object:
        return dis.calc(pair.source.image, pair.target.image, None)

    def detect() -> object:
        return detector.detect(pair)

    times: dict[str, list[float]] = {"detect": [], "dis": []}
    stage_times: list[list[float]] = []
    for repetition in range(-warm_up, repeats):
        order = ("detect", "dis") if repetition % 2 else ("dis", "detect")
        taken = {name: milliseconds(detect if name == "detect" else flow) for name in order}
        taken_by_stage = stages.run(pair)
        if repetition >= 0:
            for name in order:
                times[name].append(taken[name])
            stage_times.append(taken_by_stage)
    found = detector.detect(pair)
    medians = np.median(np.array(stage_times), axis=0)
    return {
        "width": case.width,
        "height": case.height,
        "camera": case.camera,
        "detect_ms": spread(times["detect"]),
        "dis_medium_ms": spread(times["dis"]),
        "ratio_of_medians": round(float(np.median(times["detect"]) / np.median(times["dis"])), 3),
        "stages_median_ms": dict(zip(STAGES, np.round(medians, 3).tolist(), strict=True)),
        "status": found.status,
        "rois": len(found.rois),
    }


def uncommitted_changes() -> bool | None:
    """Whether tracked files differ from the commit; None outside a git checkout."""
    command = ["git", "-C", str(ROOT), "status", "--porcelain", "--untracked-files=no"]
    try:
        return bool(subprocess.run(command, capture_output=True, text=True, timeout=10, check=True).stdout.strip())
    except (OSError, subprocess.SubprocessError):
        return None


def circumstances(detector: AnomalyDetector, load_before: float) -> dict[str, Any]:
    """All that a reader needs to judge the numbers."""
    packages = ("viflow-anomaly", "torch", "openvino", "numpy", "opencv-python-headless", "scikit-image")
    return {
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "commit": source_commit(),
        "uncommitted_changes": uncommitted_changes(),
        "cpu": cpu_model(),
        "cores": os.cpu_count(),
        "threads": 1,
        "load_1min_before": round(load_before, 2),
        "load_1min_after": round(os.getloadavg()[0], 2),
        "python": platform.python_version(),
        "versions": {name: version(name) for name in packages},
        "model": {"name": detector.model_info.name, "sha256": detector.model_info.sha256},
        "runtime": detector.runtime,
    }


def markdown(results: Sequence[dict[str, Any]]) -> str:
    """The table for people; times are medians with quartiles in brackets."""

    def cell(times: dict[str, float]) -> str:
        return f"{times['median']:.1f} [{times['q1']:.1f}, {times['q3']:.1f}]"

    lines = [
        f"| size | camera | pair to ROIs, ms | DIS medium, ms | ratio | {' | '.join(STAGES)} | ROIs |",
        "|---|---|---|---|---|" + "---|" * (len(STAGES) + 1),
    ]
    for one in results:
        stages = " | ".join(f"{one['stages_median_ms'][name]:.1f}" for name in STAGES)
        size = f"{one['width']}x{one['height']}"
        rois = one["rois"] if one["status"] == "ok" else one["status"]
        lines.append(
            f"| {size} | {one['camera']} | {cell(one['detect_ms'])} | {cell(one['dis_medium_ms'])} | "
            f"{one['ratio_of_medians']:.2f} | {stages} | {rois} |"
        )
    return "\n".join(lines)


def parse_arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="Pair to ROIs on one core, beside OpenCV's DIS medium.")
    parser.add_argument("--checkpoint", type=Path, help="weights to use instead of the bundled model")
    parser.add_argument("--runtime", choices=get_args(RuntimeName), default="auto", help="what runs the network")
    parser.add_argument("--sample", type=Path, default=ROOT / "samples" / "drone", help="a pair as in samples/drone")
    parser.add_argument("--out", type=Path, default=ROOT / "benchmarks" / "results" / "latency.json")
    parser.add_argument("--repeats", type=int, default=200, help=f"at least {MIN_REPEATS} (default 200)")
    parser.add_argument("--warm-up", type=int, default=20, help="untimed repetitions of each case (default 20)")
    parser.add_argument("--cameras", nargs="+", choices=CAMERAS, default=CAMERAS)
    arguments = parser.parse_args()
    if arguments.repeats < MIN_REPEATS or arguments.warm_up < 1:
        parser.error(f"expected at least {MIN_REPEATS} repeats and 1 warm-up")
    return arguments


def sample_and_detector(
    folder: Path, checkpoint: Path | None, runtime: RuntimeName
) -> tuple[FramePair, AnomalyDetector]:
    """What is measured; what cannot be loaded ends the program with one line."""
    files = PairFiles(folder / "source.png", folder / "target.png", folder / "imu.json", folder / "camera.json")
    try:
        sample, _ = load_pair(files, limits=ImageLimits())
        return sample, AnomalyDetector.from_checkpoint(checkpoint, runtime=runtime, threads=1)
    except ViflowError as err:
        raise SystemExit(f"error: {err.message} [{err.code}]") from err


def main() -> None:
    arguments = parse_arguments()
    cv2.setNumThreads(1)
    keep_freed_memory()  # as the command line and the service do
    load_before = os.getloadavg()[0]
    sample, detector = sample_and_detector(arguments.sample, arguments.checkpoint, arguments.runtime)
    stages = Stages(arguments.checkpoint, detector, arguments.runtime)
    results = []
    for width, height in SIZES:
        for camera in arguments.cameras:
            case = make_case(sample, width, height, camera)
            results.append(measure(case, detector, stages, repeats=arguments.repeats, warm_up=arguments.warm_up))
    about = circumstances(detector, load_before)
    report = {**about, "repeats": arguments.repeats, "warm_up": arguments.warm_up, "results": results}
    write_atomically(arguments.out, (json.dumps(report, indent=2) + "\n").encode())
    print(f"{about['cpu']}, 1 of {about['cores']} cores, load {about['load_1min_before']} before the run,")
    print(f"{arguments.repeats} repetitions, median [quartiles]; stages are medians in ms\n")
    print(markdown(results))


if __name__ == "__main__":
    main()

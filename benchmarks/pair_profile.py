"""Where a pair's time goes: every part of ``AnomalyDetector.detect`` with its own clock, beside OpenCV's DIS flow.

Finer than ``latency.py``'s stages: functions are wrapped while the detector runs, so that what is shown is the one
inference path and no copy of it. *Own* time is what a part spends outside the parts that it calls. All of a pair runs
in the caller's thread, so the clock is that thread's CPU time: other programs that want the core do not count, and
shares and ratios hold on a busy machine. What a user waits is ``latency.py``'s to say.

Not named profile.py: a script's folder comes first on its path, and would hide the module of that name that cProfile
needs.

    python benchmarks/pair_profile.py --out benchmarks/results/profile.json
"""

from __future__ import annotations

import argparse
import functools
import json
import os
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import Any, get_args

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # read once, when torch loads
os.environ.setdefault("OMP_NUM_THREADS", "1")

import cv2
import numpy as np
from latency import CAMERAS, ROOT, SIZES, Case, circumstances, make_case, sample_and_detector

from viflow_anomaly.allocator import keep_freed_memory
from viflow_anomaly.checkpoint_record import write_atomically
from viflow_anomaly.config import RuntimeName
from viflow_anomaly.detector import AnomalyDetector

PARTS = (
    "internal_size.InternalSize.reduce",
    "model_input.prepare",
    "motion_input.build_motion_window",
    "view.InternalView.render",
    "runtime.openvino_runtime.OpenvinoRuntime.predict",
    "prediction.correct",
    "prediction.choose_hypothesis",
    "measured_flow.measure_flow",
    "measured_flow._confidence",
    "correction.correct_motion",
    "correction._log_depth_ratio",
    "explanation.explain",
    "view.InternalView.target_coordinates",
    "residual.reconstruct",
    "residual.compensate_exposure",
    "residual.photometric_residual",
    "residual.half_range_gray",
    "residual.texture_normalised",
    "alignment.align",
    "alignment.remaining_evidence",
    "block_geometry.block_geometry",
    "alignment._common",
    "evidence_cues.evidence_cues",
    "measured_flow.measure_remaining_flow",
    "measured_flow._local_flow",
    "motion_refinement.common_motion_px",
    "motion_evidence.judge_cues",
    "runtime.openvino_evidence.OpenvinoEvidence.judge",
    "pair_quality.judge_images",
    "pair_quality.judge_correction",
    "detector._summary",
    "motion_evidence.regions_of",
    "moving_regions.measure_regions",
    "internal_size.InternalSize.region",
    "detection.rois_from_regions",
)
"""Functions and methods below ``viflow_anomaly``, in the order in which a pair meets them."""
WHOLE, DIS = "detect", "DIS medium"


class Clocks:
    """Inclusive and own milliseconds of each part in one pair; one thread."""

    def __init__(self) -> None:
        self.total_ms: dict[str, float] = {}
        self.own_ms: dict[str, float] = {}
        self.calls: dict[str, int] = {}
        self._children_ms = [0.0]

    def timed(self, name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        """``function``, with its time booked under ``name``."""

        @functools.wraps(function)
        def clocked(*args: Any, **kwargs: Any) -> Any:
            self._children_ms.append(0.0)
            started = time.thread_time()
            try:
                return function(*args, **kwargs)
            finally:
                taken = (time.thread_time() - started) * 1e3
                own = taken - self._children_ms.pop()
                self._children_ms[-1] += taken
                self.total_ms[name] = self.total_ms.get(name, 0.0) + taken
                self.own_ms[name] = self.own_ms.get(name, 0.0) + own
                self.calls[name] = self.calls.get(name, 0) + 1

        return clocked


@contextmanager
def clocked_parts(clocks: Clocks) -> Iterator[None]:
    """All ``PARTS`` that this version has are clocked inside, wherever a module of ours holds their name."""
    undo: list[tuple[Any, str, Any]] = []
    for part in PARTS:
        for owner, attribute in places_of(part):
            original = getattr(owner, attribute)
            undo.append((owner, attribute, original))
            setattr(owner, attribute, clocks.timed(part, original))
    try:
        yield
    finally:
        for owner, attribute, original in reversed(undo):
            setattr(owner, attribute, original)


def places_of(part: str) -> list[tuple[Any, str]]:
    """Where calls of a part look it up: its class, or every module of ours that imported it. Empty: not there."""
    path, name = part.rsplit(".", 1)
    module, _, class_name = path.rpartition(".")
    if class_name[:1].isupper():
        owner = getattr(import_module(f"viflow_anomaly.{module}"), class_name, None)
        return [(owner, name)] if hasattr(owner, name) else []
    function = getattr(import_module(f"viflow_anomaly.{path}"), name, None)
    ours = [one for key, one in sys.modules.items() if key.startswith("viflow_anomaly")]
    return [] if function is None else [(one, name) for one in ours if getattr(one, name, None) is function]


def profile(case: Case, detector: AnomalyDetector, *, repeats: int, warm_up: int) -> dict[str, Any]:
    """Medians over the repetitions; detector and DIS alternate."""
    dis = cv2.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)  # type: ignore[attr-defined]
    runs = []
    for repetition in range(-warm_up, repeats):
        clocks = Clocks()
        with clocked_parts(clocks):
            clocks.timed(WHOLE, detector.detect)(case.pair)
        with_dis = clocks.timed(DIS, dis.calc)
        with_dis(case.pair.source.image, case.pair.target.image, None)
        if repetition >= 0:
            runs.append(clocks)
    parts = {
        name: {
            "calls": runs[0].calls[name],
            "total_ms": round(float(np.median([run.total_ms[name] for run in runs])), 4),
            "own_ms": round(float(np.median([run.own_ms[name] for run in runs])), 4),
        }
        for name in (WHOLE, *PARTS)
        if name in runs[0].calls
    }
    dis_ms = round(float(np.median([run.total_ms[DIS] for run in runs])), 4)
    return {
        "width": case.width,
        "height": case.height,
        "camera": case.camera,
        "dis_medium_ms": dis_ms,
        "ratio": round(parts[WHOLE]["total_ms"] / dis_ms, 3),
        "parts": parts,
    }


def markdown(results: Sequence[dict[str, Any]]) -> str:
    """One column a case: total and, in brackets, own milliseconds; DIS medium's in the last row."""
    heads = [f"{one['width']}x{one['height']} {one['camera']}" for one in results]
    names = [name for name in (WHOLE, *PARTS) if any(name in one["parts"] for one in results)]
    lines = [f"| part | {' | '.join(heads)} |", "|---|" + "---|" * len(heads)]
    for name in names:
        cells = (one["parts"].get(name) for one in results)
        told = ("-" if cell is None else f"{cell['total_ms']:.2f} [{cell['own_ms']:.2f}]" for cell in cells)
        lines.append(f"| `{name}` | {' | '.join(told)} |")
    lines.append(f"| {DIS} | {' | '.join(format(one['dis_medium_ms'], '.2f') for one in results)} |")
    lines.append(f"| {WHOLE} / {DIS} | {' | '.join(format(one['ratio'], '.2f') for one in results)} |")
    return "\n".join(lines)


def parse_arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="Every part of a detection with its own clock, beside DIS medium.")
    parser.add_argument("--checkpoint", type=Path, help="weights to use instead of the bundled model")
    parser.add_argument("--runtime", choices=get_args(RuntimeName), default="auto", help="what runs the network")
    parser.add_argument("--sample", type=Path, default=ROOT / "samples" / "drone", help="a pair as in samples/drone")
    parser.add_argument("--out", type=Path, default=ROOT / "benchmarks" / "results" / "profile.json")
    parser.add_argument("--repeats", type=int, default=100, help="at least 10 (default 100)")
    parser.add_argument("--warm-up", type=int, default=10, help="untimed repetitions of each case (default 10)")
    parser.add_argument("--cameras", nargs="+", choices=CAMERAS, default=["pinhole", "radtan"])
    arguments = parser.parse_args()
    if arguments.repeats < 10 or arguments.warm_up < 1:
        parser.error("expected at least 10 repeats and 1 warm-up")
    return arguments


def main() -> None:
    arguments = parse_arguments()
    cv2.setNumThreads(1)
    keep_freed_memory()  # as the command line and the service do
    load_before = os.getloadavg()[0]
    sample, detector = sample_and_detector(arguments.sample, arguments.checkpoint, arguments.runtime)
    results = [
        profile(make_case(sample, *size, camera), detector, repeats=arguments.repeats, warm_up=arguments.warm_up)
        for size in SIZES
        for camera in arguments.cameras
    ]
    report = {**circumstances(detector, load_before), "repeats": arguments.repeats, "results": results}
    write_atomically(arguments.out, (json.dumps(report, indent=2) + "\n").encode())
    print(f"{report['cpu']}, 1 of {report['cores']} cores, load {report['load_1min_before']} before the run,")
    print(f"{arguments.repeats} repetitions, medians of total [own] milliseconds\n")
    print(markdown(results))


if __name__ == "__main__":
    main()

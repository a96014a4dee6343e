"""How time and memory grow: with pixels, hypotheses, regions and the length of a recording."""

from __future__ import annotations

import math
import tempfile
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from viflow_anomaly.allocator import keep_freed_memory
from viflow_anomaly.batch_job import BatchOptions, run_batch
from viflow_anomaly.benchmarking.comparison import OnStep
from viflow_anomaly.benchmarking.machine import peak_memory_mib
from viflow_anomaly.benchmarking.made_scene import make_pair, make_recording
from viflow_anomaly.benchmarking.measuring import Times, in_own_process, peak_of, take_turns
from viflow_anomaly.benchmarking.subjects import Subject, untrained_detector
from viflow_anomaly.config import DetectorConfig, ModelConfig, RegionConfig
from viflow_anomaly.detector import AnomalyDetector
from viflow_anomaly.regions import find_regions

SIDES_PX = (224, 448, 896)
HYPOTHESES = (1, 4, 8)
BLOBS = (1, 16, 256, 4096, 16384)
BLOB_IMAGE = (752, 480)
BLOB_GRAY = 80.0
PROFILES = ("auto", "residual")
REPEATS, BUDGET_S = 9, 20.0


def measure_curves(on_step: OnStep, *, lengths: tuple[int, ...], memory: bool) -> dict[str, Any]:
    """All curves, one thread; plain JSON values."""
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        on_step("pixels")
        pixels = by_pixels(memory=memory)
        on_step("hypotheses")
        hypotheses = by_hypotheses()
        on_step("regions")
        blobs = by_blobs()
    finally:
        cv2.setNumThreads(before)
    on_step("length of a recording")
    return {"pixels": pixels, "hypotheses": hypotheses, "blobs": blobs, "length": by_length(lengths)}


def by_pixels(*, memory: bool) -> list[dict[str, Any]]:
    """The default detector and the light one, at sizes of four times the pixels each.

    ``over_quarter``: time over that of a quarter of the pixels; 4 is linear.
    """
    runs = {}
    for evidence in PROFILES:
        config = DetectorConfig(evidence="residual" if evidence == "residual" else "auto")
        detector = AnomalyDetector.from_checkpoint(config=config, threads=1, with_evidence=evidence == "auto")
        runs[Subject("viflow-anomaly", "auto", "bundled", evidence)] = detector.detect
    rows: list[dict[str, Any]] = []
    smaller: dict[Subject, Times] = {}
    for side in SIDES_PX:
        times = take_turns(runs, make_pair(side, side), repeats=REPEATS, budget_s=BUDGET_S)
        for subject, one in times.items():
            ratio = round(one.median_ms / smaller[subject].median_ms, 2) if smaller else None
            peak = in_own_process(peak_of, subject, side, side, 1) if memory else None
            rows.append(
                {
                    "evidence": subject.evidence,
                    "pixels": side * side,
                    "median_ms": one.median_ms,
                    "over_quarter": ratio,
                    "peak_mib": peak,
                }
            )
        smaller = times
    return rows


def by_hypotheses() -> list[dict[str, Any]]:
    """Untrained networks of the default preset in torch; ``minimum`` reconstructs with every hypothesis."""
    runs = {}
    for count in HYPOTHESES:
        for residual in ("winner", "minimum"):
            config = DetectorConfig(evidence="residual", residual="minimum" if residual == "minimum" else "winner")
            assert count in (1, 4, 8)
            detector = untrained_detector(ModelConfig(hypotheses=count), config, 1)
            runs[Subject(f"{count}", "torch", residual)] = detector.detect
    times = take_turns(runs, make_pair(224, 224), repeats=REPEATS, budget_s=BUDGET_S)
    return [
        {"hypotheses": int(subject.name), "residual": subject.preset, "median_ms": one.median_ms}
        for subject, one in times.items()
    ]


def by_blobs() -> list[dict[str, Any]]:
    """Residual to regions where so many squares stand out, in a regular pattern; the most that fit is a checkerboard.

    Once with the default's opening, closing and least area, which let few of them through, and once with all of that
    off: each square is a component then.
    """
    width, height = BLOB_IMAGE
    inside = np.ones((height, width), dtype=np.bool_)
    bare = RegionConfig(
        smoothing_fraction=0, opening_fraction=0, closing_fraction=0, min_area_fraction=0, max_regions=4096
    )
    rows: list[dict[str, Any]] = []
    for count in BLOBS:
        evidence = checkerboard(count, width, height)
        for name, config in (("default", RegionConfig()), ("everything", bare)):
            samples: list[float] = []
            found = 0
            for _ in range(REPEATS):
                started = time.perf_counter()
                found = len(find_regions(evidence, inside, config).regions)
                samples.append((time.perf_counter() - started) * 1e3)
                if sum(samples) > BUDGET_S * 1e3:
                    break
            rows.append({"blobs": count, "limits": name, "regions": found, "median_ms": Times.of(samples).median_ms})
    return rows


def checkerboard(count: int, width: int, height: int) -> np.ndarray[Any, np.dtype[np.float32]]:
    """[height, width] float32 with ``count`` bright squares (or as many as whole rows of them hold) on black."""
    columns = max(1, round(math.sqrt(count * width / height)))
    rows = max(1, math.ceil(count / columns))
    v, u = np.mgrid[0:height, 0:width]
    column, row = 2 * u * columns // width, 2 * v * rows // height
    lit = (column % 2 == 0) & (row % 2 == 0) & (row // 2 * columns + column // 2 < count)
    return np.where(lit, np.float32(BLOB_GRAY), np.float32(0))


def by_length(lengths: tuple[int, ...]) -> list[dict[str, Any]]:
    """Batch runs of one job over recordings of so many frames, each in a process of its own."""
    return [in_own_process(_batch_run, frames) for frames in lengths]


def _batch_run(frames: int) -> dict[str, Any]:
    cv2.setNumThreads(1)
    keep_freed_memory()
    detector: Any = AnomalyDetector.from_checkpoint(threads=1)
    with tempfile.TemporaryDirectory() as folder:
        recording = make_recording(Path(folder) / "frames", frames, 224, 224)
        started = time.perf_counter()
        summary = run_batch(recording, detector, BatchOptions(out_dir=Path(folder) / "out"))
        seconds = time.perf_counter() - started
    per_pair = round(seconds * 1e3 / max(summary.pairs, 1), 3)
    return {"frames": frames, "pairs": summary.pairs, "ms_a_pair": per_pair, "peak_mib": round(peak_memory_mib(), 1)}


def draw_curves(curves: dict[str, Any], stem: Path) -> list[Path]:
    """``stem.png`` and ``.pdf``: pixels, hypotheses, regions and length, side by side.

    Raises:
        MissingDependencyError: ``plots_unavailable``.
    """
    from viflow_anomaly.evaluation.plot_style import PAGE_IN, drawing, look, require_matplotlib, saved  # noqa: PLC0415

    require_matplotlib()
    panels = (
        ("pixels", "pixels", "median_ms", "evidence"),
        ("hypotheses", "hypotheses", "median_ms", "residual"),
        ("blobs", "blobs", "median_ms", "limits"),
        ("length", "frames", "peak_mib", ""),
    )
    with drawing(stem, width_in=PAGE_IN, height_in=2.4) as figure:
        for place, (name, x, y, series) in enumerate(panels, start=1):
            axes = figure.add_subplot(1, len(panels), place)
            rows = curves[name]
            for index, key in enumerate(dict.fromkeys(row.get(series, "") for row in rows)):
                line = [(row[x], row[y]) for row in rows if row.get(series, "") == key]
                style = look(index)
                axes.plot(
                    *zip(*line, strict=True), color=style.color, marker=style.marker, ls=style.line, label=str(key)
                )
            if name in ("pixels", "blobs"):
                axes.set_xscale("log")
                axes.set_yscale("log")
                axes.tick_params(which="minor", labelbottom=False)
            else:
                axes.set_ylim(bottom=0)
            axes.set_xlabel(x)
            axes.set_ylabel("peak memory [MiB]" if y == "peak_mib" else "time [ms]")
            if series:
                axes.legend()
    return list(saved(stem))

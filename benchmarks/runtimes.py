"""What runtimes and precisions cost and gain: latency of network and evidence head, endpoint error, regions.

Latency is measured at the size that the network and the head see of 224x224 and 752x480 images, on one thread; all
variants take turns in one run, so that load meets all of them. Accuracy is that of ``evaluate flow`` and ``evaluate
detect`` on recordings with ground truth. int8 files are made here, calibrated on simulated recordings or on those of
--calibration. A variant is ``kept`` where no group loses more than 2 % of what float32 in the same runtime has.

    python benchmarks/runtimes.py runs/held-out/* --every 2 --out benchmarks/results/runtimes.json
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from functools import cache, partial
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # read once, when torch loads
os.environ.setdefault("OMP_NUM_THREADS", "1")

import cv2
from latency import ROOT, SIZES, make_case, milliseconds, spread

from viflow_anomaly.checkpoint_record import (
    bundled_checkpoint,
    bundled_evidence_head,
    read_checkpoint,
    write_atomically,
)
from viflow_anomaly.cli.flow_inputs import open_truths
from viflow_anomaly.cli.pair_files import PairFiles, load_pair
from viflow_anomaly.config import CorrectionConfig, DetectorConfig, ImageLimits, Precision, RuntimeName
from viflow_anomaly.detector import AnomalyDetector
from viflow_anomaly.errors import ViflowError
from viflow_anomaly.evaluation.detection_methods import DetectorMethod
from viflow_anomaly.evaluation.detection_quality import measure_detection
from viflow_anomaly.evaluation.detection_report import detection_report
from viflow_anomaly.evaluation.flow_methods import network_methods
from viflow_anomaly.evaluation.flow_report import circumstances, flow_report, scopes
from viflow_anomaly.evaluation.flow_run import measure_flow_methods
from viflow_anomaly.evaluation.labelled_pairs import open_labelled
from viflow_anomaly.export_samples import head_samples, network_samples, simulated_recordings
from viflow_anomaly.model_input import prepare
from viflow_anomaly.runtime.export import export_head, export_network
from viflow_anomaly.runtime.loading import load_evidence, load_runtime

MAX_LOSS = 0.02
"""Relative; a variant that loses more in any group is not kept."""
DETECTION_FIGURES, FLOW_FIGURE = ("roi_ap", "pixel_ap"), "epe_mean_px"


class Variant(NamedTuple):
    """What a network is run by."""

    runtime: RuntimeName
    precision: Precision

    def __str__(self) -> str:
        return f"{self.runtime} {self.precision}"


@cache
def variants() -> tuple[Variant, ...]:
    """bfloat16 only where the CPU computes in it."""
    has_bfloat16 = load_evidence(None, runtime="openvino", precision="auto").runtime.backend.precision == "bf16"
    return (
        Variant("openvino", "f32"),
        *([Variant("openvino", "bf16")] if has_bfloat16 else []),
        Variant("openvino", "int8"),
        Variant("onnxruntime", "f32"),
        Variant("onnxruntime", "int8"),
        Variant("torch", "f32"),
    )


class Files(NamedTuple):
    """The bundled network and evidence head, copied and exported in every way."""

    network: Path
    head: Path


def export_all(folder: Path, calibration: Sequence[Path]) -> Files:
    """Copies of what is bundled, with int8 exports in both formats; in ``folder``."""
    for path in (bundled_checkpoint(), bundled_evidence_head()):
        for suffix in (".safetensors", ".json", ".onnx"):
            shutil.copy(path.with_suffix(suffix), folder)
    files = Files(folder / bundled_checkpoint().name, folder / bundled_evidence_head().name)
    recordings = calibration or simulated_recordings(folder / "calibration")
    of_network = network_samples(recordings, read_checkpoint(files.network)[1].model, ImageLimits())
    of_head = head_samples(recordings, AnomalyDetector.from_checkpoint(with_evidence=False, threads=1), ImageLimits())
    for file_format in ("onnx", "openvino"):
        export_network(files.network, file_format=file_format, samples=of_network)
        export_head(files.head, file_format=file_format, samples=of_head)
    return files


def measure_latency(files: Files, *, repeats: int, warm_up: int) -> list[dict[str, Any]]:
    """Of both networks at both sizes, in every variant."""
    folder = ROOT / "samples" / "drone"
    names = ("source.png", "target.png", "imu.json", "camera.json")
    sample, _ = load_pair(PairFiles(*(folder / name for name in names)), limits=ImageLimits())
    detector = AnomalyDetector.from_checkpoint(files.network, with_evidence=False, threads=1)
    model = read_checkpoint(files.network)[1].model
    rows = []
    for width, height in SIZES:
        pair = make_case(sample, width, height, "pinhole").pair
        given, (cues, _) = prepare(pair, model), detector.cues(detector.as_judged(pair, for_head=True))
        calls: dict[str, dict[str, Callable[[], object]]] = {"network": {}, "evidence head": {}}
        for one in variants():
            network = load_runtime(files.network, runtime=one.runtime, precision=one.precision, threads=1).runtime
            head = load_evidence(files.head, runtime=one.runtime, precision=one.precision, threads=1).runtime
            calls["network"][str(one)] = partial(network.predict, given)
            calls["evidence head"][str(one)] = partial(head.judge, *cues)
        sees = {"network": given.source.shape, "evidence head": cues.photometric.shape[1:]}
        for part, by_variant in calls.items():
            about = {"part": part, "image": f"{width}x{height}", "sees": f"{sees[part][1]}x{sees[part][0]}"}
            rows.append({**about, "ms": _in_turns(by_variant, repeats=repeats, warm_up=warm_up)})
    return rows


def _in_turns(calls: Mapping[str, Callable[[], object]], *, repeats: int, warm_up: int) -> dict[str, Any]:
    taken: dict[str, list[float]] = {name: [] for name in calls}
    for repetition in range(-warm_up, repeats):
        for name, call in calls.items():
            spent_ms = milliseconds(call)
            if repetition >= 0:
                taken[name].append(spent_ms)
    medians = {name: spread(samples) for name, samples in taken.items()}
    first = medians[next(iter(medians))]["median"]
    return {name: {**row, "ratio": round(row["median"] / first, 3)} for name, row in medians.items()}


def detector_variants(files: Files) -> dict[str, AnomalyDetector]:
    """Both in float32 in each runtime, then either one in each other precision."""
    exact: Precision = "f32"
    wanted = {f"{one}": (one.runtime, exact, exact) for one in variants() if one.precision == exact}
    for one in variants():
        if one.precision != exact:
            wanted[f"{one}, evidence head"] = (one.runtime, exact, one.precision)
            wanted[f"{one}, network"] = (one.runtime, one.precision, exact)
    return {
        name: AnomalyDetector.from_checkpoint(
            files.network,
            evidence_head=files.head,
            runtime=runtime,
            network_precision=network,
            precision=head,
            threads=1,
        )
        for name, (runtime, network, head) in wanted.items()
    }


def measure_regions(files: Files, recordings: Sequence[Path], every: int) -> dict[str, Any]:
    """``evaluate detect`` of every variant on the same pairs: figures by group and variant."""
    detectors = detector_variants(files)
    methods = [DetectorMethod(name, detector) for name, detector in detectors.items()]
    measurement = measure_detection(methods, [open_labelled(path) for path in recordings], every=every)
    first = next(iter(detectors.values()))
    report = detection_report(measurement, first.model_info, first.config.model_dump(mode="json"))
    return {
        scope: {name: {key: row[key] for key in DETECTION_FIGURES} for name, row in rows.items()}
        for scope, rows in {"all": report["all"], **report["groups"]}.items()
        for rows in [{name: row for name, row in rows.items() if name in detectors}]
    }


def measure_flow(files: Files, recordings: Sequence[Path], every: int) -> dict[str, Any]:
    """``evaluate flow`` of the network in every variant: mean endpoint error by group and variant, px."""
    truths = open_truths(recordings, [1], None, movers=True)
    methods = []
    for one in variants():
        loaded = load_runtime(files.network, runtime=one.runtime, precision=one.precision, threads=1)
        methods += network_methods(str(one), loaded.runtime, loaded.record, CorrectionConfig())
    pairs = sum(len(truth) for truth in truths)
    report = flow_report(measure_flow_methods(methods, truths, max_pairs=max(1, pairs // every)), threads=1)
    wanted = {method.about.name for method in methods}
    return {
        scope: {name: row[FLOW_FIGURE] for name, row in rows.items() if name in wanted}
        for scope, rows in scopes(report).items()
    }


def losses(regions: Mapping[str, Any], flow: Mapping[str, Any]) -> dict[str, Any]:
    """The largest relative loss of each variant over the groups, beside float32 in the same runtime."""
    found: dict[str, Any] = {}
    for name in regions["all"]:
        variant = name.partition(",")[0]
        exact = f"{variant.split()[0]} f32"
        if variant == exact:
            continue
        lost = {
            f"{key} of {scope}": 1 - rows[name][key] / rows[exact][key]
            for scope, rows in regions.items()
            for key in DETECTION_FIGURES
        }
        if name.endswith("network"):
            for ending in ("", "+correction"):
                lost |= {
                    f"EPE{ending} of {scope}": rows[variant + ending] / rows[exact + ending] - 1
                    for scope, rows in flow.items()
                }
        worst = max(lost, key=lambda key: lost[key])
        found[name] = {"worst": worst, "loss": round(lost[worst], 4), "kept": lost[worst] <= MAX_LOSS}
    return found


def markdown(report: Mapping[str, Any]) -> str:
    """The tables of docs/runtimes.md."""
    names = [str(one) for one in variants()]
    lines = [f"| ms (ratio) | image | sees | {' | '.join(names)} |", "|---|---|---|" + "---|" * len(names)]
    for row in report["latency"]:
        cells = [f"{row['ms'][one]['median']:.2f} ({row['ms'][one]['ratio']:.2f})" for one in names]
        lines.append(f"| {row['part']} | {row['image']} | {row['sees']} | {' | '.join(cells)} |")
    scopes_ = list(report["regions"])
    heads = [f"{key} {scope}" for scope in scopes_ for key in DETECTION_FIGURES]
    lines += ["", f"| | {' | '.join(heads)} | largest loss | kept |", "|---|" + "---|" * (len(heads) + 2)]
    for name in report["regions"]["all"]:
        cells = [f"{report['regions'][scope][name][key]:.3f}" for scope in scopes_ for key in DETECTION_FIGURES]
        lost = report["losses"].get(name)
        cells += ["", ""] if lost is None else [f"{100 * lost['loss']:.1f} % ({lost['worst']})", str(lost["kept"])]
        lines.append(f"| {name} | {' | '.join(cells)} |")
    lines += ["", f"| EPE, px | {' | '.join(report['flow'])} |", "|---|" + "---|" * len(report["flow"])]
    for name in report["flow"]["all"]:
        lines.append(f"| {name} | {' | '.join(f'{rows[name]:.3f}' for rows in report['flow'].values())} |")
    return "\n".join(lines)


def parse_arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="What runtimes and precisions cost and gain.")
    parser.add_argument("recordings", nargs="+", type=Path, help="simulated recordings with ground truth")
    parser.add_argument("--every", type=int, default=2, help="take every n-th pair (default 2)")
    parser.add_argument("--calibration", type=Path, action="append", default=[], help="recordings for int8")
    parser.add_argument("--repeats", type=int, default=100)
    parser.add_argument("--warm-up", type=int, default=10)
    parser.add_argument("--out", type=Path, default=ROOT / "benchmarks" / "results" / "runtimes.json")
    return parser.parse_args()


def main() -> None:
    arguments = parse_arguments()
    cv2.setNumThreads(1)
    started = time.monotonic()
    try:
        with tempfile.TemporaryDirectory() as folder:
            files = export_all(Path(folder), arguments.calibration)
            latency = measure_latency(files, repeats=arguments.repeats, warm_up=arguments.warm_up)
            regions = measure_regions(files, arguments.recordings, arguments.every)
            flow = measure_flow(files, arguments.recordings, arguments.every)
    except ViflowError as err:
        raise SystemExit(f"error: {err.message} [{err.code}]") from err
    packages = ("viflow-anomaly", "torch", "openvino", "onnxruntime", "nncf")
    report = {
        **circumstances(),
        "versions": {name: version(name) for name in packages},
        "threads": 1,
        "load_1min_after": round(os.getloadavg()[0], 2),
        "repeats": arguments.repeats,
        "every": arguments.every,
        "detector": DetectorConfig().model_dump(mode="json"),
        "seconds": round(time.monotonic() - started),
        "latency": latency,
        "regions": regions,
        "flow": flow,
        "losses": losses(regions, flow),
    }
    write_atomically(arguments.out, (json.dumps(report, indent=2) + "\n").encode())
    print(markdown(report))


if __name__ == "__main__":
    main()

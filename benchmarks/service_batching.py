"""Whether several pairs in one network call cost less on a CPU than one by one: why the service's workers take one.

The exported networks hold one pair, so this traces both anew for each number of pairs, with the bundled weights, and
runs them in OpenVINO on one thread as the detector does. The repetitions alternate, so that load meets all of them.

    python benchmarks/service_batching.py --out benchmarks/results/service-batching.json
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import logging
import os
import platform
import tempfile
import time
import warnings
from collections.abc import Callable
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # read once, when torch loads

import numpy as np
import openvino
import torch
from torch import nn

from viflow_anomaly.checkpoint import load_checkpoint, load_evidence_head
from viflow_anomaly.checkpoint_record import (
    bundled_checkpoint,
    bundled_evidence_head,
    source_commit,
    write_atomically,
)
from viflow_anomaly.evaluation.flow_report import cpu_model

ROOT = Path(__file__).resolve().parents[1]
BATCHES = (1, 2, 4)
VIEW = (128, 192)
"""Rows and columns of the network's view."""
IMAGES = ((256, 384), (480, 768))
"""Of the source image, padded as the head wants it."""


class Tensors(nn.Module):
    """The network with a flat tuple of outputs, as ONNX wants it."""

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network = network

    def forward(self, *inputs: torch.Tensor) -> tuple[torch.Tensor, ...]:
        output = self.network(*inputs)
        return (output.flow_px,) if output.scene is None else (output.flow_px, *output.scene)


def compiled(network: nn.Module, inputs: tuple[torch.Tensor, ...], precision: str) -> Callable[[], object]:
    """A call that runs ``network`` on ``inputs`` in OpenVINO, as ``OpenvinoNetwork`` sets it up."""
    quiet = logging.getLogger("torch.onnx")
    quiet.setLevel(logging.ERROR)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "network.onnx"
        with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()), torch.no_grad():
            warnings.simplefilter("ignore")
            program = torch.onnx.export(network.eval(), inputs, dynamo=True, opset_version=20, external_data=False)
        if program is None:
            raise SystemExit("error: expected an ONNX program of the exporter, found none")
        program.save(str(path))
        core = openvino.Core()
        options = {"INFERENCE_PRECISION_HINT": precision, "INFERENCE_NUM_THREADS": 1, "NUM_STREAMS": 0}
        model = core.compile_model(core.read_model(path), "CPU", options | {"ENABLE_CPU_PINNING": False})
    request = model.create_infer_request()
    for port, tensor in zip(model.inputs, inputs, strict=True):
        np.copyto(request.get_tensor(port).data, tensor.numpy())

    def run() -> object:
        return request.infer()

    return run


def measure(name: str, make: Callable[[int], Callable[[], object]], repeats: int) -> dict[str, Any]:
    """Milliseconds a pair for each number of pairs in one call: the least (load disturbs it least) and the median."""
    calls = {count: make(count) for count in BATCHES}
    times: dict[int, list[float]] = {count: [] for count in BATCHES}
    for repetition in range(-3, repeats):
        for count, call in calls.items():
            started = time.perf_counter()
            call()
            if repetition >= 0:
                times[count].append((time.perf_counter() - started) * 1e3 / count)
    least = {str(count): round(min(taken), 3) for count, taken in times.items()}
    median = {str(count): round(float(np.median(taken)), 3) for count, taken in times.items()}
    best = min(times, key=lambda count: min(times[count]))
    print(f"{name}: ms a pair, least {least}, median {median}")
    gain = round(1 - least[str(best)] / least["1"], 3)
    return {"network": name, "ms_a_pair_least": least, "ms_a_pair_median": median, "best": best, "best_gain": gain}


def main() -> None:
    parser = argparse.ArgumentParser(description="One pair or several in one network call, on one thread.")
    parser.add_argument("--out", type=Path, default=ROOT / "benchmarks" / "results" / "service-batching.json")
    parser.add_argument("--repeats", type=int, default=30, help="of each (default 30)")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    network, record = load_checkpoint(bundled_checkpoint())
    head, head_record = load_evidence_head(bundled_evidence_head())
    has_bfloat16 = "BF16" in openvino.Core().get_property("CPU", "OPTIMIZATION_CAPABILITIES")
    precision = "bf16" if has_bfloat16 else "f32"
    wrapped = Tensors(network)

    def view(count: int) -> Callable[[], object]:
        samples = torch.zeros(count, record.model.motion_window.rows, 6)
        inputs = (torch.rand(count, 1, *VIEW), samples, torch.full((count,), 0.05))
        return compiled(wrapped, inputs, "f32")

    def judging(height: int, width: int) -> Callable[[int], Callable[[], object]]:
        def make(count: int) -> Callable[[], object]:
            photometric = torch.rand(count, len(head_record.photometric_cues), height, width)
            geometric = torch.rand(count, len(head_record.geometric_cues), height // 4, width // 4)
            return compiled(head, (photometric, geometric), precision)

        return make

    load_before = os.getloadavg()[0]
    results = [measure(f"network, view {VIEW[1]}x{VIEW[0]}", view, arguments.repeats)]
    for height, width in IMAGES:
        results.append(measure(f"evidence head, {width}x{height}", judging(height, width), arguments.repeats))
    report = {
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "commit": source_commit(),
        "cpu": cpu_model(),
        "cores": os.cpu_count(),
        "threads": 1,
        "head_precision": precision,
        "load_1min_before": round(load_before, 2),
        "python": platform.python_version(),
        "versions": {name: version(name) for name in ("viflow-anomaly", "torch", "openvino")},
        "repeats": arguments.repeats,
        "results": results,
    }
    write_atomically(arguments.out, (json.dumps(report, indent=2) + "\n").encode())


if __name__ == "__main__":
    main()

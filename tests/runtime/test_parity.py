"""The gate: every runtime gives the bundled model's flow and regions; what bfloat16 and int8 may cost is stated here.

The pairs are fixed: those of the bundled sample, and ones that are made of it: odd sizes, a pasted mover, no camera,
standing still.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import get_args

import numpy as np
import pytest

from viflow_anomaly.checkpoint_record import bundled_checkpoint, bundled_evidence_head, read_checkpoint
from viflow_anomaly.config import ImageLimits, Precision, RuntimeName
from viflow_anomaly.datasets.pairing import RecordingPairs
from viflow_anomaly.datasets.registry import open_recording
from viflow_anomaly.detection import Detection
from viflow_anomaly.detector import AnomalyDetector
from viflow_anomaly.evidence_cues import EvidenceCues
from viflow_anomaly.export_samples import head_samples
from viflow_anomaly.geometry import Float32Array
from viflow_anomaly.model_input import ModelInput, prepare
from viflow_anomaly.moving_regions import sigmoid
from viflow_anomaly.regions import BoundingBox
from viflow_anomaly.runtime.export import export_head
from viflow_anomaly.runtime.loading import load_evidence, load_runtime
from viflow_anomaly.sensor_data import Frame, FramePair, ImuSamples

for package, extra in (("openvino", "openvino"), ("onnxruntime", "onnxruntime"), ("onnxscript", "export")):
    pytest.importorskip(package, reason=f"the extra {extra!r} is not installed")

SAMPLE = Path(__file__).parents[2] / "samples" / "drone"
OTHERS: list[RuntimeName] = [name for name in get_args(RuntimeName) if name not in ("auto", "torch")]
MAX_FLOW_DIFFERENCE_PX = 1e-3
MAX_SIDE_DIFFERENCE_PX, MAX_SCORE_DIFFERENCE = 2, 0.01
MAX_SCORE_DIFFERENCE_OF_ANOTHER_BOX = 0.1
"""A pixel more makes another shape of a thing of sixty, and its shape is what a score is of."""
MIN_SAME_SHARE = 0.85
"""Of all regions, that are the same to the pixel, with scores as near as ``SAME_SCORE``. Sums in another order (another
CPU) move the flow by a thousandth of a pixel; a gray level of the reconstruction may be rounded the other way for that,
and inverse search on it end elsewhere in a few blocks."""
SAME_SCORE = 1e-3
MAX_BFLOAT16_FLOW_PX = 0.02
"""In the mean over a pair's flow, of the network."""
MAX_PROBABILITY_LOSS = {"bf16": 0.005, "int8": 0.02}
"""In the mean over a pair's pixels, of the evidence head."""
PRECISIONS: tuple[Precision, ...] = ("f32", "bf16")
SIZES = [(255, 383), (97, 211), (129, 161), (224, 224)]


def sample(index: int) -> FramePair:
    return RecordingPairs(open_recording(SAMPLE, limits=ImageLimits()))[index]


def cropped(height: int, width: int, *, known: bool) -> FramePair:
    """The sample's middle, with a square of the source's corner that moves 5 px by itself."""
    pair = sample(0)
    top, left = ((whole - part) // 2 for whole, part in zip(pair.source.image.shape, (height, width), strict=True))
    frames = []
    side = height // 4
    for frame, x in ((pair.source, width // 2), (pair.target, width // 2 + 5)):
        image = frame.image[top : top + height, left : left + width].copy()
        image[side : 2 * side, x : x + side] = pair.source.image[:side, :side]
        frames.append(Frame(frame.timestamp_ns, image))
    camera = pair.camera
    assert camera is not None
    camera = replace(camera, cx=camera.cx - left, cy=camera.cy - top, width=width, height=height)
    return FramePair(*frames, pair.imu, camera if known else None)


def standing_still() -> FramePair:
    """One image twice, no turn, gravity alone."""
    pair = cropped(128, 192, known=True)
    imu, still = pair.imu, np.zeros_like(pair.imu.gyro_rad_s)
    imu = ImuSamples(imu.timestamps_ns, still, still + np.array([0.0, 0.0, 9.81]))
    return FramePair(pair.source, Frame(pair.target.timestamp_ns, pair.source.image), imu, pair.camera)


CASES: dict[str, Callable[[], FramePair]] = {
    **{f"sample {index}": partial(sample, index) for index in range(3)},
    **{f"{height}x{width}": partial(cropped, height, width, known=True) for height, width in SIZES},
    **{f"{height}x{width} no camera": partial(cropped, height, width, known=False) for height, width in SIZES[:2]},
    "standing still": standing_still,
}


@cache
def case(name: str) -> FramePair:
    return CASES[name]()


def given(name: str) -> ModelInput:
    return prepare(case(name), read_checkpoint(bundled_checkpoint())[1].model)


@cache
def detector(runtime: RuntimeName) -> AnomalyDetector:
    return AnomalyDetector.from_checkpoint(runtime=runtime, threads=1, precision="f32", network_precision="f32")


@cache
def expected(name: str) -> Detection:
    return detector("torch").detect(case(name))


@cache
def cues(name: str) -> EvidenceCues:
    return detector("torch").cues(case(name))[0]


def test_the_cases_are_worth_comparing() -> None:
    assert sum(len(expected(name).rois) for name in CASES) >= 8
    assert all(expected(name).status == "ok" for name in CASES)


@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize("runtime", OTHERS)
def test_the_flow_is_torchs(runtime: RuntimeName, name: str) -> None:
    reference, found = (load_runtime(None, runtime=one).runtime.predict(given(name)) for one in ("torch", runtime))
    assert np.isfinite(found.flow_px).all()
    assert found.stride == reference.stride
    np.testing.assert_allclose(found.flow_px, reference.flow_px, rtol=0, atol=MAX_FLOW_DIFFERENCE_PX)
    assert found.scene is not None
    assert reference.scene is not None
    for ours, theirs in zip(found.scene, reference.scene, strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize("runtime", OTHERS)
def test_the_regions_are_torchs(runtime: RuntimeName, name: str) -> None:
    found = detector(runtime).detect(case(name))
    assert (found.status, found.model) == (expected(name).status, expected(name).model)
    assert [one.label for one in found.rois] == [one.label for one in expected(name).rois]
    sides = (np.array([corners(one.bbox) for one in answer.rois]) for answer in (found, expected(name)))
    np.testing.assert_allclose(*sides, rtol=0, atol=MAX_SIDE_DIFFERENCE_PX)
    for ours, theirs in zip(found.rois, expected(name).rois, strict=True):
        same_box = ours.bbox == theirs.bbox
        limit = MAX_SCORE_DIFFERENCE if same_box else MAX_SCORE_DIFFERENCE_OF_ANOTHER_BOX
        assert ours.score == pytest.approx(theirs.score, abs=limit)


@pytest.mark.parametrize("runtime", OTHERS)
def test_nearly_all_regions_are_torchs_to_the_pixel(runtime: RuntimeName) -> None:
    same = [
        ours.bbox == theirs.bbox and abs(ours.score - theirs.score) <= SAME_SCORE
        for name in CASES
        for ours, theirs in zip(detector(runtime).detect(case(name)).rois, expected(name).rois, strict=True)
    ]
    assert sum(same) >= MIN_SAME_SHARE * len(same)


def corners(box: BoundingBox) -> tuple[int, int, int, int]:
    return box.x, box.y, box.x + box.width, box.y + box.height


def require_bfloat16(precision: Precision) -> None:
    """Not every CPU computes in it; OpenVINO then refuses."""
    import openvino  # noqa: PLC0415 - skipped above where it is not installed

    if precision == "bf16" and "BF16" not in openvino.Core().get_property("CPU", "OPTIMIZATION_CAPABILITIES"):
        pytest.skip("this CPU does not compute in bfloat16")


@pytest.mark.parametrize("name", CASES)
def test_bfloat16_flow_is_within_its_loss(name: str) -> None:
    require_bfloat16("bf16")
    exact, rough = (
        load_runtime(None, runtime="openvino", precision=precision).runtime.predict(given(name)).flow_px
        for precision in PRECISIONS
    )
    assert np.abs(exact - rough).mean() <= MAX_BFLOAT16_FLOW_PX


@pytest.fixture(scope="module")
def head(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The bundled evidence head with its int8 exports, calibrated on the bundled sample."""
    pytest.importorskip("nncf", reason="the extra 'int8' is not installed")
    bundled, folder = bundled_evidence_head(), tmp_path_factory.mktemp("int8")
    for suffix in (".safetensors", ".json", ".onnx"):
        shutil.copy(bundled.with_suffix(suffix), folder)
    path = folder / bundled.name
    samples = head_samples([SAMPLE], detector("torch"), ImageLimits())
    assert export_head(path, samples=samples) == path.with_suffix(".int8.onnx")
    assert export_head(path, file_format="openvino", samples=samples) == path.with_suffix(".int8.xml")
    return path


@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize(
    ("runtime", "precision"), [("openvino", "bf16"), ("openvino", "int8"), ("onnxruntime", "int8"), ("torch", "bf16")]
)
def test_probabilities_are_within_the_loss_of_their_precision(
    head: Path, runtime: RuntimeName, precision: Precision, name: str
) -> None:
    if runtime == "openvino":
        require_bfloat16(precision)
    loaded = load_evidence(head, runtime=runtime, precision=precision).runtime
    assert loaded.backend == (runtime, "cpu", precision)
    exact = load_evidence(None, runtime="torch", precision="f32").runtime.judge(*cues(name))
    difference = probability(exact) - probability(loaded.judge(*cues(name)))
    assert np.abs(difference).mean() <= MAX_PROBABILITY_LOSS[precision]


def probability(logits: Float32Array) -> Float32Array:
    return sigmoid(np.ascontiguousarray(logits[0]))

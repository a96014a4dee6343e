"""The one inference path: FramePair -> Detection. Command line, batch and service all come through here."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Self

import numpy as np
from numpy.typing import NDArray

from viflow_anomaly.alignment import Alignment, align, remaining_evidence
from viflow_anomaly.analysis import Analysis
from viflow_anomaly.checkpoint_record import CheckpointRecord
from viflow_anomaly.config import DetectorConfig, MotorSource, Precision, RuntimeName
from viflow_anomaly.detection import (
    AnalyzedRegion,
    Detection,
    ImageSize,
    ModelInfo,
    Reason,
    ResidualSummary,
    Roi,
    rois_from_regions,
)
from viflow_anomaly.errors import ConfigError
from viflow_anomaly.evidence_cues import EvidenceCues, evidence_cues
from viflow_anomaly.explanation import Explanation, explain
from viflow_anomaly.geometry import Float32Array
from viflow_anomaly.internal_size import InternalSize, internal_size
from viflow_anomaly.model_input import prepare
from viflow_anomaly.motion_evidence import (
    JudgedCues,
    judge_cues,
    knows_depth,
    regions_of,
    require_our_cues,
    takes_head,
    will_know_depth,
)
from viflow_anomaly.motion_input import MotionWindow
from viflow_anomaly.pair_detector import Execution, LoadedWeights
from viflow_anomaly.pair_quality import Finding, judge_correction, judge_images, judge_window, reasons_in_order
from viflow_anomaly.prediction import PredictedFlow, predict_flow
from viflow_anomaly.regions import BoundingBox
from viflow_anomaly.runtime.interface import Runtime
from viflow_anomaly.runtime.loading import LoadedEvidence, load_evidence, load_runtime
from viflow_anomaly.sensor_data import FramePair

RESIDUAL_SAMPLE_STRIDE = 3
"""The residual's summary is taken on every third row and column."""
NOTHING_IN_COMMON = Reason(
    code="no_overlap",
    message="expected the two images to share a part of the scene, found a predicted motion that leaves hardly any",
)


NOT_FINITE = Reason(
    code="prediction_not_finite",
    message="expected finite numbers from the network, found others: its weights are damaged, or its input is absurd",
)


HEAD_NOT_FINITE = Reason(
    code="prediction_not_finite",
    message="expected finite numbers from the evidence head, found others: its weights are damaged",
)


class AnomalyDetector:
    """Finds independent motion. Holds weights and configuration only, so that threads may share it.

    ``model_info`` is the network's; an evidence head that takes part is told behind the version's plus.

    Args:
        runtime: of the network.
        record: where the network came from and what its input looks like.
        config: thresholds and shape rule.
        evidence: the evidence head, None: regions are found in the residual.

    Raises:
        ConfigError: ``evidence_head_missing`` where the configuration asks for one.
    """

    def __init__(
        self,
        runtime: Runtime,
        record: CheckpointRecord,
        *,
        config: DetectorConfig,
        evidence: LoadedEvidence | None = None,
    ) -> None:
        if config.evidence == "learned" and evidence is None:
            raise ConfigError(
                "evidence: expected an evidence head for 'learned', found none loaded; 'residual' and 'auto' need none",
                code="evidence_head_missing",
                field="detector.evidence",
            )
        self._runtime = runtime
        self._record = record
        self._evidence = evidence
        self.config = config
        version = record.version
        if evidence is not None and config.evidence != "residual":
            version += f"+{evidence.record.name}.{evidence.record.sha256[:12]}"
        self.model_info = ModelInfo(name=record.name, version=version, sha256=record.sha256)

    @classmethod
    def from_checkpoint(
        cls,
        path: Path | None = None,
        *,
        config: DetectorConfig | None = None,
        device: str = "cpu",
        runtime: RuntimeName = "auto",
        threads: int | None = None,
        evidence_head: Path | None = None,
        with_evidence: bool = True,
        precision: Precision = "auto",
        network_precision: Precision = "auto",
    ) -> Self:
        """Load a checkpoint (None: the bundled model) and an evidence head.

        Args:
            path: a ``.safetensors`` file with its ``.json`` beside it.
            config: thresholds and shape rule.
            device: "cpu", or a torch device name; ONNX Runtime knows "cuda" and "cuda:N", too.
            runtime: "auto" takes OpenVINO, else ONNX Runtime, where it is installed and the checkpoint was exported,
                else torch.
            threads: CPU threads of the network (torch: of the whole process); None: torch's own, one elsewhere.
            evidence_head: a ``.safetensors`` file likewise; None: the bundled one.
            with_evidence: False: none is loaded, and regions are found in the residual; nor is one for a configuration
                that takes the residual.
            precision: of the evidence head; "f32" answers alike in all runtimes.
            network_precision: likewise of the network.

        Raises:
            CheckpointError: as ``load_runtime``; ``evidence_cues_differ`` for a head of other cues than this version's.
            ConfigError: ``device_unavailable``, ``runtime_unavailable``, ``precision_unavailable``.
        """
        loaded, record = load_runtime(
            path, runtime=runtime, device=device, threads=threads, precision=network_precision
        )
        evidence, config = None, config or DetectorConfig()
        if with_evidence and config.evidence != "residual":
            evidence = load_evidence(
                evidence_head, runtime=runtime, device=device, threads=threads, precision=precision
            )
            require_our_cues(evidence.record)
        return cls(loaded, record, config=config, evidence=evidence)

    @property
    def runtime(self) -> str:
        """What runs the network: ``torch``, ``openvino`` or ``onnxruntime``."""
        return self._runtime.backend.runtime

    @property
    def execution(self) -> Execution:
        """What runs the network, and the evidence head where one takes part."""
        takes_part = self._evidence is not None and self.config.evidence != "residual"
        evidence = self._evidence.runtime.backend if self._evidence is not None and takes_part else None
        return Execution(self._runtime.backend, evidence)

    @property
    def loaded_weights(self) -> tuple[LoadedWeights, ...]:
        """The network, and the evidence head where one takes part."""
        record, (network, evidence) = self._record, self.execution
        found = [
            LoadedWeights("network", record.name, record.version, record.sha256, record.model.preset, network),
        ]
        if self._evidence is not None and evidence is not None:
            head = self._evidence.record
            found.append(LoadedWeights("evidence_head", head.name, head.version, head.sha256, None, evidence))
        return tuple(found)

    @property
    def motor_source(self) -> MotorSource | None:
        """What the pairs' ``motor_command`` must hold; None: the model has no motor stream and looks at none."""
        return self._record.model.motor_source

    def with_config(self, config: DetectorConfig) -> AnomalyDetector:
        """The same weights under another configuration; nothing is loaded or copied."""
        return AnomalyDetector(self._runtime, self._record, config=config, evidence=self._evidence)

    def with_evidence(self, evidence: LoadedEvidence) -> AnomalyDetector:
        """The same network and configuration with another evidence head.

        Raises:
            CheckpointError: ``evidence_cues_differ``.
        """
        require_our_cues(evidence.record)
        return AnomalyDetector(self._runtime, self._record, config=self.config, evidence=evidence)

    def detect(self, pair: FramePair, *, decode_ms: float = 0.0) -> Detection:
        """Judge one pair.

        Raises:
            InvalidInputError: as ``prepare``: the pair's IMU or image cannot be used at all. A pair that merely
                cannot be judged gives a detection with status ``abstained``.
        """
        return self.analyze(pair, decode_ms=decode_ms).detection

    def analyze(self, pair: FramePair, *, decode_ms: float = 0.0) -> Analysis:
        """``detect`` with its maps; same errors. The paper's algorithm on one screen."""
        started = time.perf_counter()
        size = self.internal_size(pair)
        explained, alignment = self._explain(pair if size is None else size.reduce(pair))
        summary = self._summary(explained)
        findings = self._findings(pair, explained, shares_scene=summary is not None)
        abstained = any(finding.abstain for finding in findings)
        judged = None if abstained else self._judge(explained, alignment)
        if judged is not None and not judged.maps.finite:
            findings, abstained = (*findings, Finding(HEAD_NOT_FINITE, abstain=True)), True
        inferred = time.perf_counter()
        height, width = pair.source.image.shape
        image = ImageSize(width=width, height=height)
        rois = () if abstained else self._rois(explained, judged, image, size)
        finished = time.perf_counter()
        timings_ms = {
            "decode": decode_ms,
            "inference": (inferred - started) * 1e3,
            "regions": (finished - inferred) * 1e3,
            "total": decode_ms + (finished - started) * 1e3,
        }
        analyzed = BoundingBox(*explained.model_input.view.region())
        analyzed = analyzed if size is None else size.box(analyzed)
        detection = Detection(
            source_timestamp_ns=pair.source.timestamp_ns,
            target_timestamp_ns=pair.target.timestamp_ns,
            image=image,
            status="abstained" if abstained else "ok",
            reasons=reasons_in_order(findings),
            model=self.model_info,
            rois=rois,
            region_analyzed=AnalyzedRegion(**analyzed._asdict()),
            residual=summary,
            timings_ms=timings_ms,
        )
        learned = alignment is not None
        nothing = np.zeros_like(explained.residual) if learned else explained.normalised
        found_in = nothing if judged is None else judged.maps.motion
        return Analysis(detection, explained, found_in, learned, size)

    def internal_size(self, pair: FramePair, *, for_head: bool = False) -> InternalSize | None:
        """At what size the pair is judged; None: its own, always where no evidence head takes part.

        Args:
            for_head: as if one did.
        """
        model = self._record.model
        takes_part = for_head or takes_head(
            self._evidence, self.config, depth_is_known=will_know_depth(model, self.config)
        )
        if model.view.mode == "center_crop" or not takes_part:
            return None
        height, width = pair.source.image.shape
        return internal_size(width, height, self.config.internal_short_side_px, pair.camera)

    def as_judged(self, pair: FramePair, *, for_head: bool = False) -> FramePair:
        """The pair at its ``internal_size``."""
        size = self.internal_size(pair, for_head=for_head)
        return pair if size is None else size.reduce(pair)

    def _rois(
        self, explained: Explanation, judged: JudgedCues | None, image: ImageSize, size: InternalSize | None
    ) -> tuple[Roi, ...]:
        """In source pixels."""
        regions = regions_of(explained, judged, self._evidence, self.config)
        return rois_from_regions(
            regions if size is None else [size.region(region) for region in regions],
            image,
            include_masks=self.config.include_masks,
            target_coordinates=explained.target_coordinates,
            step_px=(1.0, 1.0) if size is None else size.step_px,
        )

    def _findings(self, pair: FramePair, explained: Explanation, *, shares_scene: bool) -> tuple[Finding, ...]:
        """What can be said against the pair, and whether it can be judged at all."""
        window, predicted = explained.model_input.window, explained.predicted
        findings = _judge_input(pair, window, self.config)
        if not shares_scene:
            finite = bool(np.isfinite(predicted.flow_px).all())
            return (*findings, Finding(NOTHING_IN_COMMON if finite else NOT_FINITE, abstain=True))
        if any(finding.abstain for finding in findings):
            return findings
        return (*findings, *_doubts(predicted, window, self.config))

    def _summary(self, explained: Explanation) -> ResidualSummary | None:
        """None where hardly anything of what is analysed is still in the target image."""
        _, _, width, height = explained.model_input.view.region()
        return _summary(explained.residual, explained.inside, self.config.min_overlap, width * height)

    def judge_cues(self, pair: FramePair) -> tuple[JudgedCues, NDArray[np.bool_]] | None:
        """What the head says of a pair, and which pixels are inside; None where regions come from the residual.

        Maps are of the pair's ``internal_size``.

        Raises:
            InvalidInputError: as ``detect``.
        """
        explained, alignment = self._explain(self.as_judged(pair))
        judged = self._judge(explained, alignment)
        return None if judged is None else (judged, explained.inside)

    def cues(self, pair: FramePair) -> tuple[EvidenceCues, NDArray[np.bool_]]:
        """What an evidence head learns from: the cues of a pair at its own size, and which pixels [H, W] are inside.

        Errors as ``detect``.
        """
        explained, alignment = self._explain(pair, for_head=True)
        assert alignment is not None
        return evidence_cues(remaining_evidence(explained, alignment)), explained.inside

    def _judge(self, explained: Explanation, alignment: Alignment | None) -> JudgedCues | None:
        """What the head makes of it; None: regions are found in the residual."""
        if self._evidence is None or alignment is None:
            return None
        return judge_cues(self._evidence, evidence_cues(remaining_evidence(explained, alignment)), explained)

    def _explain(self, pair: FramePair, *, for_head: bool = False) -> tuple[Explanation, Alignment | None]:
        """Predict the static world's flow, and see what it leaves unexplained; aligned where the head judges."""
        model_input = prepare(pair, self._record.model)
        focal_px = self._record.model.view.focal_px
        predicted = predict_flow(self._runtime, model_input, self.config.correction, focal_px=focal_px)
        if not for_head and not takes_head(self._evidence, self.config, depth_is_known=knows_depth(predicted)):
            return explain(pair, model_input, predicted, self.config), None
        alignment = align(pair, model_input, predicted, focal_px=focal_px)
        coordinates = alignment.target_coordinates
        return explain(pair, model_input, predicted, self.config, coordinates=coordinates), alignment


def _judge_input(pair: FramePair, window: MotionWindow, config: DetectorConfig) -> tuple[Finding, ...]:
    """What can be said against the pair before anything is predicted."""
    of_images = judge_images(pair.source.image, pair.target.image, window, config)
    return (*judge_window(window), *of_images)


def _doubts(predicted: PredictedFlow, window: MotionWindow, config: DetectorConfig) -> tuple[Finding, ...]:
    """What the correction says against the pair; nothing with correction off."""
    if predicted.correction is None or predicted.measured is None:
        return ()
    return judge_correction(predicted.correction, predicted.measured, window.interval_s, config)


def _summary(
    residual: Float32Array, inside: NDArray[np.bool_], min_share: float, analyzed_px: int
) -> ResidualSummary | None:
    """None where less than ``min_share`` of the analysed pixels are still in the target image."""
    min_values = min_share * analyzed_px / RESIDUAL_SAMPLE_STRIDE**2
    thin = (slice(None, None, RESIDUAL_SAMPLE_STRIDE),) * 2
    values = residual[thin][inside[thin]]
    if values.size == 0 or values.size < min_values:
        return None
    mean = float(values.mean())
    ranks = [int(share * (values.size - 1)) for share in (0.5, 0.95)]
    values.partition(ranks)
    median, p95 = (float(values[rank]) for rank in ranks)
    return ResidualSummary(mean=mean, median=median, p95=p95)

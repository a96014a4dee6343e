"""What every runtime answers, and how one is asked. No backend is imported here."""

from __future__ import annotations

from typing import NamedTuple, Protocol

from viflow_anomaly.correction import RigidMotion
from viflow_anomaly.geometry import Float32Array
from viflow_anomaly.model_input import ModelInput
from viflow_anomaly.pair_detector import Backend
from viflow_anomaly.sensor_data import Float64Array


class Scene(NamedTuple):
    """What a calibrated network says of the static world and the camera.

    Attributes:
        inverse_depth: [h, w] float32, mean 1: its unit and the translations' go together.
        rotation: [3, 3], maps source-camera to target-camera coordinates.
        translations: [K, 3], one for each hypothesis.
    """

    inverse_depth: Float32Array
    rotation: Float64Array
    translations: Float64Array

    def motion(self, hypothesis: int) -> RigidMotion:
        """The camera motion of one hypothesis."""
        return RigidMotion(self.rotation, self.translations[hypothesis])


class Hypotheses(NamedTuple):
    """A network's answer to one pair.

    Attributes:
        flow_px: [K, h, w, 2] float32 in view pixels; cells as in ``ViflowOutput``.
        stride: view pixels for one cell.
        scene: where the network knows it (preset ``calibrated``).
    """

    flow_px: Float32Array
    stride: int
    scene: Scene | None


class Runtime(Protocol):
    """Runs one network. Holds weights only, so that threads may share it."""

    @property
    def backend(self) -> Backend:
        """What runs it, on which device, in which precision."""

    def predict(self, model_input: ModelInput) -> Hypotheses:
        """All hypotheses of one pair."""


class HeadAnswer(NamedTuple):
    """An evidence head's answer to one pair, of the padded image.

    Attributes:
        logits: [2, H', W'] float32 of motion and of seam.
        offsets: [2, H' / 4, W' / 4] float32 from every block to the middle of its thing, in blocks (y, x).
    """

    logits: Float32Array
    offsets: Float32Array


class EvidenceRuntime(Protocol):
    """Runs one evidence head; threads may share it, too."""

    @property
    def backend(self) -> Backend:
        """As ``Runtime.backend``."""

    def judge(self, photometric: Float32Array, geometric: Float32Array) -> HeadAnswer:
        """For cues [3, H', W'] and [13, H' / 4, W' / 4]."""

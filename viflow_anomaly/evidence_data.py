"""What an evidence head learns from: cues of labelled pairs, as bytes, one file a recording.

Cues are those that the detector itself computes, errors of its own network included; the truth is the simulator's masks
of what moves. Extracting them takes longer than a look at them, so they are kept: ``NAME.npz`` below the training's
folder holds ``photometric``, ``geometric`` (-1..1 as 0..255), ``truth`` and ``offsets`` of every pair of one recording.
"""

from __future__ import annotations

import hashlib
import io
import json
import zipfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from viflow_anomaly.checkpoint_record import write_atomically
from viflow_anomaly.config import EVIDENCE_BLOCK_PX, EvidenceTrainingConfig
from viflow_anomaly.detector import AnomalyDetector
from viflow_anomaly.errors import DatasetError, InvalidInputError
from viflow_anomaly.evaluation.flow_truth import RecordingTruth
from viflow_anomaly.evaluation.perturbed_pairs import Perturbation, unperturbed
from viflow_anomaly.evidence_augmentation import NO_AUGMENT, Augment
from viflow_anomaly.evidence_cues import CUES_VERSION, GEOMETRIC_CUES, PHOTOMETRIC_CUES
from viflow_anomaly.evidence_truth import IGNORED, MOVING, Scene, offsets_of, scene_of, truth_of
from viflow_anomaly.geometry import Float32Array
from viflow_anomaly.sensor_data import Uint8Array

BYTE_SCALE = np.float32(127.5)
TRIES = 3
"""A crop without a mover is drawn anew this often: most of a picture rests."""
Bytes = NDArray[Any]
"""uint8, or int8 for offsets."""
ACROSS = [k for k, name in enumerate(GEOMETRIC_CUES) if name.endswith("across")]


class EvidenceBatch(NamedTuple):
    """photometric [B, 3, h, w] and geometric [B, 13, h/4, w/4] float32 in -1..1, truth [B, h, w] uint8, offsets
    [B, 2, h/4, w/4] int8 in blocks."""

    photometric: Float32Array
    geometric: Float32Array
    truth: Uint8Array
    offsets: Bytes


class Example(NamedTuple):
    """One pair, or a crop of one: photometric [3, H, W], geometric [13, H/4, W/4], truth [H, W] of bits, offsets
    [2, H/4, W/4] from each block to the middle of the thing it belongs to, in blocks (y, x)."""

    photometric: Bytes
    geometric: Bytes
    truth: Bytes
    offsets: Bytes


@dataclass(frozen=True, eq=False)
class Examples:
    """The pairs of one recording; arrays as in ``Example``, with N in front."""

    photometric: Bytes
    geometric: Bytes
    truth: Bytes
    offsets: Bytes

    def __len__(self) -> int:
        return len(self.truth)


def extract_examples(
    detector: AnomalyDetector, path: Path, *, every: int = 1, perturbation: Perturbation = unperturbed
) -> Examples:
    """Cues and truth of every n-th pair of a recording with masks of what moves, seen through a perturbation and at the
    size that the detector judges it at.

    Raises:
        DatasetError: ``ground_truth_missing`` where no pair is usable; as ``RecordingTruth``.
    """
    recording = RecordingTruth(path)
    examples = []
    for index in range(0, len(recording), every):
        try:
            pair = perturbation(recording.pair(index))
            size = detector.internal_size(pair, for_head=True)
            cues, inside = detector.cues(pair if size is None else size.reduce(pair))
        except InvalidInputError:
            continue
        scene = scene_of(recording.ground_truth, pair.source.timestamp_ns)
        scene = scene if size is None else Scene(*(size.thin_out(part) for part in scene))
        seen = np.where(inside, truth_of(scene), IGNORED)
        truth = np.full(cues.photometric.shape[1:], IGNORED, dtype=np.uint8)
        truth[: seen.shape[0], : seen.shape[1]] = seen
        offsets = offsets_of(scene.instances, cues.geometric.shape[1:])
        examples.append(Example(_as_bytes(cues.photometric), _as_bytes(cues.geometric), truth, offsets))
    if not examples:
        raise DatasetError(
            f"{path}: expected a pair that can be judged, found none", code="ground_truth_missing", field="data"
        )
    return Examples(*(np.stack([one[k] for one in examples]) for k in range(len(Example._fields))))


def _as_bytes(cues: Float32Array) -> Uint8Array:
    return np.asarray(np.rint((cues + 1) * BYTE_SCALE), dtype=np.uint8)


def kept_examples(
    detector: AnomalyDetector, path: Path, folder: Path, *, every: int = 1, augment: Augment = NO_AUGMENT
) -> Examples:
    """``extract_examples``, kept in ``folder``; what an earlier run left there is read if it would be the same.

    Raises:
        DatasetError: as ``extract_examples``; ``evidence_data_malformed`` for a file there that is none of these.
    """
    detector = _at_size(detector, path, augment)
    kept, about = folder / f"{path.name}.npz", _made_with(detector, path, every, augment)
    if kept.exists():
        examples = _read_kept(kept, about)
        if examples is not None:
            return examples
    examples = extract_examples(detector, path, every=every, perturbation=augment.of(path.name))
    buffer = io.BytesIO()
    np.savez(buffer, about=np.array(about), **{name: getattr(examples, name) for name in Example._fields})
    write_atomically(kept, buffer.getvalue())
    return examples


def _at_size(detector: AnomalyDetector, path: Path, augment: Augment) -> AnomalyDetector:
    """The detector as it judges this recording: at its internal size or, for the recordings drawn, with all pixels."""
    if not augment.at_own_size(path.name):
        return detector
    return detector.with_config(detector.config.model_copy(update={"internal_short_side_px": 0}))


def _made_with(detector: AnomalyDetector, path: Path, every: int, augment: Augment) -> str:
    """All that the cues of a recording depend on; of the recording itself the names and sizes of its files."""
    files = sorted((str(one.relative_to(path)), one.stat().st_size) for one in path.rglob("*") if one.is_file())
    about = {
        **cues_settings(detector),
        "augment": augment,
        "every": every,
        "files": hashlib.sha256(json.dumps(files).encode()).hexdigest(),
    }
    return json.dumps(about, sort_keys=True)


def cues_settings(detector: AnomalyDetector) -> dict[str, Any]:
    """What of a detector its cues depend on: its network, their version and the settings that they are made with."""
    config = detector.config
    return {
        "model": detector.model_info.sha256,
        "cues": [*PHOTOMETRIC_CUES, *GEOMETRIC_CUES],
        "cues_version": CUES_VERSION,
        "correction": config.correction.model_dump(mode="json"),
        "texture_softening_gray": config.regions.texture_softening_gray,
        "residual": config.residual,
        "photometric_compensation": config.photometric_compensation,
        "internal_short_side_px": config.internal_short_side_px,
    }


def _read_kept(kept: Path, about: str) -> Examples | None:
    """None where it was made otherwise."""
    try:
        with np.load(io.BytesIO(kept.read_bytes()), allow_pickle=False) as arrays:
            if str(arrays["about"]) != about:
                return None
            examples = Examples(*(arrays[name] for name in Example._fields))
        count, height, width = examples.truth.shape
    except (OSError, EOFError, ValueError, KeyError, zipfile.BadZipFile) as err:
        raise _malformed(kept, str(err)) from err
    blocks = (height // EVIDENCE_BLOCK_PX, width // EVIDENCE_BLOCK_PX)
    shapes = {
        "photometric": (count, len(PHOTOMETRIC_CUES), height, width),
        "geometric": (count, len(GEOMETRIC_CUES), *blocks),
        "offsets": (count, 2, *blocks),
    }
    for name, shape in shapes.items():
        if getattr(examples, name).shape != shape:
            raise _malformed(kept, f"{name} of shape {getattr(examples, name).shape}, not {shape}")
    return examples


def _malformed(path: Path, found: str) -> DatasetError:
    return DatasetError(
        f"{path}: expected cues of this version that an earlier run left, found: {found[:200]}; delete it to have it "
        "made anew",
        code="evidence_data_malformed",
        field="out",
    )


class EvidenceData:
    """Examples of many recordings in memory, and random crops of them.

    Args:
        examples: of at least one recording.
        config: sides of the crops and their number.
    """

    def __init__(self, examples: Sequence[Examples], config: EvidenceTrainingConfig) -> None:
        self._examples = tuple(examples)
        self._config = config
        self._ends = np.cumsum([len(one) for one in self._examples])

    def __len__(self) -> int:
        return int(self._ends[-1])

    def sample(self, step: int) -> EvidenceBatch:
        """The batch of one step, a function of the seed and the step alone; mirrored at random."""
        rng = np.random.default_rng((self._config.seed, step))
        crops = [self._crop(rng) for _ in range(self._config.batch_size)]
        whole = Example(*(np.stack([crop[k] for crop in crops]) for k in range(len(Example._fields))))
        return EvidenceBatch(_as_cues(whole.photometric), _as_cues(whole.geometric), whole.truth, whole.offsets)

    def _crop(self, rng: np.random.Generator) -> Example:
        number = int(rng.integers(self._ends[-1]))
        which = int(np.searchsorted(self._ends, number, side="right"))
        examples, index = self._examples[which], number - int(self._ends[which]) + len(self._examples[which])
        sides = (self._config.crop_height // EVIDENCE_BLOCK_PX, self._config.crop_width // EVIDENCE_BLOCK_PX)
        limits = examples.geometric.shape[2:]
        for _ in range(TRIES):
            row, column = (
                int(rng.integers(max(0, limit - side) + 1)) for limit, side in zip(limits, sides, strict=True)
            )
            blocks = (slice(row, row + sides[0]), slice(column, column + sides[1]))
            pixels = tuple(slice(one.start * EVIDENCE_BLOCK_PX, one.stop * EVIDENCE_BLOCK_PX) for one in blocks)
            truth = examples.truth[index][pixels]
            if (truth & MOVING).any():
                break
        crop = Example(
            examples.photometric[index][:, *pixels],
            examples.geometric[index][:, *blocks],
            truth,
            examples.offsets[index][:, *blocks],
        )
        return _mirrored(_filled(crop, sides), flips=rng.random(2) < 0.5)


def _filled(crop: Example, sides: tuple[int, int]) -> Example:
    """A crop of an image smaller than it is to be: beyond it nothing differs and nothing counts."""
    below, right = (side - have for side, have in zip(sides, crop.geometric.shape[1:], strict=True))
    if not below and not right:
        return crop
    pixels, blocks = ((0, below * EVIDENCE_BLOCK_PX), (0, right * EVIDENCE_BLOCK_PX)), ((0, below), (0, right))
    none = round(float(BYTE_SCALE))
    return Example(
        np.pad(crop.photometric, ((0, 0), *pixels), constant_values=none),
        np.pad(crop.geometric, ((0, 0), *blocks), constant_values=none),
        np.pad(crop.truth, pixels, constant_values=IGNORED),
        np.pad(crop.offsets, ((0, 0), *blocks)),
    )


def _mirrored(crop: Example, *, flips: NDArray[np.bool_]) -> Example:
    """Upside down, left to right, both or neither; what lies across the epipolar line changes sides with one flip."""
    axes = tuple(int(axis) - 2 for axis in np.flatnonzero(flips))
    mirrored = Example(*(np.flip(part, axes).copy() for part in crop))
    if flips[0] != flips[1]:
        mirrored.geometric[ACROSS] = 255 - mirrored.geometric[ACROSS]
    for axis in np.flatnonzero(flips):
        np.negative(mirrored.offsets[axis], out=mirrored.offsets[axis])
    return mirrored


def _as_cues(values: Uint8Array) -> Float32Array:
    return np.asarray(values / BYTE_SCALE - np.float32(1), dtype=np.float32)


def load_examples(
    detector: AnomalyDetector,
    recordings: Sequence[Path],
    folder: Path,
    *,
    every: int = 1,
    augment: Augment = NO_AUGMENT,
    on_progress: Callable[[int, int], None] | None = None,
) -> list[Examples]:
    """``kept_examples`` of all recordings, in their order.

    Raises:
        DatasetError: as ``kept_examples``; ``recordings_share_a_name``.
    """
    names = [path.name for path in recordings]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise DatasetError(
            f"data: expected recordings whose names differ, found several {twice[0]!r}",
            code="recordings_share_a_name",
            field="data",
        )
    for path in recordings:
        if not (folder / f"{path.name}.npz").exists():
            RecordingTruth(path)  # what is wrong with the last one should be told before the first takes its time
    examples = []
    for done, path in enumerate(recordings, start=1):
        examples.append(kept_examples(detector, path, folder, every=every, augment=augment))
        if on_progress is not None:
            on_progress(done, len(recordings))
    return examples

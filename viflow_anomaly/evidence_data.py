"""What an evidence head learns from: cues of labelled pairs, as bytes, one file a recording.

Cues are those that the detector itself computes, errors of its own network included; the truth is the simulator's masks
of what moves. Extracting them takes longer than a look at them, so they are kept: ``NAME.npz`` below the training's
folder holds ``photometric``, ``geometric`` (-1..1 as 0..255) and ``truth`` of every pair of one recording.
"""

from __future__ import annotations

import hashlib
import io
import json
import zipfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from viflow_anomaly.checkpoint_record import write_atomically
from viflow_anomaly.config import EVIDENCE_BLOCK_PX, EvidenceTrainingConfig
from viflow_anomaly.datasets.ground_truth_folder import GroundTruthFolder
from viflow_anomaly.detector import AnomalyDetector
from viflow_anomaly.errors import DatasetError, InvalidInputError
from viflow_anomaly.evaluation.flow_truth import RecordingTruth
from viflow_anomaly.evaluation.labelled_pairs import labels_of
from viflow_anomaly.evidence_cues import GEOMETRIC_CUES, PHOTOMETRIC_CUES
from viflow_anomaly.geometry import Float32Array
from viflow_anomaly.sensor_data import Uint8Array

MOVING, IGNORED, SEAM = 1, 2, 4
"""Bits of ``truth``: a counted mover; what counts neither way; a moving pixel near another moving thing."""
SEAM_REACH_PX = 3
BYTE_SCALE = np.float32(127.5)
TRIES = 3
"""A crop without a mover is drawn anew this often: most of a picture rests."""
ACROSS = [k for k, name in enumerate(GEOMETRIC_CUES) if name.endswith("across")]


class EvidenceBatch(NamedTuple):
    """photometric [B, 3, h, w] and geometric [B, 12, h/4, w/4] float32 in -1..1, truth [B, h, w] uint8."""

    photometric: Float32Array
    geometric: Float32Array
    truth: Uint8Array


@dataclass(frozen=True, eq=False)
class Examples:
    """The pairs of one recording: photometric [N, 3, H', W'], geometric [N, 12, H'/4, W'/4], truth [N, H', W']."""

    photometric: Uint8Array
    geometric: Uint8Array
    truth: Uint8Array

    def __len__(self) -> int:
        return len(self.truth)


def extract_examples(detector: AnomalyDetector, path: Path, *, every: int = 1) -> Examples:
    """Cues and truth of every n-th pair of a recording with masks of what moves.

    Raises:
        DatasetError: ``ground_truth_missing`` where no pair is usable; as ``RecordingTruth``.
    """
    recording = RecordingTruth(path)
    photometric, geometric, truth = [], [], []
    for index in range(0, len(recording), every):
        try:
            pair = recording.pair(index)
            cues, inside = detector.cues(pair)
        except InvalidInputError:
            continue
        photometric.append(_as_bytes(cues.photometric))
        geometric.append(_as_bytes(cues.geometric))
        padded = np.full(cues.photometric.shape[1:], IGNORED, dtype=np.uint8)
        seen = truth_of(recording.ground_truth, pair.source.timestamp_ns)
        height, width = seen.shape
        padded[:height, :width] = np.where(inside, seen, IGNORED)
        truth.append(padded)
    if not truth:
        raise DatasetError(
            f"{path}: expected a pair that can be judged, found none", code="ground_truth_missing", field="data"
        )
    return Examples(np.stack(photometric), np.stack(geometric), np.stack(truth))


def truth_of(ground_truth: GroundTruthFolder, source_timestamp_ns: int) -> Uint8Array:
    """[H, W] bits of one frame: ``MOVING``, ``IGNORED`` and ``SEAM``."""
    pixels = labels_of(ground_truth, source_timestamp_ns).pixels
    assert pixels is not None
    instances = ground_truth.instances(source_timestamp_ns)
    truth = np.where(pixels.moving, MOVING, 0).astype(np.uint8)
    truth[pixels.ignored] = IGNORED
    block = np.ones((2 * SEAM_REACH_PX + 1,) * 2, np.uint8)
    for thing in np.unique(instances[instances > 0]):
        itself = instances == thing
        near = cv2.dilate(itself.astype(np.uint8), block) != 0
        truth[near & ~itself & pixels.moving] |= SEAM
    return truth


def _as_bytes(cues: Float32Array) -> Uint8Array:
    return np.asarray(np.rint((cues + 1) * BYTE_SCALE), dtype=np.uint8)


def kept_examples(detector: AnomalyDetector, path: Path, folder: Path, *, every: int = 1) -> Examples:
    """``extract_examples``, kept in ``folder``; what an earlier run left there is read if it would be the same.

    Raises:
        DatasetError: as ``extract_examples``; ``evidence_data_malformed`` for a file there that is none of these.
    """
    kept, about = folder / f"{path.name}.npz", _made_with(detector, path, every)
    if kept.exists():
        examples = _read_kept(kept, about)
        if examples is not None:
            return examples
    examples = extract_examples(detector, path, every=every)
    buffer = io.BytesIO()
    np.savez(
        buffer,
        about=np.array(about),
        photometric=examples.photometric,
        geometric=examples.geometric,
        truth=examples.truth,
    )
    write_atomically(kept, buffer.getvalue())
    return examples


def _made_with(detector: AnomalyDetector, path: Path, every: int) -> str:
    """All that the cues of a recording depend on; of the recording itself the names and sizes of its files."""
    files = sorted((str(one.relative_to(path)), one.stat().st_size) for one in path.rglob("*") if one.is_file())
    config = detector.config
    about = {
        "model": detector.model_info.sha256,
        "cues": (PHOTOMETRIC_CUES, GEOMETRIC_CUES),
        "correction": config.correction.model_dump(mode="json"),
        "softening": config.regions.texture_softening_gray,
        "residual": (config.residual, config.photometric_compensation),
        "every": every,
        "files": hashlib.sha256(json.dumps(files).encode()).hexdigest(),
    }
    return json.dumps(about, sort_keys=True)


def _read_kept(kept: Path, about: str) -> Examples | None:
    """None where it was made otherwise."""
    try:
        with np.load(io.BytesIO(kept.read_bytes()), allow_pickle=False) as arrays:
            if str(arrays["about"]) != about:
                return None
            examples = Examples(arrays["photometric"], arrays["geometric"], arrays["truth"])
        count, height, width = examples.truth.shape
    except (OSError, EOFError, ValueError, KeyError, zipfile.BadZipFile) as err:
        raise _malformed(kept, str(err)) from err
    blocks = (height // EVIDENCE_BLOCK_PX, width // EVIDENCE_BLOCK_PX)
    shapes = {
        "photometric": (count, len(PHOTOMETRIC_CUES), height, width),
        "geometric": (count, len(GEOMETRIC_CUES), *blocks),
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
        photometric, geometric, truth = (np.stack([crop[k] for crop in crops]) for k in range(3))
        return EvidenceBatch(_as_cues(photometric), _as_cues(geometric), truth)

    def _crop(self, rng: np.random.Generator) -> tuple[Uint8Array, Uint8Array, Uint8Array]:
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
        crop = (examples.photometric[index][:, *pixels], examples.geometric[index][:, *blocks], truth)
        return _mirrored(*_filled(*crop, sides), flips=rng.random(2) < 0.5)


def _filled(
    photometric: Uint8Array, geometric: Uint8Array, truth: Uint8Array, sides: tuple[int, int]
) -> tuple[Uint8Array, Uint8Array, Uint8Array]:
    """Crops of an image smaller than they are to be: beyond it nothing differs and nothing counts."""
    below, right = (side - have for side, have in zip(sides, geometric.shape[1:], strict=True))
    if not below and not right:
        return photometric, geometric, truth
    pixels, blocks = ((0, below * EVIDENCE_BLOCK_PX), (0, right * EVIDENCE_BLOCK_PX)), ((0, below), (0, right))
    none = round(float(BYTE_SCALE))
    return (
        np.pad(photometric, ((0, 0), *pixels), constant_values=none),
        np.pad(geometric, ((0, 0), *blocks), constant_values=none),
        np.pad(truth, pixels, constant_values=IGNORED),
    )


def _mirrored(
    photometric: Uint8Array, geometric: Uint8Array, truth: Uint8Array, *, flips: NDArray[np.bool_]
) -> tuple[Uint8Array, Uint8Array, Uint8Array]:
    """Upside down, left to right, both or neither; what lies across the epipolar line changes sides with one flip."""
    steps = tuple(slice(None, None, -1 if flip else 1) for flip in flips)
    photometric, geometric, truth = photometric[:, *steps], geometric[:, *steps].copy(), truth[steps]
    if flips[0] != flips[1]:
        geometric[ACROSS] = 255 - geometric[ACROSS]
    return photometric, geometric, truth


def _as_cues(values: Uint8Array) -> Float32Array:
    return np.asarray(values / BYTE_SCALE - np.float32(1), dtype=np.float32)


def load_examples(
    detector: AnomalyDetector,
    recordings: Sequence[Path],
    folder: Path,
    *,
    every: int = 1,
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
        examples.append(kept_examples(detector, path, folder, every=every))
        if on_progress is not None:
            on_progress(done, len(recordings))
    return examples

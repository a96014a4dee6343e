"""Any other method through its result files: flow that some program wrote for the pairs of a run.

    DIR/<sequence>/<source_timestamp_ns>.flo                         to the next frame
    DIR/<sequence>/<source_timestamp_ns>_<target_timestamp_ns>.flo   to any frame
    DIR/<source_timestamp_ns>.flo                                    where the run has one sequence

``.flo`` is Middlebury's, ``.png`` KITTI's flow PNG, ``.npy`` a [H, W, 2] array of floats. Unknown (.flo), invalid
(.png) or not finite (.npy) means: no estimate at this pixel. That is how a sparse matcher is measured at its points.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from tokenize import TokenError

import numpy as np

from viflow_anomaly.config import MotorSource
from viflow_anomaly.datasets.ground_truth_png import read_flow_png
from viflow_anomaly.errors import DatasetError
from viflow_anomaly.evaluation.flo_files import read_flo, read_flo_size
from viflow_anomaly.evaluation.flow_methods import MethodAbout, NoEstimateError
from viflow_anomaly.evaluation.flow_truth import PairName
from viflow_anomaly.geometry import Float32Array
from viflow_anomaly.sensor_data import FramePair

SUFFIXES = (".flo", ".png", ".npy")
NO_FILE = "no_file"
NPY_HEADERS = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
# NumPy reads a header as Python source: whatever that can fail with.
NPY_FAULTS = (OSError, ValueError, TypeError, EOFError, SyntaxError, TokenError, MemoryError, RecursionError)


class ResultFiles:
    """A method's files.

    Args:
        name: of the method.
        folder: DIR above.
        names: the pairs of the run.

    Raises:
        DatasetError: ``results_missing`` when the folder is none or holds no file for any of the pairs.
    """

    motor_source: MotorSource | None = None
    timed = False

    def __init__(self, name: str, folder: Path, names: Sequence[PairName]) -> None:
        self.about = MethodAbout(name, "results", details={"folder": folder.name})
        self._folder = folder
        self._one_sequence = len({one.sequence for one in names}) == 1
        if not any(self._candidates(one) for one in names):
            example = names[0] if names else None
            places = "" if example is None else f" (such as {' or '.join(map(str, self._stems(example)))}.flo)"
            raise DatasetError(
                f"{folder}: expected result files of {name!r} for some of {len(names)} pairs{places}, found none",
                code="results_missing",
                field="results",
            )

    def flow(self, pair: FramePair, name: PairName) -> Float32Array:
        """As ``FlowMethod.flow``.

        Raises:
            NoEstimateError: there is no file for the pair.
            DatasetError: ``results_ambiguous`` (several files), ``results_malformed`` (another size, no floats),
                ``flow_file_malformed``, ``ground_truth_malformed`` (a PNG that is not KITTI's).
        """
        found = self._candidates(name)
        if not found:
            raise NoEstimateError(NO_FILE)
        if len(found) > 1:
            raise DatasetError(
                f"{found[0]}: expected one file for the pair, found {', '.join(path.name for path in found[1:])}, too",
                code="results_ambiguous",
                field="results",
            )
        height, width = pair.source.image.shape
        return _read(found[0], (height, width, 2))

    def _candidates(self, name: PairName) -> list[Path]:
        for stem in self._stems(name):
            found = [path for suffix in SUFFIXES if (path := stem.with_name(stem.name + suffix)).is_file()]
            if found:
                return found
        return []

    def _stems(self, name: PairName) -> list[Path]:
        """Where to look, the more telling name first."""
        folders = [self._folder / name.sequence] + ([self._folder] if self._one_sequence else [])
        both = f"{name.source_timestamp_ns}_{name.target_timestamp_ns}"
        stems = [both, str(name.source_timestamp_ns)] if name.look_ahead == 1 else [both]
        return [folder / stem for folder in folders for stem in stems]


def _read(path: Path, shape: tuple[int, int, int]) -> Float32Array:
    """The flow, if it is of the image's shape; what says so in its header is not read where it is of another."""
    if path.suffix == ".flo":
        width, height = read_flo_size(path)
        _require_shape(path, (height, width, 2), shape)
        return read_flo(path)
    if path.suffix == ".png":
        flow, valid = read_flow_png(path)
        _require_shape(path, flow.shape, shape)
        return np.where(valid[..., None], flow, np.float32(np.nan))
    return _read_npy(path, shape)


def _read_npy(path: Path, shape: tuple[int, int, int]) -> Float32Array:
    try:
        with path.open("rb") as file:
            version = np.lib.format.read_magic(file)
            read_header = NPY_HEADERS.get(version)
            if read_header is None:
                raise _malformed(path, "an array of floats in NumPy's format 1.0 or 2.0", f"format {version}")
            found, _, dtype = read_header(file)
            if not np.issubdtype(dtype, np.floating):
                raise _malformed(path, "an array of floats", str(dtype))
            _require_shape(path, found, shape)
            file.seek(0)
            array = np.lib.format.read_array(file, allow_pickle=False)
    except NPY_FAULTS as err:
        raise _malformed(path, "an array of floats in NumPy's format", str(err)) from err
    return np.asarray(array, dtype=np.float32)


def _require_shape(path: Path, found: tuple[int, ...], expected: tuple[int, ...]) -> None:
    if found != expected:
        raise _malformed(path, f"flow of shape {expected}, as the image", f"{found}")


def _malformed(path: Path, expected: str, found: str) -> DatasetError:
    return DatasetError(f"{path}: expected {expected}, found {found}", code="results_malformed", field="results")

"""Table I of "Multi-Hypothesis Visual-Inertial Flow" (Shamwell, Nothwang, Perlis), as printed.

Measured by its authors on their data (KITTI and EuRoC, the middle 224x224 px) and their machine (Titan X): figures to
stand beside ours, not in one table with them. The quotient is mean EPE x runtime x 0.01 and kept as printed, too:
DeepMatching's and DSP's on KITTI do not follow from the printed mean and runtime (28.84 for 7.24, 95.3 for 63.98).
"""

from __future__ import annotations

from typing import NamedTuple


class PaperErrors(NamedTuple):
    """Endpoint error in px on one data set, and the paper's quotient."""

    mean_px: float
    sd_px: float
    median_px: float
    quotient: float | None


class PaperRow(NamedTuple):
    """One algorithm; ``hypotheses`` is None for those that have none, ``runtime_ms`` for the identity."""

    algorithm: str
    hypotheses: int | None
    kitti: PaperErrors
    euroc: PaperErrors
    runtime_ms: float | None


def _row(
    algorithm: str,
    hypotheses: int | None,
    kitti: tuple[float, float, float],
    euroc: tuple[float, float, float],
    runtime_ms: float | None,
    quotients: tuple[float | None, float | None],
) -> PaperRow:
    return PaperRow(
        algorithm, hypotheses, PaperErrors(*kitti, quotients[0]), PaperErrors(*euroc, quotients[1]), runtime_ms
    )


PAPER_TABLE: tuple[PaperRow, ...] = (
    _row("FlowNetC", None, (4.00, 3.41, 3.28), (4.75, 6.92, 2.78), 88.7, (3.55, 4.21)),
    _row("FlowNet2", None, (0.52, 0.71, 0.34), (0.60, 0.73, 0.20), 197.2, (1.03, 1.18)),
    _row("EpicFlow", None, (1.86, 4.05, 0.88), (0.55, 0.72, 0.15), 2845.2, (52.99, 15.65)),
    _row("DeepMatching (sparse)", None, (1.76, 2.09, 1.40), (3.87, 6.83, 2.09), 411.5, (28.84, 15.93)),
    _row("DSP", None, (5.11, 4.76, 3.91), (4.37, 8.39, 1.94), 1252.0, (95.3, 54.71)),
    _row("Identity", None, (8.46, 7.51, 7.52), (20.63, 22.00, 13.49), None, (None, None)),
    _row("VIFlow-IMU", 1, (5.02, 6.66, 3.05), (5.98, 5.61, 4.39), 4.7, (0.24, 0.28)),
    _row("VIFlow-IMU", 4, (4.80, 6.53, 3.11), (4.71, 4.53, 3.38), 6.0, (0.29, 0.28)),
    _row("VIFlow-IMU", 8, (4.54, 6.51, 2.86), (3.87, 3.77, 2.83), 8.2, (0.37, 0.32)),
    _row("VIFlow-SFFMS", 1, (6.75, 8.10, 4.14), (12.78, 11.77, 9.71), 4.7, (0.32, 0.60)),
    _row("VIFlow-SFFMS", 4, (4.20, 5.82, 2.56), (8.12, 7.22, 5.94), 6.1, (0.26, 0.50)),
    _row("VIFlow-SFFMS", 8, (3.47, 5.49, 2.08), (6.19, 5.58, 4.67), 8.1, (0.28, 0.50)),
    _row("VIFlow-IMU+SFFMS", 1, (3.28, 6.15, 1.61), (5.23, 4.83, 3.95), 5.0, (0.16, 0.26)),
    _row("VIFlow-IMU+SFFMS", 4, (2.98, 6.11, 1.33), (3.82, 3.71, 2.82), 6.4, (0.19, 0.24)),
    _row("VIFlow-IMU+SFFMS", 8, (2.91, 6.14, 1.24), (3.29, 3.37, 2.38), 8.5, (0.25, 0.28)),
)

"""What each step of the detector is worth: one thing changed at a time, on the same labelled pairs.

    python benchmarks/detection_ablations.py runs/model/held-out/* [--every 6]

All variants keep the default's thresholds unless their name says otherwise, so that a variant's false alarms are those
that a user would see after changing this one setting.
"""

from __future__ import annotations

import argparse
import os
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # read once, when torch loads

import cv2

from viflow_anomaly.config import DetectorConfig
from viflow_anomaly.detector import AnomalyDetector
from viflow_anomaly.evaluation.detection_methods import DetectorMethod
from viflow_anomaly.evaluation.detection_quality import measure_detection
from viflow_anomaly.evaluation.detection_report import Report, detection_report
from viflow_anomaly.evaluation.detection_tables import notes
from viflow_anomaly.evaluation.flow_report import ALL, scopes
from viflow_anomaly.evaluation.flow_tables import Table, markdown_table, number_text
from viflow_anomaly.evaluation.labelled_pairs import open_labelled
from viflow_anomaly.evaluation.report_files import write_report

RESULTS = Path("benchmarks/results/detection-ablations")
DEFAULT = "default"

# Name -> what is changed in the detector's configuration. A new step (learned evidence, persistence over frames) is one
# more line here, switched off, or on where the default is without it.
RESIDUAL: dict[str, Any] = {"evidence": "residual"}
VARIANTS: dict[str, dict[str, Any]] = {
    DEFAULT: {},
    "shape rule: thickness": {"regions": {"shape_rule": "thickness"}},
    "shape rule: oriented": {"regions": {"shape_rule": "oriented"}},
    "shape rule: none": {"regions": {"shape_rule": "none"}},
    "correction off": {"correction": {"enabled": False}, "evidence": "learned"},
    "depth refinement off": {"correction": {"depth_rounds": 0}},
    "exposure compensation off": {"photometric_compensation": False},
    "minimum over hypotheses": {"residual": "minimum"},
    "gradient normalisation off": {"regions": {"texture_softening_gray": 0}},
    "evidence head off": RESIDUAL,
    "head off, morphology off": {**RESIDUAL, "regions": {"opening_fraction": 0, "closing_fraction": 0}},
    "head off, opening off": {**RESIDUAL, "regions": {"opening_fraction": 0}},
    "head off, closing off": {**RESIDUAL, "regions": {"closing_fraction": 0}},
    "head off, shape rule: thickness": {**RESIDUAL, "regions": {"shape_rule": "thickness"}},
    "head off, shape rule: oriented": {**RESIDUAL, "regions": {"shape_rule": "oriented"}},
    "head off, shape rule: none": {**RESIDUAL, "regions": {"shape_rule": "none"}},
    "head off, gradient normalisation off": {**RESIDUAL, "regions": {"texture_softening_gray": 0}},
    "head off, gradient normalisation off, from 12 gray on": {
        **RESIDUAL,
        "regions": {"texture_softening_gray": 0, "min_residual_gray": 12},
    },
    "head off, exposure compensation off": {**RESIDUAL, "photometric_compensation": False},
    "head off, minimum over hypotheses": {**RESIDUAL, "residual": "minimum"},
    "head off, correction off": {**RESIDUAL, "correction": {"enabled": False}},
    "head off, correction off, minimum over hypotheses": {
        **RESIDUAL,
        "correction": {"enabled": False},
        "residual": "minimum",
    },
    "head off, depth refinement off": {**RESIDUAL, "correction": {"depth_rounds": 0}},
}

FIGURES: tuple[tuple[str, str, int], ...] = (
    ("ROI AP", "roi_ap", 3),
    ("best F1", "best_f1", 3),
    ("recall @0.1", "recall_at_0.1_false_alarms", 3),
    ("recall", "recall", 3),
    ("alarms/frame", "false_alarms_per_frame", 2),
    ("pixel AP", "pixel_ap", 3),
)
"""Each is told with its difference to the default's."""


def variant_table(scope: str, figures: dict[str, Any]) -> Table:
    """A row for each variant of one group."""
    default = figures[DEFAULT]
    rows = []
    for name, one in figures.items():
        cells = [name]
        for _, key, digits in FIGURES:
            cells.append(number_text(one[key], digits))
            known = name != DEFAULT and one[key] is not None
            cells.append(f"{one[key] - default[key]:+.{digits}f}" if known else "")
        rows.append(tuple(cells))
    heads = ["variant", *(head for column in FIGURES for head in (column[0], "±"))]
    title = f"{'all frames' if scope == ALL else scope}: {default['movers']} movers in {default['frames']} frames"
    return Table(title, tuple(heads), tuple(rows), 1)


def markdown(report: Report) -> str:
    """One table for each group and for all, in Markdown."""
    tables = [markdown_table(variant_table(scope, figures)) for scope, figures in scopes(report).items()]
    return (
        "\n\n".join(["# Ablations of the detector", *tables, "\n".join(f"- {line}" for line in notes(report))]) + "\n"
    )


def measure(recordings: list[Path], checkpoint: Path | None, every: int, names: list[str]) -> Report:
    """The report, every variant a method."""
    cv2.setNumThreads(1)
    detector = AnomalyDetector.from_checkpoint(checkpoint, threads=1)
    methods = [
        DetectorMethod(name, detector.with_config(DetectorConfig.from_mapping(VARIANTS[name], where=name)))
        for name in names
    ]
    run = measure_detection(methods, [open_labelled(path) for path in recordings], every=every)
    options = {"every": every, "variants": {name: VARIANTS[name] for name in names}}
    return detection_report(run, detector.model_info, DetectorConfig().model_dump(mode="json"), options=options)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recordings", nargs="+", type=Path, metavar="DIR", help="as `evaluate detect` takes them")
    parser.add_argument("--every", type=int, default=1, help="take every n-th pair (default 1)")
    parser.add_argument("--only", nargs="+", choices=VARIANTS, metavar="VARIANT", help="beside the default")
    parser.add_argument("--checkpoint", type=Path, help="another model than the bundled one")
    parser.add_argument("--out", type=Path, default=RESULTS, help=f"without suffix (default {RESULTS})")
    arguments = parser.parse_args()
    names = [name for name in VARIANTS if not arguments.only or name in (DEFAULT, *arguments.only)]
    report = measure(arguments.recordings, arguments.checkpoint, arguments.every, names)
    text = markdown(report)
    write_report(arguments.out, report, text)
    print(text)


if __name__ == "__main__":
    main()

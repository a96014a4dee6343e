"""A report of regions as tables: rows of text for the console and Markdown."""

from __future__ import annotations

from typing import Any

from viflow_anomaly.evaluation.detection_report import Report
from viflow_anomaly.evaluation.flow_report import ALL, scopes
from viflow_anomaly.evaluation.flow_tables import Table, markdown_table, number_text

FIGURES: tuple[tuple[str, str, int], ...] = (
    ("ROI AP", "roi_ap", 3),
    ("best F1", "best_f1", 3),
    ("recall", "recall", 3),
    ("precision", "precision", 3),
    ("recall @0.1", "recall_at_0.1_false_alarms", 3),
    ("@0.01", "recall_at_0.01_false_alarms", 3),
    ("alarms/frame", "false_alarms_per_frame", 2),
    ("/min", "false_alarms_per_minute", 1),
    ("ECE", "score_ece", 3),
    ("pixel AP", "pixel_ap", 3),
    ("best IoU", "pixel_iou_best", 3),
    ("IoU", "pixel_iou", 3),
)


def report_tables(report: Report) -> list[Table]:
    """One table for each group and for everything."""
    return [_scope_table(scope, figures) for scope, figures in scopes(report).items()]


def class_tables(report: Report) -> list[Table]:
    """Average precision by size and by speed, a table for each group and for everything that has movers."""
    return [
        _class_table(scope, figures)
        for scope, figures in scopes(report).items()
        if any(one["movers"] for one in figures.values())
    ]


def sequence_table(report: Report) -> Table:
    """Average precision of every method on every sequence; false alarms a frame where there was nothing to find."""
    methods = list(report["methods"])
    rows = []
    for name, sequence in report["sequences"].items():
        figures = [sequence["methods"].get(method, {}) for method in methods]
        movers = max((one["movers"] for one in figures if one), default=0)
        key = "roi_ap" if movers else "false_alarms_per_frame"
        rows.append((name, sequence["group"], str(movers), *(number_text(one.get(key), 3) for one in figures)))
    title = "ROI AP by sequence (without movers: false alarms a frame)"
    return Table(title, ("sequence", "group", "movers", *methods), tuple(rows), 2)


def _scope_table(scope: str, figures: dict[str, Any]) -> Table:
    shown = [column for column in FIGURES if any(one[column[1]] is not None for one in figures.values())]
    rows = tuple(
        (name, *(number_text(one[key], digits) for _, key, digits in shown), _thresholds(one))
        for name, one in figures.items()
    )
    return Table(_title(scope, figures), ("method", *(head for head, _, _ in shown), "thresholds"), rows, 1)


def _class_table(scope: str, figures: dict[str, Any]) -> Table:
    first = next(iter(figures.values()))
    columns = [
        (kind, name)
        for kind in ("by_size", "by_speed")
        for name in first[kind]
        if any(one[kind][name]["movers"] for one in figures.values())
    ]
    heads = [f"{kind.removeprefix('by_')} {name} ({first[kind][name]['movers']})" for kind, name in columns]
    rows = tuple(
        (method, *(number_text(one[kind][name]["roi_ap"], 3) for kind, name in columns))
        for method, one in figures.items()
    )
    return Table(f"ROI AP by size and speed (movers), {_name(scope)}", ("method", *heads), rows, 1)


def _title(scope: str, figures: dict[str, Any]) -> str:
    frames, movers = (max(one[key] for one in figures.values()) for key in ("frames", "movers"))
    return f"{_name(scope)}: {movers} mover{'' if movers == 1 else 's'} in {frames} frame{'' if frames == 1 else 's'}"


def _name(scope: str) -> str:
    return "all frames" if scope == ALL else scope


def _thresholds(figures: dict[str, Any]) -> str:
    """MADs and gray levels of a residual, or the probability that a pixel needs."""
    if figures["min_motion_probability"] is not None:
        return f"p > {figures['min_motion_probability']:g}"
    return f"{figures['threshold_mads']:g} MAD, {figures['min_residual_gray']:g}"


def notes(report: Report) -> list[str]:
    """What a reader of the tables must know."""
    rules = report["rules"]

    def classes(key: str) -> str:
        return ", ".join(
            f"{name} {low:g} to {high:g}" if high is not None else f"{name} from {low:g}"
            for name, (low, high) in rules[key].items()
        )

    lines = [
        f"A region finds a mover when their boxes overlap by IoU {rules['min_iou']:g}. One half in an ignored "
        f"box counts neither way. Ignored: movers of less than {rules['min_area_px']} px or of less than "
        f"{rules['min_independent_flow_px']:g} px of motion, and boxes that are not said to move or to rest.",
        "recall, precision, alarms and IoU: of regions labelled as motion; "
        "recall @0.1, @0.01: where the score's threshold leaves as many false alarms a frame; the curves (AP, best F1) "
        "are over all regions.",
        "ECE: expected calibration error, how far a region's score is from the share of such regions that move.",
        f"Size: px of the mover's box, {classes('size_classes_box_px')}. "
        f"Speed: px of independent motion a frame, {classes('speed_classes_px')}.",
        f"Commit {(report['commit'] or 'unknown')[:12]}, {report['date'][:10]}, model {report['model']['name']}.",
    ]
    rivals = [name for name, about in report["methods"].items() if about["best_thresholds"]]
    if rivals:
        lines.append(f"Thresholds chosen on these very frames, in favour of: {', '.join(rivals)}.")
    if report["skipped_pairs"]:
        counts = ", ".join(f"{reason} {count}" for reason, count in report["skipped_pairs"].items())
        lines.append(f"Pairs left out for every method: {counts}.")
    return lines


def markdown(report: Report, *, title: str = "Regions against ground truth") -> str:
    """All tables in Markdown."""
    tables = [*report_tables(report), *class_tables(report), sequence_table(report)]
    parts = [f"# {title}", *map(markdown_table, tables), "\n".join(f"- {line}" for line in notes(report))]
    return "\n\n".join(parts) + "\n"

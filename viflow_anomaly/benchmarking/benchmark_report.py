"""The benchmark's report for people, and what a table on the console needs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from viflow_anomaly.evaluation.flow_tables import Table

HEADS = ("method", "runtime", "preset", "evidence", "size", "threads")
FIGURES = ("median ms", "p95 ms", "pairs/s", "peak MiB", "/ DIS medium", "/ homography")


def comparison_table(rows: Sequence[Mapping[str, Any]]) -> Table:
    """A row for each method, size and number of threads."""
    lines = []
    for row in rows:
        about = (row["method"], row["runtime"], row["preset"], row["evidence"], f"{row['width']}x{row['height']}")
        peak = "-" if row["peak_mib"] is None else f"{row['peak_mib']:.0f}"
        times = (f"{row['median_ms']:.2f}", f"{row['p95_ms']:.2f}", f"{row['pairs_per_s']:.1f}", peak)
        lines.append(
            (*about, str(row["threads"]), *times, f"{row['over_dis_medium']:.2f}", f"{row['over_homography']:.2f}")
        )
    return Table("A decoded pair to its regions (flow methods: to their flow)", (*HEADS, *FIGURES), tuple(lines), 4)


def paper_table(ratios: Sequence[Mapping[str, Any]]) -> Table:
    """The paper's network over ours."""
    lines = [
        (
            one["runtime"],
            one["evidence"],
            f"{one['width']}x{one['height']}",
            str(one["threads"]),
            f"{one['paper_over_ours']:.2f}",
        )
        for one in ratios
    ]
    return Table(
        "The paper's network takes so many times as long (untrained, in torch, residual as evidence)",
        ("runtime", "evidence", "size", "threads", "paper / ours"),
        tuple(lines),
        2,
    )


def curve_tables(curves: Mapping[str, Sequence[Mapping[str, Any]]]) -> list[Table]:
    """One table a curve, its columns as they are named in the JSON."""
    titles = {
        "pixels": "Pixels (one thread; over_quarter: time over that of a quarter of the pixels, 4 is linear)",
        "hypotheses": "Hypotheses (untrained networks in torch, 224x224)",
        "blobs": "Squares that stand out in the residual (752x480; residual to regions)",
        "length": "Length of a recording (batch, one job, 224x224)",
    }
    return [_plain(titles[name], rows) for name, rows in curves.items() if rows]


def _plain(title: str, rows: Sequence[Mapping[str, Any]]) -> Table:
    heads = tuple(rows[0])
    lines = tuple(tuple("-" if row[head] is None else str(row[head]) for head in heads) for row in rows)
    return Table(title, heads, lines, 1)


def markdown(report: Mapping[str, Any], tables: Sequence[Table]) -> str:
    """The whole report."""
    versions = ", ".join(f"{name} {number}" for name, number in report["versions"].items())
    changes = " with uncommitted changes" if report["uncommitted_changes"] else ""
    about = (
        f"{report['cpu']}, {report['cores']} usable cores, load {report['load_1min']} before and "
        f"{report['load_1min_after']} after; {report['date']}, commit {report['commit'] or 'of an installed package'}"
        f"{changes}; Python {report['python']}, {versions}."
    )
    parts = ["# Benchmark", about, *map(_markdown_table, tables)]
    parts += [f"Not measured: {reason}" for reason in report["skipped"]]
    return "\n\n".join(parts) + "\n"


def _markdown_table(table: Table) -> str:
    heads = f"| {' | '.join(table.heads)} |\n|{'---|' * len(table.heads)}"
    return "\n".join([f"**{table.title}**\n\n{heads}", *(f"| {' | '.join(row)} |" for row in table.rows)])

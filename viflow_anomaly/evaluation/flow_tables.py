"""A report as tables: rows of text for the console, Markdown, LaTeX (booktabs)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

from viflow_anomaly.evaluation.flow_report import ALL, Report, scopes

NONE = "-"


class Table(NamedTuple):
    """A title, column heads, rows of text, and how many columns on the left are text."""

    title: str
    heads: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    text_columns: int


FIGURES: tuple[tuple[str, str, int], ...] = (
    ("EPE mean", "epe_mean_px", 3),
    ("sd", "epe_sd_px", 3),
    ("median", "epe_median_px", 3),
    ("F1-all %", "f1_all", 1),
    ("ratio", "epe_ratio", 3),
    ("inside", "inside_epe_ratio", 3),
    ("density %", "density", 1),
    ("ms", "runtime_ms", 2),
    ("quotient", "quotient", 3),
)
SHARES = ("f1_all", "density")


def report_tables(report: Report) -> list[Table]:
    """One table for each group and for all pairs."""
    return [_scope_table(report, name, figures) for name, figures in scopes(report).items()]


def sequence_table(report: Report) -> Table:
    """Mean EPE of every method (a column) on every sequence (a row)."""
    methods = list(report["methods"])
    rows = tuple(
        (sequence, *(number_text(figures[method]["epe_mean_px"], 3) for method in methods))
        for sequence, figures in report["sequences"].items()
    )
    return Table("Mean EPE in px by sequence", ("sequence", *methods), rows, 1)


def paper_table(report: Report) -> Table:
    """The paper's own figures."""
    heads: tuple[str, ...] = ("algorithm", "K")
    for data in ("KITTI", "EuRoC"):
        heads += tuple(f"{data} {name}" for name in ("mean", "sd", "median"))
    heads += ("ms", "quotient KITTI", "quotient EuRoC")
    rows = []
    for row in report["paper"]["rows"]:
        errors = [
            number_text(row[data][key], 2) for data in ("kitti", "euroc") for key in ("mean_px", "sd_px", "median_px")
        ]
        quotients = [number_text(row[data]["quotient"], 2) for data in ("kitti", "euroc")]
        rows.append(
            (row["algorithm"], _text(row["hypotheses"]), *errors, number_text(row["runtime_ms"], 1), *quotients)
        )
    return Table(f"As printed in {report['paper']['source']}", heads, tuple(rows), 2)


def _scope_table(report: Report, scope: str, figures: dict[str, Any]) -> Table:
    pairs = max(one["pairs"] + sum(one["missing_pairs"].values()) for one in figures.values())
    missing = any(one["missing_pairs"] for one in figures.values())
    heads = ("method", "preset", "inputs", "K", *(head for head, _, _ in FIGURES)) + (("missing",) if missing else ())
    rows = []
    for name, about in report["methods"].items():
        one = figures[name]
        values = [
            number_text(one[key] if one[key] is None or key not in SHARES else 100 * one[key], digits)
            for _, key, digits in FIGURES
        ]
        left = [str(sum(one["missing_pairs"].values()))] if missing else []
        rows.append((name, _text(about["preset"]), _text(about["inputs"]), _text(about["hypotheses"]), *values, *left))
    title = "all pairs" if scope == ALL else scope
    return Table(f"{title}: {pairs} pair{'' if pairs == 1 else 's'}", heads, tuple(rows), 3)


def notes(report: Report) -> list[str]:
    """What a reader of the tables must know."""
    lines = [
        "EPE in px of the source image, over the pixels with ground truth where a method has an estimate (density: "
        "their share). F1-all: error > 3 px and > 5 % of the true length. ratio: to the error of no motion on the same "
        "pixels. quotient: mean EPE x ms x 0.01.",
        f"Runtime: median over the pairs after a warm-up, reading excluded, {report['threads']} thread(s), "
        f"{report['machine']['cpu']}; commit {(report['commit'] or 'unknown')[:12]}, {report['date'][:10]}.",
    ]
    if any(about["corrected"] for about in report["methods"].values()):
        lines.append(
            "A row ends in +correction where the network's flow was corrected on the target image; without, it is the "
            "network's alone, the paper's method."
        )
    if report["left_out"]:
        lines.append(f"Not in this build of OpenCV (opencv-contrib): {', '.join(report['left_out'])}.")
    if report["skipped_pairs"]:
        counts = ", ".join(f"{reason} {count}" for reason, count in report["skipped_pairs"].items())
        lines.append(f"Pairs left out for every method: {counts}.")
    return lines


def markdown(report: Report) -> str:
    """All tables in Markdown."""
    parts = ["# Flow against ground truth"]
    parts += [markdown_table(table) for table in (*report_tables(report), sequence_table(report))]
    parts += ["\n".join(f"- {line}" for line in notes(report)), markdown_table(paper_table(report))]
    return "\n\n".join(parts) + "\n"


def markdown_table(table: Table) -> str:
    rule = ["---" if column < table.text_columns else "---:" for column in range(len(table.heads))]
    lines = [_markdown_row(row) for row in (table.heads, rule, *table.rows)]
    return "\n".join([f"## {_escaped_markdown(table.title)}", "", *lines])


def _markdown_row(cells: Sequence[str]) -> str:
    return "| " + " | ".join(_escaped_markdown(cell) for cell in cells) + " |"


def _escaped_markdown(text: str) -> str:
    return text.replace("|", "\\|").replace("\n", " ")


def latex(report: Report) -> str:
    """All tables in LaTeX; needs the package booktabs."""
    lines = ["% needs \\usepackage{booktabs}", *(f"% {line}" for line in notes(report))]
    for table in (*report_tables(report), sequence_table(report), paper_table(report)):
        lines += ["", *_latex_table(table)]
    return "\n".join(lines) + "\n"


def _latex_table(table: Table) -> list[str]:
    columns = "l" * table.text_columns + "r" * (len(table.heads) - table.text_columns)
    body = [_latex_row(row) for row in table.rows]
    return [
        "\\begin{table}",
        "  \\centering\\small",
        f"  \\caption{{{_escaped_latex(table.title)}}}",
        f"  \\begin{{tabular}}{{{columns}}}",
        "    \\toprule",
        _latex_row(table.heads),
        "    \\midrule",
        *body,
        "    \\bottomrule",
        "  \\end{tabular}",
        "\\end{table}",
    ]


def _latex_row(cells: Sequence[str]) -> str:
    return "    " + " & ".join("--" if cell == NONE else _escaped_latex(cell) for cell in cells) + " \\\\"


LATEX_NAMED = {
    "\\": "backslash",
    "~": "asciitilde",
    "^": "asciicircum",
    "|": "bar",
    "<": "less",
    ">": "greater",
}
LATEX_SPECIAL = {character: f"\\text{name}{{}}" for character, name in LATEX_NAMED.items()} | {
    character: "\\" + character for character in "&%$#_{}"
}


def _escaped_latex(text: str) -> str:
    return "".join(LATEX_SPECIAL.get(character, character) for character in text.replace("\n", " "))


def number_text(value: float | None, digits: int) -> str:
    return NONE if value is None else f"{value:.{digits}f}"


def _text(value: object) -> str:
    return NONE if value is None else str(value)

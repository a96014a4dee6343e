"""The report's tables, and the paper's as printed."""

from __future__ import annotations

import json
import re
from typing import Any

import numpy as np
import pytest

from viflow_anomaly.evaluation.flow_methods import MethodAbout
from viflow_anomaly.evaluation.flow_report import flow_report
from viflow_anomaly.evaluation.flow_run import FlowMeasurement
from viflow_anomaly.evaluation.flow_statistics import FlowStatistics
from viflow_anomaly.evaluation.flow_tables import latex, markdown, notes, report_tables, sequence_table
from viflow_anomaly.evaluation.paper_table import PAPER_TABLE

METHODS = (
    MethodAbout("k8_a|b", "network", "paper", "imu", 8, details={"runtime": "torch"}),
    MethodAbout("k8_a|b+correction", "network", "paper", "imu", 8, corrected=True),
    MethodAbout("Sparse & Co", "results"),
)


def statistics(error_px: float, runtime_ms: float | None, *, pairs: int = 1, missing: int = 0) -> FlowStatistics:
    some = FlowStatistics()
    true = np.full((2, 2, 2), (3.0, 4.0), np.float32)
    for _ in range(pairs):
        some.add_pair(true + np.array((error_px, 0.0), np.float32), true, np.ones((2, 2), np.bool_))
        some.runtimes_ms.extend([] if runtime_ms is None else [runtime_ms])
    some.missing.update({"no_file": missing} if missing else {})
    return some


@pytest.fixture
def report() -> dict[str, Any]:
    names = [about.name for about in METHODS]
    sequences = {
        "drone_1": dict(zip(names, (statistics(4.0, 8.0), statistics(2.0, 9.0), FlowStatistics()), strict=True)),
        "car_1": dict(zip(names, (statistics(1.0, 7.0), statistics(1.0, 8.0), statistics(0.5, None)), strict=True)),
    }
    sequences["drone_1"]["Sparse & Co"].missing["no_file"] += 1
    run = FlowMeasurement(METHODS, sequences, {"imu_empty": 3})
    return flow_report(run, threads=2, left_out=["tv-l1"], options={"look_aheads": [1]})


def test_the_report_is_json_and_says_where_it_comes_from(report: dict[str, Any]) -> None:
    assert json.loads(json.dumps(report, allow_nan=False)) == report
    assert (report["threads"], report["options"], report["left_out"]) == (2, {"look_aheads": [1]}, ["tv-l1"])
    assert report["skipped_pairs"] == {"imu_empty": 3}
    assert report["all"]["k8_a|b"]["epe_mean_px"] == 2.5
    assert report["groups"]["drone"]["Sparse & Co"]["missing_pairs"] == {"no_file": 1}
    assert report["groups"]["drone"]["Sparse & Co"]["epe_mean_px"] is None
    assert list(report["sequences"]) == ["car_1", "drone_1"]


def test_one_table_for_each_group_and_all(report: dict[str, Any]) -> None:
    tables = report_tables(report)
    assert [table.title for table in tables] == ["car: 1 pair", "drone: 1 pair", "all pairs: 2 pairs"]
    heads, row = tables[1].heads, tables[1].rows[0]
    assert dict(zip(heads, row, strict=False)) | {"missing": "0"} == {
        "method": "k8_a|b",
        "preset": "paper",
        "inputs": "imu",
        "K": "8",
        "EPE mean": "4.000",
        "sd": "0.000",
        "median": row[heads.index("median")],
        "F1-all %": "100.0",
        "ratio": "0.800",
        "density %": "100.0",
        "ms": "8.00",
        "quotient": "0.320",
        "missing": "0",
    }
    assert tables[1].rows[2][-1] == "1"
    assert "missing" not in tables[0].heads
    assert sequence_table(report).rows[0] == ("car_1", "1.000", "1.000", "0.500")
    assert sequence_table(report).rows[1][-1] == "-"


def test_a_single_group_is_not_shown_twice(report: dict[str, Any]) -> None:
    del report["groups"]["car"]
    assert [table.title for table in report_tables(report)] == ["drone: 1 pair"]


def test_notes_tell_what_a_reader_must_know(report: dict[str, Any]) -> None:
    text = "\n".join(notes(report))
    for words in ("2 thread(s)", "+correction", "tv-l1", "imu_empty 3", report["date"][:10]):
        assert words in text
    plain = "\n".join(notes(report | {"left_out": [], "skipped_pairs": {}, "methods": {}}))
    assert not any(words in plain for words in ("opencv-contrib", "left out", "+correction"))


def test_markdown_is_tables_of_equal_width(report: dict[str, Any]) -> None:
    text = markdown(report)
    assert "| k8_a\\|b | paper | imu | 8 | 4.000 |" in text
    blocks = [block.splitlines() for block in text.split("\n\n") if block.startswith("|")]
    assert len(blocks) == 5  # two groups, all, sequences, the paper
    for block in blocks:
        assert len({len(re.split(r"(?<!\\)\|", line)) for line in block}) == 1
        assert re.fullmatch(r"\|( -{3}:? \|)+", block[1])
    assert text.index("As printed in the paper's Table I") > text.index("Mean EPE in px by sequence")


def test_latex_escapes_and_closes_what_it_opens(report: dict[str, Any]) -> None:
    text = latex(report)
    assert "k8\\_a|b & paper & imu & 8 & 4.000" in text
    assert "Sparse \\& Co & -- & -- & --" in text
    assert "F1-all \\%" in text
    for name in ("table", "tabular"):
        assert text.count(f"\\begin{{{name}}}") == text.count(f"\\end{{{name}}}") == 5
    for block in re.findall(r"\\begin\{tabular\}\{([lr]+)\}(.*?)\\end", text, flags=re.DOTALL):
        rows = [line for line in block[1].splitlines() if line.endswith("\\\\")]
        assert {len(re.split(r"(?<!\\)&", row)) for row in rows} == {len(block[0])}


DEVIATING = {("DeepMatching (sparse)", "kitti"), ("DSP", "kitti")}


def test_the_papers_quotients_follow_from_its_figures() -> None:
    """A slip of the pen in a row would show; two quotients do not follow in print."""
    for row in PAPER_TABLE:
        for name, errors in (("kitti", row.kitti), ("euroc", row.euroc)):
            if row.runtime_ms is None:
                assert errors.quotient is None
                continue
            assert errors.quotient is not None
            quotient = errors.mean_px * row.runtime_ms * 0.01
            if (row.algorithm, name) in DEVIATING:
                assert abs(quotient - errors.quotient) > 0.05 * errors.quotient
            else:
                assert quotient == pytest.approx(errors.quotient, rel=0.03, abs=0.006)


def test_the_papers_table_is_whole() -> None:
    assert len(PAPER_TABLE) == 15
    ours = [(row.algorithm, row.hypotheses) for row in PAPER_TABLE if row.hypotheses is not None]
    assert ours == [(f"VIFlow-{kind}", k) for kind in ("IMU", "SFFMS", "IMU+SFFMS") for k in (1, 4, 8)]

"""``viflow-anomaly benchmark``: what a pair costs on this machine."""

from __future__ import annotations

import json
import os
import re
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from viflow_anomaly.cli.options import AsJson
from viflow_anomaly.cli.progress import stderr_progress
from viflow_anomaly.cli.tables import report_console, rich_table

if TYPE_CHECKING:
    from viflow_anomaly.benchmarking.comparison import OnStep, Plan
    from viflow_anomaly.evaluation.flow_tables import Table

SIZES, QUICK_SIZES = "224x224,752x480", "224x224"
REPEATS, QUICK_REPEATS = 50, 8
BUDGET_S, QUICK_BUDGET_S = 20.0, 4.0
LENGTHS, QUICK_LENGTHS = (100, 400, 1600), (50, 150)
SIDE_LIMITS_PX = (64, 4096)


def benchmark(
    sizes: Annotated[
        str | None,
        typer.Option(
            metavar="WxH,...", help=f"Image sizes (default {SIZES}; quick: {QUICK_SIZES}).", show_default=False
        ),
    ] = None,
    threads: Annotated[str, typer.Option(metavar="N,...", help="CPU threads of one pair.")] = "1",
    runtime: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME", help="What runs the bundled model; repeatable (default: all that are here)."),
    ] = None,
    preset: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME",
            help="bundled, or compact or paper (untrained, in torch); repeatable (default: bundled and paper).",
        ),
    ] = None,
    quick: Annotated[bool, typer.Option("--quick", help="Few repetitions of the smaller size, no memory.")] = False,
    memory: Annotated[
        bool | None,
        typer.Option("--memory/--no-memory", help="Peak memory, each row in a process of its own.", show_default=False),
    ] = None,
    curves: Annotated[
        bool, typer.Option("--curves", help="Also how cost grows with pixels, hypotheses, regions and length.")
    ] = False,
    as_json: AsJson = False,
    out: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Write FILE.json, FILE.md and, with --curves and matplotlib, FILE.png."),
    ] = None,
) -> None:
    """Measure time, throughput and memory from a decoded pair to its regions, on this machine.

    Every runtime of the bundled model, with the evidence head (auto) and with the residual alone, and the paper's
    network, beside DIS flow, Farneback's and a homography-compensated difference with the same regions. All take turns
    on one made-up pair, so that whatever else the machine does meets all alike; trust the ratios first.

    [bold]Examples[/bold]

      viflow-anomaly benchmark --quick

      viflow-anomaly benchmark --sizes 224x224,752x480 --threads 1,2 --curves --out results/benchmark
    """
    from viflow_anomaly.benchmarking.benchmark_report import comparison_table, curve_tables, markdown, paper_table
    from viflow_anomaly.benchmarking.comparison import compare, paper_ratios
    from viflow_anomaly.benchmarking.machine import circumstances

    plan = _plan(sizes, threads, runtime, preset, quick, memory)
    report: dict[str, Any] = circumstances()
    with stderr_progress() as progress:
        task = progress.add_task("", total=None)

        def show(step: str) -> None:
            progress.update(task, description=step)

        compared = compare(plan, show)
        measured = _curves(show, quick, plan.memory) if curves else {}
    ratios = paper_ratios(compared.rows)
    report |= {"load_1min_after": round(os.getloadavg()[0], 2), "repeats": plan.repeats, "rows": compared.rows}
    report |= {"paper_ratios": ratios, "curves": measured, "skipped": compared.skipped}
    tables = [comparison_table(compared.rows), *([paper_table(ratios)] if ratios else []), *curve_tables(measured)]
    print(json.dumps(report)) if as_json else _print(report, tables)
    if out is not None:  # after it was shown: what took minutes is not lost to a place that cannot be written to
        _write(out, report, markdown(report, tables))


def _plan(
    sizes: str | None,
    threads: str,
    runtimes: list[str] | None,
    presets: list[str] | None,
    quick: bool,
    memory: bool | None,
) -> Plan:
    from viflow_anomaly.benchmarking.comparison import Plan
    from viflow_anomaly.benchmarking.subjects import PRESETS, RUNTIMES

    return Plan(
        sizes=_sizes(sizes or (QUICK_SIZES if quick else SIZES)),
        threads=_numbers(threads),
        runtimes=_chosen(runtimes, RUNTIMES, "--runtime") or RUNTIMES,
        required=bool(runtimes),
        presets=_chosen(presets, PRESETS, "--preset") or ["bundled", "paper"],
        repeats=QUICK_REPEATS if quick else REPEATS,
        budget_s=QUICK_BUDGET_S if quick else BUDGET_S,
        memory=not quick if memory is None else memory,
    )


def _chosen(given: list[str] | None, known: Any, option: str) -> Any:
    """Each once, in the order of ``known``."""
    for name in given or ():
        if name not in known:
            raise typer.BadParameter(f"expected one of {', '.join(known)}, found {name!r}", param_hint=option)
    return [name for name in known if name in (given or ())]


def _sizes(text: str) -> list[tuple[int, int]]:
    least, most = SIDE_LIMITS_PX
    found = [re.fullmatch(r"(\d{1,5})x(\d{1,5})", one.strip()) for one in text.split(",")]
    sizes = [(int(one[1]), int(one[2])) for one in found if one]
    if len(sizes) != len(found) or not all(least <= side <= most for size in sizes for side in size):
        raise typer.BadParameter(
            f"expected sizes as 224x224,752x480 with sides of {least} to {most} pixels, found {text!r}",
            param_hint="--sizes",
        )
    return list(dict.fromkeys(sizes))


def _numbers(text: str) -> list[int]:
    numbers = [int(one) if one.strip().isdecimal() else 0 for one in text.split(",")]
    if not all(1 <= number <= 256 for number in numbers):
        raise typer.BadParameter(f"expected numbers from 1 to 256 as in 1,2, found {text!r}", param_hint="--threads")
    return list(dict.fromkeys(numbers))


def _curves(show: OnStep, quick: bool, memory: bool) -> dict[str, Any]:
    from viflow_anomaly.benchmarking.cost_curves import measure_curves

    return measure_curves(show, lengths=QUICK_LENGTHS if quick else LENGTHS, memory=memory)


def _write(out: Path, report: dict[str, Any], text: str) -> None:
    from viflow_anomaly.benchmarking.cost_curves import draw_curves
    from viflow_anomaly.evaluation.report_files import write_report

    stem = out.with_suffix("") if out.suffix in (".json", ".md", ".png") else out
    write_report(stem, report, text)
    if report["curves"] and find_spec("matplotlib") is not None:
        draw_curves(report["curves"], stem)


def _print(report: dict[str, Any], tables: list[Table]) -> None:
    console = report_console()
    console.print(f"{report['cpu']}, {report['cores']} usable cores, load {report['load_1min']} before the run\n")
    for table in tables:
        console.print(rich_table(table))
    for reason in report["skipped"]:
        console.print(f"not measured: {reason}", markup=False, highlight=False)


def register(app: typer.Typer) -> None:
    app.command()(benchmark)

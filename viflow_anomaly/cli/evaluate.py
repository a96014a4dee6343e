"""``viflow-anomaly evaluate``: a model against ground truth."""

from __future__ import annotations

import typer

from viflow_anomaly.cli.evaluate_detect import detect
from viflow_anomaly.cli.evaluate_flow import flow


def register(app: typer.Typer) -> None:
    evaluate = typer.Typer(
        name="evaluate",
        no_args_is_help=True,
        help="""Measure a model against ground truth.

    [bold]Examples[/bold]

      viflow-anomaly evaluate flow runs/held-out/*

      viflow-anomaly evaluate detect runs/held-out/*
    """,
    )
    evaluate.command(no_args_is_help=True)(flow)
    evaluate.command(no_args_is_help=True)(detect)
    app.add_typer(evaluate)

"""Options that several commands share, and how they become ``Settings``."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from viflow_anomaly.detector import AnomalyDetector
    from viflow_anomaly.settings import Settings

EXIT_SOME_FAILED = 3
BUNDLED = Path("default")
"""What ``--init`` calls the weights that come with the package."""
ConfigFile = Annotated[
    Path | None, typer.Option("--config", metavar="FILE", help="TOML or JSON file of settings (see `config`).")
]
Assignments = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="KEY=VALUE", help="One setting, e.g. detector.regions.max_regions=8. Repeatable."),
]
Checkpoint = Annotated[
    Path | None, typer.Option(metavar="PATH", help="Weights to use instead of the bundled model.", show_default=False)
]
Calibration = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE", help="Threshold of a false-alarm budget, as `calibrate` wrote it.", show_default=False
    ),
]
Threads = Annotated[
    int | None,
    typer.Option(
        min=1, help="CPU threads of one pair. 1 (default) answers soonest wherever other programs run.", metavar="N"
    ),
]
Steps = Annotated[int | None, typer.Option(min=1, help="Training steps.")]
Seed = Annotated[int | None, typer.Option(min=0, help="Fixes everything on a CPU.")]
Resume = Annotated[bool, typer.Option("--resume", help="Go on from the last checkpoint in --out.")]
TrainingThreads = Annotated[
    int | None, typer.Option(min=1, metavar="N", help="CPU threads; another number gives other weights (default 1).")
]
Device = Annotated[str | None, typer.Option(metavar="DEVICE", help="cpu (default), cuda, cuda:1, ...")]
Runtime = Annotated[
    str | None, typer.Option(metavar="NAME", help="auto (default), openvino, onnxruntime or torch: docs/runtimes.md.")
]
KeyFile = Annotated[Path | None, typer.Option(metavar="FILE", help="A file that holds the API key for --url.")]
RecordingFolder = Annotated[
    Path, typer.Argument(metavar="DIR", help="EuRoC ASL, KITTI raw, KITTI odometry or the plain layout.")
]
CameraName = Annotated[str | None, typer.Option(metavar="NAME", help="Which camera, e.g. cam1 or image_03.")]
AsJson = Annotated[bool, typer.Option("--json", help="Print JSON on stdout, and nothing else there.")]


def told(defaults: Mapping[str, Any]) -> str:
    """Defaults as a help text names them."""
    return ", ".join(f"{key}={value:g}" for key, value in defaults.items())


def in_section(section: str, defaults: Mapping[str, Any]) -> dict[str, Any]:
    """Defaults of one section, as ``settings_from`` takes them."""
    return {f"{section}.{key}": value for key, value in defaults.items()}


def settings_from(
    config: Path | None,
    assignments: Sequence[str] | None,
    options: Mapping[str, Any] | None = None,
    defaults: Mapping[str, Any] | None = None,
) -> Settings:
    """Command line > environment (``VIFLOW_*``) > file > ``defaults`` > defaults in the code.

    Raises:
        ConfigError: see ``resolve_settings``.
    """
    from viflow_anomaly.settings import resolve_settings

    return resolve_settings(
        config_file=config,
        environment=os.environ,
        assignments=assignments or (),
        options=options,
        defaults=defaults,
    )


def load_detector(settings: Settings, *, evidence: bool = True) -> AnomalyDetector:
    """``load_configured``, whose packages are imported when it is called."""
    from viflow_anomaly.configured_detector import load_configured

    return load_configured(settings, evidence=evidence)

"""``viflow-anomaly groundtruth``: static flow for recordings, from a point cloud or from LiDAR."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeVar

import typer

from viflow_anomaly.cli.options import AsJson
from viflow_anomaly.cli.progress import stderr_progress

if TYPE_CHECKING:
    from viflow_anomaly.ground_truth.euroc_room import RoomSummary
    from viflow_anomaly.ground_truth.kitti_lidar import LidarSummary

Summary = TypeVar("Summary", "RoomSummary", "LidarSummary")

Out = Annotated[
    Path | None,
    typer.Option(metavar="DIR", help="groundtruth0 is made in here (default: in the recording).", show_default=False),
]
Overwrite = Annotated[
    bool, typer.Option("--overwrite", help="Begin anew; without it a second run goes on where the first ended.")
]
Camera = Annotated[
    str | None, typer.Option(metavar="NAME", help="Which of several cameras: cam1, image_03.", show_default=False)
]


def _rendered(things: str, render: Callable[..., Summary], as_json: bool) -> Summary:
    """Render under a progress bar that counts ``things``, on one thread; print the summary where JSON is wanted."""
    import cv2

    cv2.setNumThreads(1)
    with stderr_progress() as progress:
        task = progress.add_task(things, total=None)
        summary = render(on_progress=lambda done, total: progress.update(task, completed=done, total=total))
    if as_json:
        print(json.dumps(asdict(summary) | {"folder": str(summary.folder)}, indent=2))
    return summary


def euroc(
    directory: Annotated[Path, typer.Argument(metavar="DIR", help="A recording in EuRoC layout.")],
    as_json: AsJson = False,
    out: Out = None,
    cloud: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="The room (default: mav0/pointcloud0/data.ply).", show_default=False),
    ] = None,
    trajectory: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Poses of the body, in its clock, instead of the recording's states: EuRoC or OpenVINS csv, or TUM.",
            show_default=False,
        ),
    ] = None,
    camera: Camera = None,
    overwrite: Overwrite = False,
) -> None:
    """Render depth and static flow from the point cloud of EuRoC's Vicon room (the paper's ground truth).

    A frame's pose is interpolated between two at most 10 ms apart, else the nearest one within 1 ms; frames without
    are left out. See docs/ground_truth.md for layout and accuracy.

    [bold]Examples[/bold]

      viflow-anomaly groundtruth euroc V1_01_easy

      viflow-anomaly groundtruth euroc V1_01_easy --out runs/truth/V1_01_easy --trajectory V1_01_easy.csv
    """
    from viflow_anomaly.ground_truth.euroc_room import render_room

    of_room = partial(render_room, directory, out=out, cloud=cloud, trajectory=trajectory)
    summary = _rendered("frames", partial(of_room, camera=camera, overwrite=overwrite), as_json)
    if not as_json:
        _say_room(summary)


def _say_room(summary: RoomSummary) -> None:
    print(
        f"{summary.frames} frames: {summary.rendered} rendered, {summary.kept} were there, {summary.without_pose} "
        f"without a pose; {summary.with_flow} with flow to the next frame -> {summary.folder}"
    )
    if summary.known_share is not None:
        print(f"depth is known for {summary.known_share:.1%} of the pixels")


def kitti(
    drive: Annotated[Path, typer.Argument(metavar="DRIVE", help="A KITTI raw drive with velodyne_points.")],
    as_json: AsJson = False,
    out: Out = None,
    camera: Camera = None,
    overwrite: Overwrite = False,
) -> None:
    """Write sparse static flow from LiDAR scans and OXTS poses, without the points in boxes of what may move.

    Frames without a scan are left out. In frames without labels points on moving things stay in; the answer says how
    many frames these are.

    [bold]Examples[/bold]

      viflow-anomaly groundtruth kitti 2011_09_26/2011_09_26_drive_0005_sync --out runs/truth/0005
    """
    from viflow_anomaly.ground_truth.kitti_lidar import render_lidar

    summary = _rendered("scans", partial(render_lidar, drive, out=out, camera=camera, overwrite=overwrite), as_json)
    if not as_json:
        _say_lidar(summary)


def _say_lidar(summary: LidarSummary) -> None:
    print(
        f"{summary.frames} frames, {summary.with_scan} with a scan: {summary.written} written, {summary.kept} were "
        f"there; {summary.with_flow} with flow to the next frame -> {summary.folder}"
    )
    if summary.written:
        print(
            f"points: {summary.static_points} kept, {summary.hidden_points} hidden, {summary.points_in_boxes} left out "
            "in boxes of what may move"
        )
    if summary.without_labels:
        print(f"{summary.without_labels} frames have no labels: points on moving things are kept there")


def register(app: typer.Typer) -> None:
    commands = typer.Typer(no_args_is_help=True, rich_markup_mode="rich")
    commands.command(no_args_is_help=True)(euroc)
    commands.command(no_args_is_help=True)(kitti)
    app.add_typer(commands, name="groundtruth", help="Make static flow for a recording: EuRoC's rooms, KITTI's LiDAR.")

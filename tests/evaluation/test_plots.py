"""Pictures: what is drawn from what, the same bytes twice, nothing left behind in the process."""

from __future__ import annotations

import json
from collections.abc import Callable
from importlib import util
from pathlib import Path

import cv2
import matplotlib as mpl
import numpy as np
import pytest
from worlds import textured_image

from viflow_anomaly.errors import InvalidInputError, MissingDependencyError
from viflow_anomaly.evaluation import plot_style
from viflow_anomaly.evaluation.flow_pictures import correspondence_picture, flow_colours, flow_wheel_picture
from viflow_anomaly.evaluation.plot_style import OKABE_ITO, SavedPicture, look
from viflow_anomaly.evaluation.plots import (
    FlowPoint,
    clustering_error_histogram,
    epe_by_hypotheses,
    epe_by_runtime,
    hypothesis_wins,
    pareto_front,
    read_wins,
)

POINTS = [
    FlowPoint("imu", "imu-k1", 5.98, 1, 4.7),
    FlowPoint("imu", "imu-k8", 3.87, 8, 8.2),
    FlowPoint("dis-fast", "dis-fast", 2.4, None, 2.7),
    FlowPoint("identity", "identity", 20.6),
]
SHAPE = (48, 64)
TRUE = np.full((*SHAPE, 2), (-4.0, 1.0), np.float32)
VALID = np.ones(SHAPE, np.bool_)


def image(seed: int) -> np.ndarray[tuple[int, ...], np.dtype[np.uint8]]:
    return textured_image(SHAPE[1], SHAPE[0], seed=seed)


def write_metrics(path: Path, lines: list[object]) -> Path:
    path.write_text("".join(json.dumps(line) + "\n" for line in lines))
    return path


def wins(stem: Path) -> SavedPicture:
    lines: list[object] = [{"step": 50 * k, "loss": 1.0, "wins": [0.75, 0.25]} for k in range(1, 9)]
    return hypothesis_wins(write_metrics(stem.with_suffix(".jsonl"), lines), stem, title="k2")


PICTURES: dict[str, Callable[[Path], SavedPicture]] = {
    "clustering": lambda stem: clustering_error_histogram({"EuRoC": [0.0, -0.1, 0.02], "KITTI": [[0.01, -0.01]]}, stem),
    "hypotheses": lambda stem: epe_by_hypotheses(POINTS, stem, title="drone"),
    "runtime": lambda stem: epe_by_runtime(POINTS, stem, title="drone"),
    "wins": wins,
    "flow": lambda stem: flow_wheel_picture(image(0), TRUE, VALID, {"ours": TRUE * 0.9, "dis": TRUE * 1.1}, stem),
    "correspondences": lambda stem: correspondence_picture(image(0), image(1), TRUE, VALID, TRUE * 0.9, stem),
}


@pytest.mark.parametrize("name", PICTURES)
def test_a_picture_has_something_on_it_and_the_same_bytes_twice(tmp_path: Path, name: str) -> None:
    (tmp_path / "again").mkdir()
    first = PICTURES[name](tmp_path / "a")
    with mpl.rc_context({"font.size": 20, "lines.linewidth": 9}):  # a user's own settings
        again = PICTURES[name](tmp_path / "again" / "b")
    assert first == (tmp_path / "a.png", tmp_path / "a.pdf")
    assert first.png.read_bytes() == again.png.read_bytes()
    assert first.pdf.read_bytes() == again.pdf.read_bytes()
    assert first.pdf.read_bytes().startswith(b"%PDF")
    picture = cv2.imread(str(first.png))
    assert picture is not None
    assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 20


def test_pictures_leave_the_process_as_it_was(tmp_path: Path) -> None:
    before = dict(mpl.rcParams)
    PICTURES["runtime"](tmp_path / "a")
    assert dict(mpl.rcParams) == before


def test_without_matplotlib_the_extra_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    find = util.find_spec
    monkeypatch.setattr(plot_style, "find_spec", lambda name: None if name == "matplotlib" else find(name))
    with pytest.raises(MissingDependencyError, match=r"viflow-anomaly\[plots\]") as raised:
        PICTURES["runtime"](tmp_path / "a")
    assert raised.value.code == "plots_unavailable"


def test_series_differ_without_colour() -> None:
    looks = [look(index) for index in range(8)]
    assert len({one.color for one in looks}) == len({one.marker for one in looks}) == 8
    assert len({repr(one.line) for one in looks}) == 8
    assert look(len(OKABE_ITO)).marker != look(0).marker


def test_pareto_front() -> None:
    assert pareto_front([(3.0, 1.0), (1.0, 5.0), (2.0, 5.0), (2.0, 2.0), (4.0, 1.0)]) == [
        (1.0, 5.0),
        (2.0, 2.0),
        (3.0, 1.0),
    ]


def test_colours_of_flow() -> None:
    flow = np.array([[[0.0, 0.0], [10.0, 0.0], [-10.0, 0.0], [99.0, 0.0], [np.nan, 0.0]]], np.float32)
    none, right, left, longer, unknown = flow_colours(flow, 10.0)[0].astype(int)
    assert none.tolist() == [255, 255, 255]
    assert right.tolist() == longer.tolist() == [217, 0, 0]
    assert left.tolist() == [0, 217, 217]
    assert unknown.tolist() == [128, 128, 128]


def refused(draw: Callable[[], object]) -> str:
    with pytest.raises(InvalidInputError) as raised:
        draw()
    return raised.value.code


def test_nothing_to_draw(tmp_path: Path) -> None:
    stem, none = tmp_path / "a", np.zeros(SHAPE, np.bool_)
    empty: list[Callable[[], object]] = [
        lambda: clustering_error_histogram({}, stem),
        lambda: clustering_error_histogram({"EuRoC": []}, stem),
        lambda: clustering_error_histogram({"EuRoC": [np.nan]}, stem),
        lambda: epe_by_hypotheses(POINTS[2:], stem),
        lambda: epe_by_runtime(POINTS[3:], stem),
        lambda: hypothesis_wins(write_metrics(tmp_path / "m.jsonl", [{"step": 1, "epe_px": 2.0}]), stem),
        lambda: flow_wheel_picture(image(0), TRUE, none, {}, stem),
        lambda: correspondence_picture(image(0), image(1), TRUE, none, TRUE, stem),
        lambda: correspondence_picture(image(0), image(1), TRUE, VALID, TRUE * np.float32(np.nan), stem),
    ]
    assert {refused(draw) for draw in empty} == {"plot_empty"}
    assert not list(tmp_path.glob("a.*"))


def test_wins_are_read_in_order(tmp_path: Path) -> None:
    lines = [{"step": 50, "wins": [0.5, 0.5]}, {"step": 50, "epe_px": 1.0}, {"step": 100, "wins": [1, 0]}]
    steps, shares = read_wins(write_metrics(tmp_path / "m.jsonl", list(lines)))
    assert steps.tolist() == [50, 100]
    assert shares.tolist() == [[0.5, 0.5], [1.0, 0.0]]


@pytest.mark.parametrize("line", ["{", "5", '{"wins": [1]}', '{"step": 1, "wins": 5}', '{"step": 2, "wins": [1]}'])
def test_malformed_metrics(tmp_path: Path, line: str) -> None:
    path = tmp_path / "m.jsonl"
    path.write_text('{"step": 1, "wins": [0.5, 0.5]}\n' + line + "\n")
    with pytest.raises(InvalidInputError, match=r"m\.jsonl, line 2") as raised:
        read_wins(path)
    assert raised.value.code == "metrics_malformed"

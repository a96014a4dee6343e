"""What is true of a pixel that an evidence head learns from, and where its thing has its middle."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from evidence_world import recording

from viflow_anomaly.datasets.ground_truth_folder import GroundTruthFolder
from viflow_anomaly.datasets.ground_truth_png import write_instances_png
from viflow_anomaly.evidence_truth import IGNORED, MOVING, SEAM, SIZE_SHIFT, offsets_of, scene_of, truth_of


def truth_folder(path: Path) -> GroundTruthFolder:
    found = GroundTruthFolder.find(path)
    assert found is not None
    return found


def stamps(truth: GroundTruthFolder) -> list[int]:
    return sorted(int(path.stem) for path in (truth.folder / "instances").glob("*.png"))


def test_movers_count_and_slow_ones_do_not(tmp_path: Path) -> None:
    truth = truth_folder(recording(tmp_path / "drone_1"))
    seen = truth_of(scene_of(truth, stamps(truth)[0]))
    assert (seen[10:20, 30:44] == MOVING | 7 << SIZE_SHIFT).all()
    assert (seen[30:40, 5:15] == IGNORED).all()
    assert np.count_nonzero(seen) == 140 + 100


def test_where_two_movers_touch_there_is_a_seam(tmp_path: Path) -> None:
    truth = truth_folder(recording(tmp_path / "drone_1"))
    stamp = stamps(truth)[0]
    instances = truth.instances(stamp)
    instances[10:20, 44:50] = 3
    write_instances_png(truth.folder / "instances" / f"{stamp}.png", instances)
    lines = (truth.folder / "objects.csv").read_text()
    (truth.folder / "objects.csv").write_text(lines + f"{stamp},3,60,44,10,49,19,5.0\n")
    seen = truth_of(scene_of(truth_folder(tmp_path / "drone_1"), stamp))
    large, small = MOVING | 7 << SIZE_SHIFT, MOVING | 6 << SIZE_SHIFT
    assert (seen[10:20, 30:41] == large).all()
    assert (seen[10:20, 41:44] == large | SEAM).all()
    assert (seen[10:20, 44:47] == small | SEAM).all()
    assert (seen[10:20, 47:50] == small).all()


def test_offsets_lead_to_the_middles_of_things() -> None:
    instances = np.zeros((64, 96), np.uint8)
    instances[8:24, 16:48], instances[40:64, 72:96] = 1, 2
    offsets = offsets_of(instances, (16, 24))
    rows, columns = np.mgrid[0:16, 0:24]
    for thing, middle in ((1, (3.5, 7.5)), (2, (12.5, 20.5))):
        mine = instances[2::4, 2::4] == thing
        assert np.abs(rows[mine] + offsets[0][mine] - middle[0]).max() <= 0.5
        assert np.abs(columns[mine] + offsets[1][mine] - middle[1]).max() <= 0.5
    assert not offsets[:, instances[2::4, 2::4] == 0].any()

"""Reports on disk."""

from __future__ import annotations

import json
from pathlib import Path

from viflow_anomaly.evaluation.report_files import write_report


def test_both_files_are_written_below_a_new_folder(tmp_path: Path) -> None:
    write_report(tmp_path / "new" / "one", {"a": 1}, "# One\n")
    assert json.loads((tmp_path / "new" / "one.json").read_text()) == {"a": 1}
    assert (tmp_path / "new" / "one.md").read_text() == "# One\n"
    assert sorted(path.name for path in (tmp_path / "new").iterdir()) == ["one.json", "one.md"]

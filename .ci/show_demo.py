"""Print one detection of a batch run and say where the rest is."""

import json
import sys
from pathlib import Path


def main() -> None:
    out_dir = Path(sys.argv[1])
    with (out_dir / "detections.jsonl").open(encoding="utf-8") as lines:
        detections = [json.loads(line) for line in lines]
    shown = max(detections, key=lambda detection: max((roi["score"] for roi in detection["rois"]), default=0.0))
    print(json.dumps({**shown, "rois": shown["rois"][:1]}, indent=2))
    print(f"(its first ROI of {len(shown['rois'])})")
    print(f"all detections: {out_dir}/detections.jsonl   the run: {out_dir}/run.json")
    print(f"the picture of this one: {out_dir}/overlays/{shown['source_timestamp_ns']}.png   all: {out_dir}/overlays/")


if __name__ == "__main__":
    main()

"""Check that a built wheel holds what an installation needs besides Python modules."""

import json
import sys
import zipfile
from email.parser import Parser
from pathlib import Path

REQUIRED = (
    "viflow_anomaly/py.typed",
    "viflow_anomaly/schemas/detection-1.0.schema.json",
    "viflow_anomaly/cli/main.py",
    "viflow_anomaly_service/dashboard/sample/9.jpg",
    "viflow_anomaly_service/dashboard/sample/recording.json",
    "viflow_anomaly_service/dashboard/static/app.js",
    "viflow_anomaly_service/dashboard/static/index.html",
    "viflow_anomaly_service/server.py",
    "viflow_anomaly_service/store/migrations/versions/v0001_detections.py",
    "viflow_anomaly_service/store/migrations/versions/v0002_events.py",
    "viflow_anomaly_service/events/attach.py",
)
MAX_WEIGHTS_BYTES = 8 * 1024 * 1024


def problems(wheel: zipfile.ZipFile) -> list[str]:
    """What is wrong with the wheel, a line each; empty when all is well."""
    sizes = {entry.filename: entry.file_size for entry in wheel.infolist()}
    found = [f"missing {name}" for name in REQUIRED if name not in sizes]
    weights = {name: size for name, size in sizes.items() if name.startswith("viflow_anomaly/weights/")}
    total = sum(size for name, size in weights.items() if name.endswith((".safetensors", ".onnx")))
    if not 0 < total <= MAX_WEIGHTS_BYTES:
        found.append(f"expected bundled weights of at most {MAX_WEIGHTS_BYTES} bytes, found {total}")
    if not any(name.endswith(".md") for name in weights):
        found.append("missing the model card beside the weights")
    found += [f"unexpected {name}" for name in sizes if name.startswith(("tests/", "service/", "benchmarks/"))]
    schema = "viflow_anomaly/schemas/detection-1.0.schema.json"
    if schema in sizes:
        json.loads(wheel.read(schema))
    metadata = Parser().parsestr(wheel.read(next(n for n in sizes if n.endswith(".dist-info/METADATA"))).decode())
    if metadata["Name"] != "viflow-anomaly":
        found.append(f"expected the name viflow-anomaly, found {metadata['Name']}")
    return found


def main() -> None:
    for name in sys.argv[1:]:
        with zipfile.ZipFile(name) as wheel:
            found = problems(wheel)
        if found:
            sys.exit(f"{Path(name).name}: " + "; ".join(found))
        print(f"{Path(name).name}: {Path(name).stat().st_size / 1024:.0f} KiB, complete")


if __name__ == "__main__":
    main()

"""Make the recording that the dashboard plays (service/dashboard/sample) from the bundled sample, small as JPEG."""

import json
from pathlib import Path

import cv2

from viflow_anomaly.datasets.registry import open_recording

ROOT = Path(__file__).parents[1]
QUALITY = 92


def main() -> None:
    out = ROOT / "service" / "dashboard" / "sample"
    out.mkdir(exist_ok=True)
    folder = ROOT / "samples" / "drone"
    recording = open_recording(folder)
    frames = sorted((folder / "mav0" / "cam0" / "data").glob("*.png"))
    for number, frame in enumerate(frames):
        image = cv2.imread(str(frame), cv2.IMREAD_GRAYSCALE)
        cv2.imwrite(str(out / f"{number}.jpg"), image, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
    samples = recording.imu.between(int(frames[0].stem) - 250_000_000, int(frames[-1].stem) + 10_000_000)
    start_ns = int(frames[0].stem)  # stamps count from here: a browser's numbers are doubles
    told = {
        "frames_ns": [int(frame.stem) - start_ns for frame in frames],
        "imu": {
            "timestamps_ns": (samples.timestamps_ns - start_ns).tolist(),
            "gyro_rad_s": samples.gyro_rad_s.round(6).tolist(),
            "accel_m_s2": samples.accel_m_s2.round(5).tolist(),
        },
        "camera": json.loads((folder / "camera.json").read_text(encoding="utf-8")),
    }
    text = json.dumps(told, separators=(",", ":"))
    (out / "recording.json").write_text(text + "\n", encoding="utf-8")
    print(f"{len(frames)} frames, {sum(path.stat().st_size for path in out.iterdir()) / 1024:.0f} KiB")


if __name__ == "__main__":
    main()

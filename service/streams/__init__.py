"""Streams over HTTP: frames and IMU samples as they come, tracked detections out."""

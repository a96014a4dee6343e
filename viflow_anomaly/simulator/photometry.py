"""From rendered brightness to what a cheap camera delivers: exposure, gamma, vignetting, noise."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from viflow_anomaly.geometry import pixel_grid
from viflow_anomaly.sensor_data import PinholeCamera, Uint8Array
from viflow_anomaly.simulator.harmonics import Harmonics

Float32Array = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Photometry:
    """One sequence's camera response.

    Args:
        gain: exposure factor; log_drift: its slow change over time (natural log).
        gamma: exponent on brightness in 0..1.
        vignette: [H, W] factor, 1 in the middle.
        read_noise_gray, shot_noise: deviation = sqrt(read^2 + shot * gray).
    """

    gain: float
    log_drift: Harmonics
    gamma: float
    vignette: Float32Array
    read_noise_gray: float
    shot_noise: float

    def develop(self, rendered: Uint8Array, time_s: float, rng: np.random.Generator) -> Uint8Array:
        """[H, W] rendered -> [H, W] uint8 as the camera would store it."""
        exposure = self.gain * float(np.exp(self.log_drift.at(np.array([time_s]))[0]))
        levels = np.arange(256, dtype=np.float32) / 255.0
        response = (255.0 * (np.minimum(levels * exposure, 4.0)) ** self.gamma).astype(np.float32)
        gray = response[rendered] * self.vignette
        deviation = np.sqrt(self.read_noise_gray**2 + self.shot_noise * gray)
        noisy = gray + deviation * rng.standard_normal(gray.shape, dtype=np.float32)
        return np.asarray(np.clip(np.rint(noisy), 0, 255), dtype=np.uint8)


def draw_photometry(
    rng: np.random.Generator, camera: PinholeCamera, probes: list[Uint8Array], times_s: NDArray[np.float64]
) -> Photometry:
    """Draw a camera response.

    The exposure brings the mean of the probe images to 80-140 unless 5 to 45 % of their pixels would burn out.
    """
    offsets = pixel_grid(camera.height, camera.width) - np.array([camera.cx, camera.cy], np.float32)
    radius2 = (offsets**2).sum(axis=-1)
    vignette = 1.0 - rng.uniform(0.0, 0.35) * radius2 / radius2.max()
    gamma = float(rng.uniform(0.8, 1.2))
    pixels = np.stack(probes).astype(np.float64) / 255.0
    wanted_mean, brightest = rng.uniform(80, 140) / 255.0, float(np.percentile(pixels, rng.uniform(55, 95)))
    mean = max(float(np.mean(pixels**gamma)), 1e-3)
    gain = min((wanted_mean / mean) ** (1 / gamma), 1.05 / max(brightest, 1e-3))
    drift = Harmonics.random(rng, frequencies_hz=(0.05, 0.5), count=4)
    return Photometry(
        gain=float(np.clip(gain, 0.2, 5.0)),
        log_drift=drift.with_rms(float(rng.uniform(0.0, 0.08)), times_s),
        gamma=gamma,
        vignette=vignette.astype(np.float32),
        read_noise_gray=float(rng.uniform(0.5, 2.5)),
        shot_noise=float(rng.uniform(0.0, 0.04)),
    )

"""Sums of sinusoids: smooth, band-limited functions with exact derivatives of every order."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np

from viflow_anomaly.sensor_data import Float64Array


@dataclass(frozen=True, eq=False)
class Harmonics:
    """f(x) = sum_k amplitudes[k] * sin(rates[k] * x + phases[k]); rates in rad per unit of x (seconds, metres)."""

    amplitudes: Float64Array
    rates: Float64Array
    phases: Float64Array

    @classmethod
    def random(
        cls, rng: np.random.Generator, *, frequencies_hz: tuple[float, float], count: int = 6, slope: float = 1.0
    ) -> Self:
        """Frequencies log-uniform within the band, amplitudes falling as frequency^-slope."""
        frequencies = np.exp(rng.uniform(np.log(frequencies_hz[0]), np.log(frequencies_hz[1]), size=count))
        amplitudes = rng.uniform(0.5, 1.0, count) * (frequencies / frequencies_hz[0]) ** -slope
        return cls(amplitudes, 2 * np.pi * frequencies, rng.uniform(0, 2 * np.pi, count))

    @classmethod
    def zero(cls) -> Self:
        return cls(np.zeros(1), np.ones(1), np.zeros(1))

    def at(self, x: Float64Array, derivative: int = 0) -> Float64Array:
        """[N] -> [N], the given derivative (0 is the function itself)."""
        angles = np.multiply.outer(x, self.rates) + self.phases + derivative * np.pi / 2
        return np.asarray(np.sin(angles) @ (self.amplitudes * self.rates**derivative))

    def scaled(self, factor: float) -> Harmonics:
        return Harmonics(self.amplitudes * factor, self.rates, self.phases)

    def with_rms(self, rms: float, x: Float64Array, derivative: int = 0) -> Harmonics:
        """Scaled so that the derivative's root mean square over the points x is ``rms``."""
        present = float(np.sqrt(np.mean(self.at(x, derivative) ** 2)))
        return self.scaled(rms / max(present, 1e-9))

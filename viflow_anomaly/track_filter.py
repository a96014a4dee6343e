"""Kalman filter of one box: constant velocity of its centre and of the logarithm of its sides.

The four channels (centre u, centre v, log width, log height) are independent, so that each is a filter of two numbers
in closed form. The motion of the camera is no part of the state: ``predicted`` is told the shift of the static world,
and the rate that is left is the thing's own. Sides are logarithms because an approaching thing grows by a constant
share, a growing share of noise goes with a growing box, and a box never turns inside out.
"""

from __future__ import annotations

import math
from typing import NamedTuple, Self

from viflow_anomaly.regions import BoundingBox


class Channel(NamedTuple):
    """A value, its rate for a second, and their covariance."""

    value: float
    rate: float
    value_variance: float
    covariance: float
    rate_variance: float

    def predicted(self, interval_s: float, shift: float, acceleration_density: float) -> Channel:
        """After ``interval_s``; white acceleration of spectral density [unit^2 / s^3] (Bar-Shalom et al., 2001, 6.2.2).

        ``shift`` moves the value and leaves the rate as it is.
        """
        variance, covariance, rate_variance = self.value_variance, self.covariance, self.rate_variance
        return Channel(
            self.value + self.rate * interval_s + shift,
            self.rate,
            variance
            + interval_s * (2.0 * covariance + interval_s * (rate_variance + acceleration_density * interval_s / 3.0)),
            covariance + interval_s * (rate_variance + acceleration_density * interval_s / 2.0),
            rate_variance + acceleration_density * interval_s,
        )

    def updated(self, measured: float, variance: float) -> Channel:
        """After a measurement of the value."""
        total = self.value_variance + variance
        gain, rate_gain = self.value_variance / total, self.covariance / total
        innovation = measured - self.value
        return Channel(
            self.value + gain * innovation,
            self.rate + rate_gain * innovation,
            self.value_variance * (1.0 - gain),
            self.covariance * (1.0 - gain),
            self.rate_variance - rate_gain * self.covariance,
        )


class BoxNoise(NamedTuple):
    """What the filter takes for granted of boxes and their motion.

    Attributes:
        center_sigma: of a measured centre, as a share of the box's side.
        log_side_sigma: of a measured side's logarithm.
        own_speed_px_s: sigma of a new thing's own speed.
        growth_s: sigma of a new box's growth: its sides' logarithm for a second.
        acceleration_px_s: how far own speed strays within a second (sigma).
        growth_change_s: how far growth strays within a second (sigma).
    """

    center_sigma: float
    log_side_sigma: float
    own_speed_px_s: float
    growth_s: float
    acceleration_px_s: float
    growth_change_s: float


class BoxMeasurement(NamedTuple):
    """A region's box in the channels of the filter: centre u, v in pixels, logarithms of width and height."""

    values: tuple[float, float, float, float]
    variances: tuple[float, float, float, float]


def measure(box: BoundingBox, noise: BoxNoise) -> BoxMeasurement:
    """What a box says, and how far it is to be trusted."""
    side_variance = noise.log_side_sigma**2
    return BoxMeasurement(
        (*box.middle_px, math.log(box.width), math.log(box.height)),
        ((noise.center_sigma * box.width) ** 2, (noise.center_sigma * box.height) ** 2, side_variance, side_variance),
    )


class BoxState(NamedTuple):
    """A box as the filter knows it; the centre in pixels (u, v), the sides as logarithms of pixels."""

    u: Channel
    v: Channel
    log_width: Channel
    log_height: Channel

    @classmethod
    def seen_first(cls, box: BoundingBox, noise: BoxNoise) -> Self:
        """As measured; at rest in the static world, with the doubt that ``noise`` states."""
        seen = measure(box, noise)
        doubts = (noise.own_speed_px_s, noise.own_speed_px_s, noise.growth_s, noise.growth_s)
        return cls(
            *(
                Channel(value, 0.0, variance, 0.0, doubt**2)
                for value, variance, doubt in zip(seen.values, seen.variances, doubts, strict=True)
            )
        )

    def predicted(self, interval_s: float, shift_px: tuple[float, float], noise: BoxNoise) -> BoxState:
        """After ``interval_s`` in which the static world moved by ``shift_px`` (u, v) at the box's place."""
        speed, growth = noise.acceleration_px_s**2, noise.growth_change_s**2
        return BoxState(
            self.u.predicted(interval_s, shift_px[0], speed),
            self.v.predicted(interval_s, shift_px[1], speed),
            self.log_width.predicted(interval_s, 0.0, growth),
            self.log_height.predicted(interval_s, 0.0, growth),
        )

    def updated(self, seen: BoxMeasurement) -> BoxState:
        """After a measured box."""
        return BoxState(*map(Channel.updated, self, seen.values, seen.variances))

    @property
    def center_px(self) -> tuple[float, float]:
        """(u, v)."""
        return self.u.value, self.v.value

    @property
    def own_velocity_px_s(self) -> tuple[float, float]:
        """(u, v) beyond the motion of the static world."""
        return self.u.rate, self.v.rate

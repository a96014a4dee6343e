"""Regions of successive pairs -> tracks: the same moving thing keeps one number through a stream.

``Tracker.update`` is a pure function of a state and a detection. What a detection says of the static world's motion
stands in the evidence of its ROIs, so that the lines of ``detections.jsonl`` are all that tracking needs. One step:

1. each track is carried to the new source frame: by the flow of the static world at its place and its own velocity;
2. regions are linked to tracks, at the least total cost among those near enough;
3. a linked region corrects its track's filter; the second one in a row confirms the track and numbers it;
4. a region labelled ``independent_motion`` that no track takes opens a tentative track;
5. a track that is missed for too long ends.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from viflow_anomaly.config import TrackingConfig
from viflow_anomaly.detection import Detection, ImageSize, Roi
from viflow_anomaly.errors import InvalidInputError
from viflow_anomaly.track_filter import BoxNoise, BoxState, measure
from viflow_anomaly.track_labels import TrackLabel, static_flow_px, untracked, with_tracks

Vector = tuple[float, float]
CONFIRMING_SIGHTINGS = 2
TOO_FAR = 1e6
"""Cost of a link that the gate forbids: more than all others together."""
NEAR_PX = 1.0
"""Regions nearer than this speak alike of the static world's flow at a place."""


class Track(NamedTuple):
    """One thing that moves by itself, or may.

    Attributes:
        track_id: None while tentative.
        box: its filter, at the source frame of the state it belongs to.
        static_px_s: (u, v) velocity of the static world at its place from that frame on.
        sightings: regions that fed it.
        last_seen_ns: source stamp of the last of them.
    """

    track_id: int | None
    box: BoxState
    static_px_s: Vector
    sightings: int
    last_seen_ns: int


@dataclass(frozen=True)
class TrackingState:
    """What a stream remembers; ``TrackingState()`` begins one.

    Attributes:
        tracks: at the source frame ``source_ns``, in the order in which they were opened.
        next_id: the number that the next confirmed track gets; numbers are never used again.
        source_ns: source stamp of the last detection.
        image: its size; boxes in an image of another size mean something else.
    """

    tracks: tuple[Track, ...] = ()
    next_id: int = 1
    source_ns: int | None = None
    image: ImageSize | None = None


class _Link(NamedTuple):
    """A track and the region that it was seen as, if it was."""

    track: Track
    roi: Roi | None


@dataclass(frozen=True)
class Tracker:
    """Follows regions through a stream. Holds its configuration only: threads and streams may share it."""

    config: TrackingConfig

    def update(self, state: TrackingState, detection: Detection) -> tuple[TrackingState, Detection]:
        """One step of a stream.

        Args:
            state: after the detection before; ``TrackingState()`` at the beginning. It is left as it was.
            detection: of the next pair. What an earlier tracking put into it is taken out first.

        Returns:
            The state after it, and the detection with its ``track_id`` filled. An abstained detection is no evidence
            against any track.

        Raises:
            InvalidInputError: ``pair_out_of_order``: the detection's source is not later than the one before.
        """
        detection = untracked(detection)
        noise = _noise(self.config, detection.image)
        tracks = self._carried(state, detection, noise)
        if detection.status == "abstained":
            return replace(_at(detection, tracks), next_id=state.next_id), detection
        # In an order of their own, so that their order in the detection decides nothing.
        rois = sorted(filter(self._may_feed, detection.rois), key=lambda roi: (-roi.score, roi.bbox))
        links = self._linked(tracks, rois, detection.source_timestamp_ns, noise)
        links = [link for link in links if link.roi or self._survives(link.track, detection)]
        links += self._opened(rois, links, detection, noise)
        links, next_id = self._numbered(links, state.next_id)
        flow = _StaticFlow.of(detection)
        after = replace(_at(detection, [flow.carry(link) for link in links]), next_id=next_id)
        labels = {
            roi.id: TrackLabel(track.track_id, track.box.own_velocity_px_s)
            for track, roi in links
            if roi is not None and track.track_id is not None
        }
        return after, with_tracks(detection, labels, require_persistence=self.config.require_persistence)

    def _carried(self, state: TrackingState, detection: Detection, noise: BoxNoise) -> list[Track]:
        """The tracks at the detection's source frame; none behind a gap or a change of the image's size."""
        now_ns, before_ns = detection.source_timestamp_ns, state.source_ns
        if before_ns is None:
            return []
        if now_ns <= before_ns:
            raise InvalidInputError(
                f"source_timestamp_ns: expected later than the pair before, {before_ns}, found {now_ns}; "
                "pairs are tracked in the order of their source frames, each once",
                code="pair_out_of_order",
                field="source_timestamp_ns",
            )
        interval_s = (now_ns - before_ns) * 1e-9
        return [
            track._replace(box=track.box.predicted(interval_s, _times(track.static_px_s, interval_s), noise))
            for track in state.tracks
            if state.image == detection.image and now_ns - track.last_seen_ns <= _nanoseconds(self.config.max_gap_s)
        ]

    def _may_feed(self, roi: Roi) -> bool:
        return roi.label == "independent_motion" or roi.score >= self.config.feed_score

    def _linked(self, tracks: Sequence[Track], rois: Sequence[Roi], now_ns: int, noise: BoxNoise) -> list[_Link]:
        """Each track with the region that it is seen as, corrected by it: least total cost within the gate.

        The cost is the negative logarithm of the measurement's likelihood, so that a track in doubt does not take a
        region from one that knows better.
        """
        if not tracks or not rois:
            return [_Link(track, None) for track in tracks]
        seen = [measure(roi.bbox, noise) for roi in rois]
        means = np.array([[channel.value for channel in track.box] for track in tracks])  # [N, 4]
        variances = np.array([[channel.value_variance for channel in track.box] for track in tracks])  # [N, 4]
        spread = variances[:, None] + np.array([one.variances for one in seen])  # [N, M, 4]
        distances = ((np.array([one.values for one in seen]) - means[:, None]) ** 2 / spread).sum(axis=-1)
        near = distances <= self.config.gate_sigmas**2
        sure = np.array([track.track_id is not None for track in tracks])
        moving = np.array([roi.label == "independent_motion" for roi in rois])
        costs = np.where(near & (sure[:, None] | moving[None]), distances + np.log(spread).sum(axis=-1), TOO_FAR)
        from scipy.optimize import linear_sum_assignment  # noqa: PLC0415  # a single pair's start-up has no use for it

        links = [_Link(track, None) for track in tracks]
        for i, j in zip(*linear_sum_assignment(costs), strict=True):
            if costs[i, j] < TOO_FAR:
                box = tracks[i].box.updated(seen[j])
                fed = tracks[i]._replace(box=box, sightings=tracks[i].sightings + 1, last_seen_ns=now_ns)
                links[i] = _Link(fed, rois[j])
        return links

    def _survives(self, track: Track, detection: Detection) -> bool:
        """Whether a track goes on that this detection does not show."""
        missed_ns = detection.source_timestamp_ns - track.last_seen_ns
        u, v = track.box.center_px
        inside = 0 <= u < detection.image.width and 0 <= v < detection.image.height
        return track.track_id is not None and missed_ns <= _nanoseconds(self.config.max_missed_s) and inside

    def _opened(
        self, rois: Sequence[Roi], links: Sequence[_Link], detection: Detection, noise: BoxNoise
    ) -> list[_Link]:
        """New tracks of the moving regions that no track takes, as many as there is room for, highest score first."""
        taken = {link.roi.id for link in links if link.roi}
        free = [roi for roi in rois if roi.label == "independent_motion" and roi.id not in taken]
        now_ns = detection.source_timestamp_ns
        return [
            _Link(Track(None, BoxState.seen_first(roi.bbox, noise), (0.0, 0.0), 1, now_ns), roi)
            for roi in free[: max(0, self.config.max_tracks - len(links))]
        ]

    def _numbered(self, links: Sequence[_Link], next_id: int) -> tuple[list[_Link], int]:
        """Confirm what was seen often enough or clearly enough."""
        numbered = []
        for track, roi in links:
            clear = roi is not None and roi.score >= self.config.confirm_score
            if track.track_id is None and (track.sightings >= CONFIRMING_SIGHTINGS or clear):
                numbered.append(_Link(track._replace(track_id=next_id), roi))
                next_id += 1
            else:
                numbered.append(_Link(track, roi))
        return numbered, next_id


class _StaticFlow(NamedTuple):
    """What a detection says of the static world's velocity, (u, v) in px/s.

    Attributes:
        of_roi: by ROI id, at the middle of its box.
        places: (middle, velocity) of all ROIs, whatever their label, in an order of their own.
    """

    of_roi: dict[int, Vector]
    places: list[tuple[Vector, Vector]]

    @classmethod
    def of(cls, detection: Detection) -> _StaticFlow:
        per_s = 1e9 / (detection.target_timestamp_ns - detection.source_timestamp_ns)
        told = {roi.id: _times(flow, per_s) for roi in detection.rois if (flow := static_flow_px(roi))}
        places = sorted((roi.bbox.middle_px, told[roi.id]) for roi in detection.rois if roi.id in told)
        return cls(told, places)  # sorted: sums of floats depend on their order

    def carry(self, link: _Link) -> Track:
        """The track with the velocity at its place: its own region's; else the mean of all, the nearest counting most.

        The weights are inverse squared distances. Where no region tells anything the velocity stays as it was.
        """
        track, roi = link
        if roi is not None and roi.id in self.of_roi:
            return track._replace(static_px_s=self.of_roi[roi.id])
        if not self.places:
            return track
        u, v = track.box.center_px
        weights = [1.0 / ((x - u) ** 2 + (y - v) ** 2 + NEAR_PX**2) for (x, y), _ in self.places]
        sums = [sum(w * told[k] for w, (_, told) in zip(weights, self.places, strict=True)) for k in (0, 1)]
        total = sum(weights)
        return track._replace(static_px_s=(sums[0] / total, sums[1] / total))


def _at(detection: Detection, tracks: Sequence[Track]) -> TrackingState:
    return TrackingState(tuple(tracks), source_ns=detection.source_timestamp_ns, image=detection.image)


def _nanoseconds(seconds: float) -> int:
    return round(seconds * 1e9)


def _times(vector: Vector, factor: float) -> Vector:
    return vector[0] * factor, vector[1] * factor


def _noise(config: TrackingConfig, image: ImageSize) -> BoxNoise:
    diagonal_px = float(np.hypot(image.width, image.height))
    return BoxNoise(
        center_sigma=config.center_sigma,
        log_side_sigma=config.log_side_sigma,
        own_speed_px_s=config.own_speed_fraction_s * diagonal_px,
        growth_s=config.growth_s,
        acceleration_px_s=config.acceleration_fraction_s * diagonal_px,
        growth_change_s=config.growth_s,
    )

"""Configuration: frozen, typed, unknown keys rejected, never silently repaired.

Lengths that act on an image are fractions of its diagonal or of its sides, so that a setting survives a change of
image size. The resolved configuration is saved beside every result.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    PositiveFloat,
    PositiveInt,
    ValidationError,
    field_validator,
    model_validator,
)

from viflow_anomaly.errors import ConfigError


def usable_path(path: Path) -> Path:
    """A path that the operating system can be asked about; texts with NUL or lone surrogates are none.

    Raises:
        ValueError: expected a path, found something else.
    """
    if "\0" in str(path) or any("\ud800" <= character <= "\udfff" for character in str(path)):
        raise ValueError(f"expected a path, found {str(path)!r}")
    return path


UsablePath = Annotated[Path, AfterValidator(usable_path)]


class FrozenConfig(BaseModel):
    """Base of all configuration sections: immutable, strict about keys, finite numbers only."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    @classmethod
    def from_mapping(cls, values: object, *, where: str) -> Self:
        """Validate a mapping read from a file or a request.

        Raises:
            ConfigError: code ``config_invalid``; names every key at fault and ``where`` it came from.
        """
        try:
            return cls.model_validate(values)
        except ValidationError as err:
            first = err.errors()[0]["loc"]
            raise ConfigError(
                f"{where}: " + describe_validation(err), code="config_invalid", field=".".join(map(str, first)) or None
            ) from err


def describe_validation(err: ValidationError) -> str:
    """One line a person can act on: every field at fault, what is wrong, what was found."""
    parts = []
    for problem in err.errors():
        place = ".".join(str(step) for step in problem["loc"]) or "(root)"
        found = "" if problem["type"] == "missing" else f", found {problem.get('input')!r:.80}"
        parts.append(f"{place}: {fault_text(problem['type'], problem['msg'])}{found}")
    return "; ".join(parts)


def fault_text(kind: str, message: str) -> str:
    """What pydantic says of a fault, in words for those who do not know it."""
    return "there is no such field" if kind == "extra_forbidden" else message


class ImageLimits(FrozenConfig):
    """Checked on the header, before anything is decoded."""

    max_bytes: PositiveInt = 32 * 1024 * 1024
    max_pixels: PositiveInt = 16 * 1024 * 1024


class ViewConfig(FrozenConfig):
    """Which part of the image a network sees, and at which scale.

    ``whole``: the whole image is resampled to a pinhole view of focal length ``focal_px`` without distortion when the
    camera is known (at most ``max_pinhole_width`` x ``max_pinhole_height``: a wide lens spreads far without its
    distortion), else shrunk to ``max_width`` x ``max_height`` (never enlarged). ``center_crop``: the paper's middle
    crop of ``crop_size`` pixels, not resampled.
    """

    mode: Literal["whole", "center_crop"] = "whole"
    focal_px: PositiveFloat = 116.0
    max_width: PositiveInt = 192
    max_height: PositiveInt = 128
    max_pinhole_width: PositiveInt = 320
    max_pinhole_height: PositiveInt = 256
    crop_size: PositiveInt = 224


class MotionWindowConfig(FrozenConfig):
    """How IMU samples become the fixed window that a network eats.

    ``paper_euroc`` (50x6) and ``paper_kitti`` (20x6) are the paper's layouts of raw samples [Datasets]. ``resampled``
    takes bin means at any IMU rate: ``samples_before`` bins over ``before_s`` seconds ahead of the source frame, then
    ``samples_between`` bins over the frame interval. ``axes``: ``sensor`` leaves the vectors in the IMU frame,
    ``camera`` rotates them into the camera frame where ``T_cam_imu`` is known.
    """

    layout: Literal["resampled", "paper_euroc", "paper_kitti"] = "resampled"
    axes: Literal["sensor", "camera"] = "camera"
    before_s: PositiveFloat = 0.05
    samples_before: PositiveInt = 4
    samples_between: PositiveInt = 12

    @property
    def rows(self) -> int:
        """T of the [T, 6] window."""
        fixed = {"paper_euroc": 50, "paper_kitti": 20}
        return fixed.get(self.layout, self.samples_before + self.samples_between)


MotorSource = Literal["command", "displacement"]
MotionInputs = Literal["imu", "sffms", "imu+sffms", "motor", "imu+motor"]


class MotorConfig(FrozenConfig):
    """How a displacement or a command becomes the numbers of the motor stream; see ``motor_input``.

    ``sffms`` [Methods]: K-means over the training pairs' displacements, one-hot. ``motor``: the command's own numbers,
    standardised. What is fitted stays empty until a training fits it, and is saved in the checkpoint.
    """

    clusters: int = Field(default=20, ge=1, le=1024)
    centroids_m: tuple[tuple[float, float, float], ...] = Field(
        default=(), description="fitted: displacements along the source camera's axes"
    )
    mean: tuple[float, ...] = Field(default=(), max_length=64, description="fitted: of the command's numbers")
    deviation: tuple[PositiveFloat, ...] = Field(default=(), max_length=64, description="fitted, one for each mean")

    @model_validator(mode="after")
    def _fitted_as_a_whole(self) -> Self:
        if self.centroids_m and len(self.centroids_m) != self.clusters:
            raise ValueError(f"centroids_m: expected none or {self.clusters}, found {len(self.centroids_m)}")
        if len(self.mean) != len(self.deviation):
            raise ValueError(f"deviation: expected as many numbers as mean, {len(self.mean)}, found {self.deviation}")
        return self


class ModelConfig(FrozenConfig):
    """What the builder needs to make a network; saved in its checkpoint."""

    preset: Literal["paper", "compact", "calibrated"] = "calibrated"
    hypotheses: Literal[1, 4, 8] = 8
    view: ViewConfig = ViewConfig()
    motion_inputs: MotionInputs = "imu"
    motion_window: MotionWindowConfig = MotionWindowConfig()
    motor: MotorConfig = MotorConfig()

    @property
    def uses_imu(self) -> bool:
        return "imu" in self.motion_inputs

    @property
    def motor_source(self) -> MotorSource | None:
        """What ``FramePair.motor_command`` must hold for this model."""
        if "sffms" in self.motion_inputs:
            return "displacement"
        return "command" if "motor" in self.motion_inputs else None

    @property
    def motor_is_fitted(self) -> bool:
        """Whether the motor stream, where there is one, has the values that a training fits."""
        if self.motor_source is None:
            return True
        return bool(self.motor.centroids_m if self.motor_source == "displacement" else self.motor.mean)

    @property
    def motor_numbers(self) -> int:
        """How many numbers the network's motor stream takes; 0: it has none, or a command that is not fitted yet."""
        return {"displacement": self.motor.clusters, "command": 2 * len(self.motor.mean), None: 0}[self.motor_source]

    @model_validator(mode="after")
    def _window_ends_with_the_interval(self) -> Self:
        # The convolutional presets turn the last ``samples_between`` rows into the rotation between the frames.
        layout = self.motion_window.layout
        if self.preset != "paper" and layout != "resampled":
            raise ValueError(
                f"motion_window.layout: expected 'resampled' for the preset {self.preset!r}, found {layout!r} "
                "(the preset 'paper' takes any)"
            )
        return self

    @model_validator(mode="after")
    def _rotation_comes_from_the_gyro(self) -> Self:
        if self.preset == "calibrated" and not self.uses_imu:
            raise ValueError(
                "motion_inputs: expected one with 'imu' for the preset 'calibrated', whose rotation is the gyro's, "
                f"found {self.motion_inputs!r}"
            )
        return self


MIN_SOFTENING_GRAY = 0.1


ShapeRuleName = Literal["axis_aligned", "thickness", "oriented", "none"]
"""See ``shape_rule``."""


class RegionConfig(FrozenConfig):
    """From evidence to labelled regions; see ``regions`` and ``moving_regions`` for each step.

    Fractions are of the image diagonal unless the name says otherwise; the residual is in gray levels 0-255.
    Regions of learned evidence (``moving_regions``) know ``min_motion_probability``, ``faint_motion_probability``,
    ``min_motion_extent_fraction`` and ``min_score`` in place of ``threshold_mads``, ``min_residual_gray``, smoothing,
    opening, closing and the smallest extents in x and in y.
    """

    texture_softening_gray: float = Field(
        default=10.0, ge=0, le=255, description="residuals count less on edges, see texture_normalised; 0: all alike"
    )
    smoothing_fraction: float = Field(default=0.003, ge=0, le=0.02)
    threshold_mads: PositiveFloat = 6.0
    min_residual_gray: float = Field(default=6.0, ge=0, le=255, description="of the normalised residual")
    min_motion_probability: float = Field(
        default=0.5, ge=0.01, le=0.99, description="of a pixel, with learned evidence"
    )
    faint_motion_probability: float = Field(
        default=0.15,
        ge=0.01,
        le=0.99,
        description="of a thing that nowhere reaches the other; above it: none",
    )
    opening_fraction: float = Field(default=0.004, ge=0, le=0.1)
    closing_fraction: float = Field(default=0.012, ge=0, le=0.1)
    min_area_fraction: float = Field(default=0.0006, ge=0, le=1, description="of the image's area")
    max_regions: int = Field(default=64, ge=1, le=4096)
    shape_rule: ShapeRuleName = Field(
        default="axis_aligned", description="what tells motion from narrow bands; axis_aligned: the paper's"
    )
    min_x_extent_fraction: float = Field(
        default=0.018, ge=0, le=1, description="of the diagonal, in the residual: narrower is a band"
    )
    min_y_extent_fraction: float = Field(
        default=0.018, ge=0, le=1, description="of the diagonal, in the residual: narrower is a band"
    )
    min_motion_extent_fraction: float = Field(
        default=0.008, ge=0, le=1, description="of the diagonal, with learned evidence: narrower in x or y is a band"
    )
    max_aspect_ratio: float = Field(default=5.0, ge=1, description="a longer bounding box is a band")
    min_score: float = Field(
        default=0.001, ge=0, le=0.5, description="with learned evidence: a region that scores less is not told"
    )
    motion_score: float = Field(
        default=0.5, ge=0.5, le=1.01, description="independent_motion scores at least this; above 1: nothing does"
    )

    @model_validator(mode="after")
    def _softening_is_none_or_visible(self) -> Self:
        if 0 < self.texture_softening_gray < MIN_SOFTENING_GRAY:
            raise ValueError(
                f"texture_softening_gray: expected 0 or at least {MIN_SOFTENING_GRAY}, "
                f"found {self.texture_softening_gray}"
            )
        return self


MAX_THREADS = 1024
Precision = Literal["auto", "f32", "bf16", "int8"]
"""What a network is computed in. "auto": float32 on a CPU, but for the evidence head in OpenVINO, which takes bfloat16
where the CPU computes in it; bfloat16 in torch on CUDA. "int8" takes an export of ``export --int8``."""
NetworkPrecision = Literal["auto", "f32", "bf16"]
"""The network's own; int8 is hardly faster there than bfloat16 and may cost regions, see docs/runtimes.md."""
RuntimeName = Literal["auto", "torch", "openvino", "onnxruntime"]
"""What runs the networks: "auto" is OpenVINO, else ONNX Runtime, on a CPU where it is installed and the checkpoint was
exported, else torch."""


class CorrectionConfig(FrozenConfig):
    """How the predicted motion is refined on the target image; see ``correction``."""

    enabled: bool = True
    rounds: int = Field(default=4, ge=1, le=50)
    depth_rounds: int = Field(default=2, ge=0, le=50, description="of the depth's refinement; 0: depth as predicted")
    tolerance_px: float = Field(
        default=0.7, ge=0.01, le=100, description="view pixels at which a cell's weight is halved"
    )
    rotation_sigma_rad: float = Field(
        default=0.004, ge=1e-6, le=10, description="how far the gyro's rotation may be off"
    )
    translation_sigma: float = Field(
        default=1.0, ge=1e-6, le=1e3, description="view's unit; damps what nothing speaks for"
    )
    lattice_px: PositiveInt = Field(default=8, description="view pixels between the flow cells that take part")
    min_inlier_share: float = Field(default=0.15, ge=0, le=1, description="below it the answer says motion_unconfirmed")
    min_confidence: float = Field(
        default=0.002, ge=0, le=1, description="mean of the cells' confidence below which nothing is corrected"
    )


class QualityConfig(FrozenConfig):
    """Which pairs are not judged, or with less trust; see ``pair_quality``.

    A second limit (``abstain_...``) counts where the first is passed, too.
    """

    abstain_exposure_jump_gray: float = Field(default=110.0, ge=0, description="a larger change of the mean abstains")
    max_clipped_share: float = Field(
        default=0.35, ge=0, le=1, description="black or white pixels of an image; a jump of exposure with more abstains"
    )
    max_contrast_ratio: float = Field(
        default=2.2, ge=1, description="of the images' deviations; a jump of exposure with more abstains"
    )
    max_blur_ratio: float = Field(default=1.6, ge=1, description="sharpness of one image over the other's")
    abstain_blur_ratio: float = Field(default=5.0, ge=1, description="beyond it a blurred pair is not judged")
    frozen_turn_rate_rad_s: float = Field(
        default=0.1, ge=0, description="of the gyro; more than a bias, so that identical images contradict it"
    )
    max_turn_error_rad_s: float = Field(default=0.15, ge=0, description="of the corrected rotation from the gyro's")
    abstain_turn_error_rad_s: float = Field(default=0.5, ge=0, description="beyond it the pair is not judged")
    abstain_inlier_share: float = Field(
        default=0.1, ge=0, le=1, description="of the correction; with less the images contradict the IMU for good"
    )
    min_confidence: float = Field(
        default=0.2, ge=0, le=1, description="mean of the measured flow's, from which on images may overrule the IMU"
    )


MIN_INTERNAL_SIDE_PX, MAX_INTERNAL_SIDE_PX = 128, 16384


class DetectorConfig(FrozenConfig):
    """Everything a detection depends on besides the weights and the pair."""

    regions: RegionConfig = RegionConfig()
    correction: CorrectionConfig = CorrectionConfig()
    quality: QualityConfig = QualityConfig()
    include_masks: bool = False
    internal_short_side_px: int = Field(
        default=240,
        description="a picture whose shorter side is over 1.25 times this is judged at this size, where the evidence "
        "head judges; 0: at its own",
    )
    evidence: Literal["auto", "learned", "residual"] = Field(
        default="auto",
        description="what regions are found in: what the evidence head makes of the reconstruction, or the residual "
        "alone (the paper's); auto: the head, where the network knows depth and the head was loaded",
    )
    photometric_compensation: bool = Field(
        default=True, description="a gain and a bias between the images are fitted before the residual"
    )
    residual: Literal["winner", "minimum"] = Field(
        default="winner", description="minimum: the pixelwise smallest over all hypotheses and the corrected one"
    )
    min_texture_gray: float = Field(default=2.0, ge=0, description="standard deviation below which nothing is judged")
    min_overlap: float = Field(default=0.05, ge=0, le=1, description="share of the analysed pixels still in the target")
    max_exposure_jump_gray: float = Field(default=20.0, ge=0, description="change of the mean between the frames")

    @field_validator("internal_short_side_px")
    @classmethod
    def _no_size_or_one_that_shows_something(cls, short_side_px: int) -> int:
        if short_side_px and not MIN_INTERNAL_SIDE_PX <= short_side_px <= MAX_INTERNAL_SIDE_PX:
            raise ValueError(
                f"expected 0 or {MIN_INTERNAL_SIDE_PX} to {MAX_INTERNAL_SIDE_PX} pixels, found {short_side_px}"
            )
        return short_side_px


EVIDENCE_BLOCK_PX = 4
"""Sides of the blocks of pixels that geometric cues are on, and at which the evidence head works."""
MAX_OFFSET_BLOCKS = 127
"""How far the middle of a thing may be from one of its blocks, in blocks."""


Channels = Annotated[int, Field(ge=1, le=1024)]
ScoreWeight = Annotated[float, Field(ge=-1e12, le=1e12)]


class EvidenceHeadConfig(FrozenConfig):
    """What the builder needs to make an evidence head; saved in its checkpoint."""

    widths: tuple[Channels, Channels, Channels, Channels] = Field(
        default=(32, 48, 64, 64), description="channels at strides 4, 8, 16 and 32"
    )


class RegionScore(FrozenConfig):
    """Logistic regression from what is measured of a region to the probability that it moves by itself.

    ``weights`` go with ``moving_regions.REGION_FEATURES``; empty: the mean probability of its pixels stands.
    """

    weights: tuple[ScoreWeight, ...] = ()
    bias: ScoreWeight = 0.0


class EvidenceTrainingConfig(FrozenConfig):
    """One training of an evidence head; the seed fixes everything on a CPU."""

    head: EvidenceHeadConfig = EvidenceHeadConfig()
    steps: PositiveInt = 12_000
    batch_size: int = Field(default=16, ge=1, le=4096)
    learning_rate: float = Field(default=2e-3, gt=0, le=10)
    warmup_steps: int = Field(default=200, ge=0)
    weight_decay: float = Field(default=1e-3, ge=0, le=10)
    gradient_clip: PositiveFloat = 1.0
    motion_weight: float = Field(default=3.0, gt=0, le=1e6, description="of a moving pixel beside a resting one")
    size_balance: float = Field(
        default=0.25,
        ge=0,
        le=1,
        description="power of 1024 px over a smaller mover's area that its pixels weigh more by",
    )
    seam_weight: float = Field(default=0.3, ge=0, le=1e6, description="of the loss of seams between two movers")
    offset_weight: float = Field(default=0.15, ge=0, le=1e6, description="of the loss of where a thing has its middle")
    augmented_share: float = Field(default=0.6, ge=0, le=1, description="recordings seen through a worse camera")
    own_size_share: float = Field(
        default=0.5, ge=0, le=1, description="recordings with all their pixels, not at the internal size"
    )
    init_share: float = Field(
        default=0.0,
        ge=0,
        lt=1,
        description="of the weights of --init in those of the finished head",
    )
    crop_width: int = Field(default=224, ge=32, le=8192, multiple_of=32)
    crop_height: int = Field(default=128, ge=32, le=8192, multiple_of=32)
    every: PositiveInt = Field(default=1, description="take every n-th pair of a recording")
    checkpoint_every: PositiveInt = 500
    seed: int = Field(default=0, ge=0, le=2**63 - 1)
    threads: int = Field(default=1, ge=1, le=MAX_THREADS)


class TrackingConfig(FrozenConfig):
    """How regions of successive pairs become tracks; see ``tracking``. Times are seconds, so that a setting survives a
    change of the frame rate; fractions are of the image diagonal.
    """

    feed_score: float = Field(default=0.25, ge=0, le=1, description="a region feeds a confirmed track from here on")
    confirm_score: float = Field(default=0.75, ge=0, le=1, description="a region opens a confirmed track from here on")
    max_missed_s: float = Field(default=0.3, ge=0, le=60, description="a confirmed track ends when missed for longer")
    max_gap_s: float = Field(default=0.6, gt=0, le=60, description="no track is carried over a longer gap")
    max_tracks: int = Field(default=64, ge=1, le=4096)
    gate_sigmas: float = Field(default=4.0, gt=0, le=100, description="a region further from its track is another one")
    center_sigma: float = Field(default=0.15, gt=0, le=10, description="of a region's centre, in sides of its box")
    log_side_sigma: float = Field(default=0.3, gt=0, le=10, description="of the logarithm of a region's sides")
    own_speed_fraction_s: float = Field(default=0.15, gt=0, le=100, description="sigma of a new track's own speed")
    acceleration_fraction_s: float = Field(
        default=0.3, gt=0, le=1000, description="sigma of the own speed's change within a second"
    )
    growth_s: float = Field(
        default=0.3, gt=0, le=100, description="sigma of the growth of the sides' logarithm a second"
    )
    require_persistence: bool = Field(
        default=False, description="independent motion that no confirmed track supports becomes model_error"
    )


class RigEstimateConfig(FrozenConfig):
    """The slow estimate of gyro bias, camera-IMU time offset and mounting over a stream; see ``rig_estimate``.

    Prior deviations are those of data sheets and calibrations; drifts are deviations after a second, growing with the
    root of time.
    """

    enabled: bool = True
    apply: bool = Field(default=False, description="feed what is known well enough back into the next pairs")
    bias_sigma_rad_s: float = Field(
        default=0.05, gt=0, le=10, description="of the gyro's bias, before anything is seen"
    )
    offset_sigma_s: float = Field(default=0.03, gt=0, le=1, description="of the clocks, beside the calibrated offset")
    mounting_sigma_rad: float = Field(
        default=0.02, gt=0, le=1, description="of the mounting, beside the calibrated one"
    )
    bias_drift_rad_s: float = Field(default=2e-4, ge=0, le=1)
    offset_drift_s: float = Field(default=1e-5, ge=0, le=1)
    mounting_drift_rad: float = Field(default=1e-5, ge=0, le=1)
    noise_scale: float = Field(default=0.5, gt=0, le=1e3, description="of the deviation that a pair's fit claims")
    noise_floor_rad: float = Field(default=5e-4, gt=0, le=1, description="least deviation of a pair's measured turn")
    lasting_sigma_rad: float = Field(
        default=0.002, ge=0, le=1, description="of what the turns of neighbouring pairs err alike (depth misread)"
    )
    lasting_s: float = Field(default=1.0, gt=0, le=1e6, description="after which that is another error")
    min_inlier_share: float = Field(default=0.3, ge=0, le=1, description="a pair below it says nothing")
    huber_sigmas: float = Field(default=1.5, gt=0, le=100, description="beyond it a pair counts less")
    gate_sigmas: float = Field(default=4.0, gt=0, le=100, description="beyond it a pair is an outlier")
    reopen_after: PositiveInt = Field(default=20, description="outliers in a row after which the prior is back")
    apply_bias_sigma_rad_s: float = Field(
        default=0.005, gt=0, le=10, description="a bias whose deviations are below it may be applied"
    )
    apply_offset_sigma_s: float = Field(default=0.003, gt=0, le=1, description="likewise")
    apply_mounting_sigma_rad: float = Field(default=0.002, gt=0, le=1, description="likewise")


def loss_of_preset(preset: str) -> str:
    """The loss that ``TrainingConfig.loss`` "auto" stands for."""
    return {"paper": "squared", "compact": "charbonnier", "calibrated": "corrected"}[preset]


class SplitConfig(FrozenConfig):
    """Which pairs of each recording are kept for a test, see ``datasets.splits``; "none": all are for training.

    ``random`` is the paper's rule [Datasets]; its test shares frames with the training.
    """

    rule: Literal["none", "blocks", "random"] = "none"
    test_share: float = Field(default=0.2, gt=0, lt=1)
    block_s: float = Field(default=5.0, ge=0.001, le=1e9)
    seed: int = Field(default=0, ge=0)


class TrainingConfig(FrozenConfig):
    """One training run; the seed fixes everything on a CPU."""

    steps: PositiveInt = 20_000
    batch_size: int = Field(default=16, ge=1, le=4096)
    learning_rate: float = Field(default=1e-3, gt=0, le=10)
    warmup_steps: int = Field(default=500, ge=0)
    weight_decay: float = Field(default=1e-4, ge=0, le=10)
    gradient_clip: PositiveFloat = 1.0
    loss: Literal["auto", "squared", "charbonnier", "corrected"] = "auto"
    relaxation: float = Field(default=0.05, ge=0, lt=1, description="weight of the mean over hypotheses")
    look_aheads: tuple[int, ...] = (1, 2)
    split: SplitConfig = SplitConfig()
    seed: int = Field(default=0, ge=0, le=2**63 - 1)
    validate_every: PositiveInt = 1000
    checkpoint_every: PositiveInt = 500
    threads: int = Field(default=1, ge=1, le=MAX_THREADS)
    relighting: float = Field(default=0.6, ge=0, le=1, description="change of exposure, contrast and noise shown")
    autocast: bool = Field(default=False, description="bfloat16 in the network; on CUDA and recent CPUs")
    validation_pairs: PositiveInt = Field(default=64, description="measured at every validation, evenly spread")

    @model_validator(mode="after")
    def _look_aheads_in_range(self) -> Self:
        if not self.look_aheads or not all(1 <= step <= 4 for step in self.look_aheads):
            raise ValueError(f"look_aheads: expected steps between 1 and 4, found {list(self.look_aheads)}")
        return self


FINE_TUNING_DEFAULTS = {"steps": 1000, "learning_rate": 3e-4, "warmup_steps": 100}
"""What a training that starts from a checkpoint has instead of ``TrainingConfig``'s defaults: it is near its goal, and
its recordings are few."""
EVIDENCE_FINE_TUNING_DEFAULTS = {"steps": 5000, "learning_rate": 1e-3}
"""Likewise of an evidence head."""

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
        parts.append(f"{place}: {problem['msg']}{found}")
    return "; ".join(parts)


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
    """From residual map to labelled regions; see ``regions.py`` for each step.

    Fractions are of the image diagonal unless the name says otherwise; the residual is in gray levels 0-255.
    """

    texture_softening_gray: float = Field(
        default=10.0, ge=0, le=255, description="residuals count less on edges, see texture_normalised; 0: all alike"
    )
    smoothing_fraction: float = Field(default=0.003, ge=0, le=0.02)
    threshold_mads: PositiveFloat = 6.0
    min_residual_gray: float = Field(default=6.0, ge=0, le=255, description="of the normalised residual")
    opening_fraction: float = Field(default=0.004, ge=0, le=0.1)
    closing_fraction: float = Field(default=0.012, ge=0, le=0.1)
    min_area_fraction: float = Field(default=0.0006, ge=0, le=1, description="of the image's area")
    max_regions: int = Field(default=64, ge=1, le=4096)
    shape_rule: ShapeRuleName = Field(
        default="axis_aligned", description="what tells motion from narrow bands; axis_aligned: the paper's"
    )
    min_x_extent_fraction: float = Field(default=0.018, ge=0, le=1, description="of the diagonal: narrower is a band")
    min_y_extent_fraction: float = Field(default=0.018, ge=0, le=1, description="of the diagonal: narrower is a band")
    max_aspect_ratio: float = Field(default=5.0, ge=1, description="a longer bounding box is a band")
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
RuntimeName = Literal["auto", "torch", "openvino"]
"""What runs the network: "auto" is OpenVINO on a CPU where it is installed and the checkpoint was exported."""


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


class DetectorConfig(FrozenConfig):
    """Everything a detection depends on besides the weights and the pair."""

    regions: RegionConfig = RegionConfig()
    correction: CorrectionConfig = CorrectionConfig()
    include_masks: bool = False
    photometric_compensation: bool = Field(
        default=False, description="a gain and a bias between the images are fitted before the residual"
    )
    residual: Literal["winner", "minimum"] = Field(
        default="winner", description="minimum: the pixelwise smallest over all hypotheses and the corrected one"
    )
    min_texture_gray: float = Field(default=2.0, ge=0, description="standard deviation below which nothing is judged")
    min_overlap: float = Field(default=0.05, ge=0, le=1, description="share of the analysed pixels still in the target")
    max_exposure_jump_gray: float = Field(default=40.0, ge=0, description="change of the mean between the frames")


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
    batch_size: PositiveInt = 16
    learning_rate: PositiveFloat = 1e-3
    warmup_steps: int = Field(default=500, ge=0)
    weight_decay: float = Field(default=1e-4, ge=0)
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

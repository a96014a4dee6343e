"""What a simulation run is asked for; everything else is drawn from each sequence's own seed."""

from __future__ import annotations

from typing import Any, Literal, Self

from pydantic import Field, PositiveInt, model_validator

from viflow_anomaly.config import FrozenConfig

DEFAULT_SIZES_PX = {"drone": (384, 256), "car": (416, 128)}


class SimulatorConfig(FrozenConfig):
    """One run of the simulator.

    Sequence k has the seed ``seed + k``; its bytes depend on that seed and on the fields of ``sequence_record`` only.
    ``width`` and ``height`` default to the rig's own size (drone 384x256, car 416x128).
    """

    rig: Literal["drone", "car"] = "drone"
    sequences: PositiveInt = 1
    frames: int = Field(default=60, ge=2, le=20_000, description="per sequence")
    seed: int = Field(default=0, ge=0, le=2**31 - 1)
    width: int = Field(ge=32, le=2048)
    height: int = Field(ge=32, le=2048)
    supersampling: int = Field(default=2, ge=1, le=4, description="rendered at this multiple, then area-averaged")
    ground_truth: bool = True
    movers: tuple[int, int] = Field(default=(0, 4), description="least and most independently moving objects")
    motion: Literal["normal", "static", "rotation"] = "normal"
    thin_structures: int = Field(
        default=0, ge=0, le=300, description="railings, bare trees, poles, wires, scaffolds and bars beside the usual"
    )
    foliage: int = Field(default=0, ge=0, le=100, description="leafy trees, bushes, patches of grass")
    imu_errors: bool = Field(default=True, description="biases, white noise, vibration; the motor's scale and noise")
    jobs: PositiveInt = Field(default=1, description="processes")

    @model_validator(mode="before")
    @classmethod
    def _size_of_the_rig(cls, values: Any) -> Any:
        if not isinstance(values, dict):
            return values
        size = DEFAULT_SIZES_PX.get(values.get("rig", "drone"))
        return values if size is None else {"width": size[0], "height": size[1], **values}

    @model_validator(mode="after")
    def _movers_in_range(self) -> Self:
        least, most = self.movers
        if not 0 <= least <= most <= 8:
            raise ValueError(f"movers: expected 0 <= least <= most <= 8, found {least}, {most}")
        return self

    def sequence_record(self, sequence_seed: int) -> dict[str, Any]:
        """What the bytes of one sequence depend on, as JSON: neither the number of sequences nor of processes."""
        record = self.model_dump(mode="json", exclude={"sequences", "seed", "jobs"})
        for name in ("thin_structures", "foliage"):  # sequences from before there were any stay complete
            if not record[name]:
                del record[name]
        return {**record, "sequence_seed": sequence_seed}

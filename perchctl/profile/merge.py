"""The profile's keys of the merge of both markers, and the file of weights that it may name."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

from perchctl.profile.base import Section


class WeightsConfig(Section):
    """The paper's weights: the large marker's share in each axis and in yaw."""

    x: float = Field(
        0.275, ge=0, le=1, description="the large marker's share; the small one has the rest"
    )
    y: float = Field(0.306, ge=0, le=1, description="as x")
    z: float = Field(0.728, ge=0, le=1, description="as x")
    yaw: float = Field(0.469, ge=0, le=1, description="as x")


class MergeConfig(Section):
    """The profile's `merge`: how the two markers become one estimate."""

    method: Literal["weights", "joint"] = Field(
        "joint", description="the paper's weights, or both markers solved as one"
    )
    weights: WeightsConfig = WeightsConfig()
    weights_file: str | None = Field(
        None, description="of `perchctl fit-weights`; replaces `weights`"
    )
    stages: Literal["seen", "range"] = Field(
        "seen", description="merge what is seen, or by distance as equations 4, 6, 11"
    )
    z2_m: float = Field(0.25, gt=0, description="farthest range of the small marker")
    z3_m: float = Field(0.12, gt=0, description="nearest range of the whole large marker")
    disagreement_m: float = Field(
        0.03, gt=0, description="farther apart than this the markers contradict"
    )
    disagreement_frames: int = Field(15, ge=1, description="so many in a row, and it lands")

    @model_validator(mode="after")
    def _ranges_in_order(self) -> MergeConfig:
        if not self.z3_m < self.z2_m:
            raise ValueError("z3_m < z2_m must hold (metres)")
        return self


class FittedData(BaseModel):
    """The data that weights were fitted to."""

    file: str = ""
    sha256: str = ""
    rows: int = 0
    positions: int = 0


class FittedWeights(BaseModel):
    """A weights file, as far as a flight needs it (`perchctl.weights` writes more)."""

    model_config = ConfigDict(frozen=True, allow_inf_nan=False)

    date: str = ""
    method: str = ""
    weights: WeightsConfig
    data: FittedData = FittedData()

    @model_validator(mode="before")
    @classmethod
    def _all_axes(cls, values: dict[str, Any]) -> dict[str, Any]:
        given = values.get("weights")
        if isinstance(given, dict):
            missing = [axis for axis in WeightsConfig.model_fields if axis not in given]
            if missing:
                raise ValueError(f"weights.{missing[0]} is missing; needed are x, y, z and yaw")
        return values

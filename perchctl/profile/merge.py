"""The profile's keys of the merge of both markers, and the file of weights that it may name."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, model_validator

from perchctl.profile.base import Section, key


class WeightsConfig(Section):
    """The paper's weights: the large marker's share in each axis and in yaw."""

    x: float = key(0.275, "the large marker's share; the small one has the rest", ge=0, le=1)
    y: float = key(0.306, "as x", ge=0, le=1)
    z: float = key(0.728, "as x", ge=0, le=1)
    yaw: float = key(0.469, "as x", ge=0, le=1)


class MergeConfig(Section):
    """The profile's `merge`: how the two markers become one estimate."""

    method: Literal["weights", "joint"] = key(
        "joint", "the paper's weights, or both markers solved as one"
    )
    weights: WeightsConfig = WeightsConfig()
    weights_file: str | None = key(None, "of `perchctl fit-weights`; replaces `weights`")
    stages: Literal["seen", "range"] = key(
        "seen", "merge what is seen, or by distance as equations 4, 6, 11"
    )
    z2_m: float = key(0.25, "farthest range of the small marker", gt=0)
    z3_m: float = key(0.12, "nearest range of the whole large marker", gt=0)
    disagreement_m: float = key(0.03, "farther apart than this the markers contradict", gt=0)
    disagreement_frames: int = key(15, "so many in a row, and it lands", ge=1)

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

"""The poses of one frame, each solved when it is asked for."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping

from perchctl.vision.types import MarkerPose

_CONSISTENT_CHI2 = 4.0  # per degree of freedom; a contradiction is four standard deviations


class Poses(Mapping[str, MarkerPose]):
    """The poses of one frame by ``joint``, ``large``, ``small``; in a joint solve the
    single markers' poses are not computed before they are asked for."""

    def __init__(
        self, ready: dict[str, MarkerPose], rest: Callable[[], dict[str, MarkerPose]] | None = None
    ) -> None:
        self._ready, self._rest = ready, rest

    @property
    def first(self) -> MarkerPose | None:
        """The joint pose, or the only one; else the large marker's."""
        if not self._ready:
            self._all()
        return next(iter(self._ready.values()), None)

    @property
    def consistent(self) -> bool:
        """Whether both markers' corners fit one pose so well that they cannot contradict."""
        joint = self._ready.get("joint")
        return joint is not None and joint.chi2 < _CONSISTENT_CHI2

    def _all(self) -> dict[str, MarkerPose]:
        if self._rest is not None:
            self._ready = {**self._ready, **self._rest()}
            self._rest = None
        return self._ready

    def __getitem__(self, name: str) -> MarkerPose:
        return self._ready[name] if name in self._ready else self._all()[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._all())

    def __len__(self) -> int:
        return len(self._all())

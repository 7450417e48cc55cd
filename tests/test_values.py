"""`replace` is `dataclasses.replace`, in less time."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any, cast

import pytest

from perchctl.values import cached_property, replace


@dataclass(frozen=True)
class Plain:
    a: int
    b: tuple[int, ...] = ()

    @cached_property
    def twice(self) -> int:
        return 2 * self.a


@dataclass(frozen=True)
class Checked:
    a: int

    def __post_init__(self) -> None:
        if self.a < 0:
            raise ValueError("negative")


def test_a_property_is_worked_out_once() -> None:
    worked_out = []

    @dataclass(frozen=True)
    class Counts:
        @cached_property
        def answer(self) -> int:
            worked_out.append(self)
            return 42

    one, other = Counts(), Counts()
    assert [one.answer, one.answer, other.answer] == [42, 42, 42]
    assert len(worked_out) == 2


@pytest.mark.parametrize("value", [Plain(1, (2,)), Checked(4)])
def test_a_changed_value_is_what_dataclasses_make_of_it(value: Any) -> None:
    """What a `cached_property` kept stays behind, and checks still run."""
    assert getattr(value, "twice", 2) == 2
    changed = replace(value, a=9)
    assert changed == dataclasses.replace(value, a=9)
    assert getattr(changed, "twice", 18) == 18
    with pytest.raises(dataclasses.FrozenInstanceError):
        changed.a = 3
    with pytest.raises(TypeError, match="attempt"):
        replace(value, **cast(Any, {"attempt": 1}))
    if isinstance(value, Checked):
        with pytest.raises(ValueError, match="negative"):
            replace(value, a=-1)

"""`replace` is `dataclasses.replace`, in less time."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, cast

import pytest

from perchctl.values import replace


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
    root: float = field(init=False, default=0.0)

    def __post_init__(self) -> None:
        if self.a < 0:
            raise ValueError("negative")
        object.__setattr__(self, "root", self.a**0.5)


@dataclass(frozen=True, slots=True)
class Slotted:
    a: int
    b: int = 2


@pytest.mark.parametrize("value", [Plain(1, (2,)), Checked(4), Slotted(1)])
def test_a_changed_value_is_what_dataclasses_make_of_it(value: Any) -> None:
    changed = replace(value, a=9)
    assert changed == dataclasses.replace(value, a=9)
    assert type(changed) is type(value)
    assert value.a != 9
    with pytest.raises(dataclasses.FrozenInstanceError):
        changed.a = 3
    with pytest.raises(TypeError, match="attempt"):
        replace(value, **cast(Any, {"attempt": 1}))


def test_what_was_kept_of_the_old_value_is_not_the_new_one_s_and_checks_still_run() -> None:
    value = Plain(1)
    assert value.twice == 2
    assert replace(value, a=4).twice == 8
    assert replace(replace(value, b=(1,)), a=5) == Plain(5, (1,))
    with pytest.raises(ValueError, match="negative"):
        replace(Checked(4), a=-1)

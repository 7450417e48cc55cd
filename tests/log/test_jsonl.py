"""One record, one line: the encoding under the flight log."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from perchctl.log import decode_line, to_plain
from perchctl.log.exact import encode
from perchctl.mission import Phase


def test_plain_values() -> None:
    values = {
        "np": np.float32(0.5),
        "int": np.int64(3),
        "bool": np.bool_(True),
        "nan": [math.nan, math.inf, -math.inf],
        "array": np.array([[1.23456789, -0.0]]),
        "enum": Phase.ALIGN,
        "path": Path("a/b"),
        "text": "°€\ud800",
        "none": None,
    }
    line = encode(values)
    assert line.endswith(b"\n")
    assert line.count(b"\n") == 1
    back = decode_line(line)
    assert back["nan"] == [None, None, None]
    assert back["array"] == [[1.234568, 0.0]]
    assert "-0.0" not in line.decode()
    assert (back["np"], back["int"], back["bool"]) == (0.5, 3, True)
    assert (back["enum"], back["path"], back["text"]) == ("ALIGN", "a/b", "°€\ud800")
    assert "none" not in back


json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=20),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=8), inner),
    max_leaves=10,
)


@given(st.dictionaries(st.text(max_size=8), json_values))
def test_encoding_is_one_line_and_stable(record: dict[str, Any]) -> None:
    line = encode(record)
    assert line.count(b"\n") == 1
    back = decode_line(line)
    assert back == {k: v for k, v in to_plain(record).items() if v is not None}
    assert encode(back) == line

"""From a hand to a refusal: the comparison names what is swapped, the record says so, and `fly`
refuses with that name.

The samples are recorded ones; over the link and the capture's server a vehicle is lifted in
`test_lift`.
"""

from __future__ import annotations

from pathlib import Path

import pytest
from typer.testing import CliRunner

from perchctl.check import Verdict
from perchctl.check.capture import save_row
from perchctl.commands import app
from perchctl.flight import wall_date
from perchctl.profile import PositioningConfig
from perchctl.sim.capture import SWAPPED_XY, TRUE_AXES, Y_UP, axes_matrix
from tests.check.test_hand import recorded
from tests.helpers.checks import NO_CAMERA, NOWHERE

pytestmark = pytest.mark.usefixtures("elsewhere")


@pytest.mark.parametrize(("axes", "words"), [
    (Y_UP, "swapped axes: up is y in the motion capture"),
    (SWAPPED_XY, "the rigid body's axes are turned by 90 deg"),
    (TRUE_AXES, None),
])  # fmt: skip
def test_what_the_hand_finds_is_what_fly_refuses(
    axes: str, words: str | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As the simulated capture has them: its bodies' axes lie along its own."""
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    config = PositioningConfig(by="mocap", host="lab", body="cf2")
    profile = tmp_path / "lab.yaml"
    profile.write_text(
        "extends: sim\nlink: {connect_timeout_s: 0.4}\npositioning: "
        "{by: mocap, host: lab, body: cf2, connect_timeout_s: 0.5}\n",
        encoding="utf-8",
    )

    def fly() -> tuple[int, str]:
        done = CliRunner().invoke(
            app, ["fly", "-p", str(profile), "-u", NOWHERE, "--source", NO_CAMERA, "--yes"]
        )
        assert "Traceback" not in done.output
        return done.exit_code, done.stderr

    code, said = fly()
    assert code == 52
    assert "was never compared" in said

    turn = axes_matrix(axes)
    lifted = recorded(world=turn, body=turn.T, config=config)
    row = save_row(lifted, config, NOWHERE, wall_date())
    code, said = fly()
    if words is None:
        assert (lifted.verdict, row.verdict) == (Verdict.PASS, Verdict.PASS)
        assert code != 52, said  # the next thing: there is no such camera
        return
    assert (lifted.verdict, row.verdict) == (Verdict.FAIL, Verdict.WARN)
    assert words in lifted.found
    assert code == 52
    assert words in said
    assert "(found by check --lift on " in said
    assert "connecting" not in said

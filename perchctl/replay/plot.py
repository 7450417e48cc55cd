"""One picture of a replay: what was flown, and what another profile would have said."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from textwrap import fill

import numpy as np
from matplotlib.axes import Axes

from perchctl.geometry import Array
from perchctl.mission import Observation, Turn
from perchctl.plot import BLACK, BLUE, GREY, GRID, VERMILLION, new_figure, save_figure
from perchctl.replay.decide import Decided
from perchctl.replay.run import Replay
from perchctl.replay.told import difference_text
from perchctl.replay.whatif import CAUTION
from perchctl.vehicle import Command, PositionSetpoint, RawThrust

SIZE_IN = (11.0, 11.0)
_AXES = "xyz"


def plot_replay(replay: Replay, path: Path) -> None:
    """Setpoints, the target's error and the phases, as flown and as replayed, with the first
    difference marked. Errors: InvalidValue (a file that cannot be written)."""
    figure = new_figure(*SIZE_IN)
    axes = figure.subplots(8, 1, sharex=True, height_ratios=(1, 1, 1, 0.7, 1, 1, 1, 0.8))
    flown = [each for each in replay.decided if each.turn.role == "flown"]
    t_s = np.array([each.turn.t_s - replay.log.start_s for each in flown])
    for k, axis in enumerate(_AXES):
        was = [_setpoint(each.turn.command, k) for each in flown]
        then = [_setpoint(each.command, k) for each in flown]
        _both(axes[k], t_s, was, then, f"setpoint {axis} [m]")
    was = [_thrust(each.turn.command) for each in flown]
    _both(axes[3], t_s, was, [_thrust(each.command) for each in flown], "raw thrust")
    for k, axis in enumerate(_AXES):
        was = [_error_cm(each.turn.observation, k) for each in flown]
        then = [_error_cm(each.observation, k) for each in flown]
        _both(axes[4 + k], t_s, was, then, f"$e_{axis}$ [cm]")
    _phases(axes[7], t_s, flown)
    for ax in axes:
        ax.grid(True, color=GRID, linewidth=0.6)
        ax.set_axisbelow(True)
        if replay.first is not None:
            ax.axvline(replay.first.t_s, color=BLACK, linewidth=1.0, linestyle=":")
    axes[0].legend(loc="upper right", ncols=2, fontsize=8)
    axes[-1].set_xlabel("time [s]")
    figure.align_ylabels(axes)
    figure.suptitle(fill(_title(replay), 110), fontsize=10)
    save_figure(figure, path)


def _title(replay: Replay) -> str:
    head = ", ".join(replay.changed) if replay.changed else "as it was flown"
    if replay.first is None:
        return f"{head}: no command differs"
    text = difference_text(replay.first, bool(replay.changed))
    return f"{head}: {text} (dotted); {CAUTION}".replace("$", r"\$")


def _both(ax: Axes, t_s: Array, was: list[float], then: list[float], label: str) -> None:
    ax.plot(t_s, was, color=BLUE, linewidth=1.6, label="as flown")
    ax.plot(t_s, then, color=VERMILLION, linewidth=1.0, linestyle="--", label="replayed")
    ax.set_ylabel(label, fontsize=8)


def _phases(ax: Axes, t_s: Array, flown: Sequence[Decided]) -> None:
    """Two strips."""
    was = [_phase(each.turn) for each in flown]
    then = ["" if each.state is None else each.state.phase.value for each in flown]
    for level, names in ((1.0, was), (0.0, then)):
        starts = [k for k in range(len(names)) if k == 0 or names[k] != names[k - 1]]
        for number, k in enumerate(starts):
            end = starts[number + 1] if number + 1 < len(starts) else len(names) - 1
            shade = GRID if number % 2 else "#FFFFFF"
            ax.barh(level, t_s[end] - t_s[k], left=t_s[k], color=shade, edgecolor=GREY, height=0.9)
            middle_s = (t_s[k] + t_s[end]) / 2
            ax.text(middle_s, level, names[k][:3], ha="center", va="center", fontsize=6)
    ax.set_yticks([1.0, 0.0], ["as flown", "replayed"], fontsize=8)


def _phase(turn: Turn) -> str:
    return "" if turn.phase is None else turn.phase.value


def _setpoint(command: Command | None, axis: int) -> float:
    if not isinstance(command, PositionSetpoint):
        return float("nan")
    return (command.x_m, command.y_m, command.z_m)[axis]


def _thrust(command: Command | None) -> float:
    return float(command.thrust) if isinstance(command, RawThrust) else float("nan")


def _error_cm(obs: Observation | None, axis: int) -> float:
    if obs is None or obs.target is None or not obs.target.tracked:
        return float("nan")
    return 100.0 * float(obs.target.e_m[axis])

"""`perchctl log`: a command of its own for each thing that one does with a log."""

from __future__ import annotations

import typer

from perchctl.commands.cli.log_compare import compare
from perchctl.commands.cli.log_export import export
from perchctl.commands.cli.log_plot import plot
from perchctl.commands.cli.log_replay import replay
from perchctl.commands.cli.log_report import report
from perchctl.commands.cli.log_show import show

SUMMARY = "After a flight: its log shown, drawn, compared, exported, replayed, told."

log = typer.Typer(rich_markup_mode=None)

for _name, _command in (
    ("show", show),
    ("plot", plot),
    ("compare", compare),
    ("export", export),
    ("replay", replay),
    ("report", report),
):
    _summary = (_command.__doc__ or "").split("\n\n")[0]
    log.command(_name, short_help=_summary)(_command)


@log.callback(invoke_without_command=True)
def _top(context: typer.Context) -> None:
    """After a flight: its log shown, drawn, compared, exported, replayed, told.

    They work on logs of flights that were killed, of simulated ones, of an older perchctl;
    replay needs whole turns, which logs of versions 1 and 2 do not hold. Where FILE is left out
    it is the newest log; compare wants two.
    """
    if context.invoked_subcommand is None:
        print(context.get_help())

"""The command line: one file a subcommand, which declares its options and makes one call.

Nothing here loads a library before a command runs, so that the help is quick.
"""

from perchctl.commands.cli.app import EXIT_TABLE, app, main
from perchctl.commands.cli.calibrate import calibrate
from perchctl.commands.cli.check import check
from perchctl.commands.cli.fit_weights import fit_weights
from perchctl.commands.cli.fly import fly
from perchctl.commands.cli.log import SUMMARY as LOG_SUMMARY
from perchctl.commands.cli.log import log
from perchctl.commands.cli.make_target import make_target
from perchctl.commands.cli.new_profile import new_profile
from perchctl.commands.cli.profile import profile
from perchctl.commands.cli.simulate import simulate
from perchctl.commands.cli.track import track

__all__ = ["app", "main"]

# In the order in which one uses them; so does the help list them.
for _name, _command in (
    ("make-target", make_target),
    ("calibrate", calibrate),
    ("new-profile", new_profile),
    ("profile", profile),
    ("fit-weights", fit_weights),
    ("track", track),
    ("check", check),
    ("fly", fly),
    ("simulate", simulate),
):
    # The whole first sentence: of its own accord the list of the commands cuts it.
    _summary = (_command.__doc__ or "").split("\n\n")[0]
    _epilog = EXIT_TABLE if _command is fly else None
    app.command(_name, short_help=_summary, epilog=_epilog)(_command)

app.add_typer(log, name="log", short_help=LOG_SUMMARY)

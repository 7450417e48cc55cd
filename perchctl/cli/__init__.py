"""The command line: one file a subcommand, which declares its options and makes one call.

Nothing here loads a library before a command runs, so that the help is quick.
"""

from perchctl.cli.app import EXIT_TABLE, app, main
from perchctl.cli.calibrate import calibrate
from perchctl.cli.fit_weights import fit_weights
from perchctl.cli.fly import fly
from perchctl.cli.make_target import make_target
from perchctl.cli.simulate import simulate
from perchctl.cli.track import track

__all__ = ["app", "main"]

# In the order in which one uses them; so does the help list them.
app.command("make-target")(make_target)
app.command("calibrate")(calibrate)
app.command("fit-weights")(fit_weights)
app.command("track")(track)
app.command("fly", epilog=EXIT_TABLE)(fly)
app.command("simulate")(simulate)

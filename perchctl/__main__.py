"""The console script `perchctl`, and `python -m perchctl`."""

import sys

from perchctl.startup import refuse_windows


def main() -> int | str | None:
    """Run the command line. Returns the exit code, or exits with it."""
    if sys.platform == "win32":
        return refuse_windows()
    from perchctl.commands import main as run  # imported late, because this import takes some time

    code: int | str | None = run()
    return code


if __name__ == "__main__":
    sys.exit(main())

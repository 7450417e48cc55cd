"""The console script `perchctl`, and `python -m perchctl`."""

import sys

from perchctl.startup import refuse_windows


def main() -> int | str | None:
    """Run the command line; returns the exit code, or leaves with it."""
    if sys.platform == "win32":
        return refuse_windows()
    from perchctl.commands import main as run  # takes a while

    code: int | str | None = run()
    return code


if __name__ == "__main__":
    sys.exit(main())

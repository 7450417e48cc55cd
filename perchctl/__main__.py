"""The console script `perchctl`, and `python -m perchctl`."""

import sys


def main() -> int | str | None:
    """Run the command line; returns the exit code, or leaves with it."""
    from perchctl.commands import main as run  # takes a while

    code: int | str | None = run()
    return code


if __name__ == "__main__":
    sys.exit(main())

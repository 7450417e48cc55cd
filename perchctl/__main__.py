"""The console script `perchctl`, and `python -m perchctl`."""

import sys
from typing import Any

from perchctl.startup import leave_at_ctrl_c


def main() -> Any:
    """Run the command line; returns the exit code, or leaves with it."""
    leave_at_ctrl_c()
    from perchctl.cli import main as run  # takes a while

    return run()


if __name__ == "__main__":
    sys.exit(main())

"""`python -m perchctl`: the same as the console script."""

import sys

from perchctl.cli import main

sys.exit(main())

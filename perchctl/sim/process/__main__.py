"""`python -m perchctl.sim.process`: a simulated vehicle in the foreground."""

import sys

from perchctl.sim.process.child import main

sys.exit(main())

"""perchctl: hang a Crazyflie from a ceiling, guided by a camera and a printed target.

The names in `__init__.pyi` are the public ones, for notebooks and scripts; `docs/python.md` shows
how to use them. The public names are loaded on first use, so that the command line starts at once.
"""

import sys

from perchctl.startup import NO_WINDOWS, exit_at_ctrl_c, is_command_line

if is_command_line():
    exit_at_ctrl_c()  # done first, because importing lazy_loader takes some time

import lazy_loader

__version__ = "0.4.0"
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

if sys.platform == "win32":

    def __getattr__(name: str) -> object:
        if name in __all__:
            raise ImportError(NO_WINDOWS)
        raise AttributeError(name)

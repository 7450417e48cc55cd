"""Load your own code, named in a profile as ``my_module:MyCamera``: find the class, create an
object and check it."""

from __future__ import annotations

import difflib
import re
import sys
import traceback
from collections.abc import Callable, Collection
from importlib import import_module
from importlib.machinery import PathFinder
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from perchctl.errors import InvalidValue, NotFound, PerchError

PATTERN = r"^[A-Za-z_]\w*(\.[A-Za-z_]\w*)*:[A-Za-z_]\w*$"
"""Matches a module's name (dotted if the module is in a package), a colon, and a name in that
module."""
_PACKAGE = Path(__file__).parent


def has_extension_form(text: str, schemes: Collection[str]) -> bool:
    """True for ``my_module:MyCamera``, unless the word before the colon is one of perchctl's own
    `schemes` in upper or lower case: ``camera:HDMI`` is a camera even if a file ``camera.py``
    exists."""
    word = text.partition(":")[0].lower()
    return word not in schemes and re.match(PATTERN, text) is not None


def is_extension(text: str) -> bool:
    """True for ``my_module:MyCamera`` if the module exists. Does not load the module."""
    if re.match(PATTERN, text) is None:
        return False
    package = re.split("[.:]", text)[0]
    found = package in sys.modules or find_spec(package) is not None
    return found or PathFinder.find_spec(package, [str(Path.cwd())]) is not None


def load_extension(text: str, key: str) -> Any:
    """Return the class, function or value that the profile's `key` names as ``my_module:name``.
    Modules are searched for among the installed ones, then in the current folder.

    Raises:
        NotFound: there is no such module, or no such name in it. InvalidValue: importing it raised
            an exception.
    """
    module_name, _, name = text.partition(":")
    _search_here()
    try:
        module = import_module(module_name)
    except Exception as error:
        missing = error.name if isinstance(error, ModuleNotFoundError) else None
        if missing and f"{module_name}.".startswith(f"{missing}."):
            raise NotFound(
                f"{key}: no module named {missing}: install it, or run perchctl from its folder "
                f"(now {Path.cwd()})"
            ) from None
        raise InvalidValue(f"{key}: importing {module_name} raised {error_at(error)}") from error
    if not hasattr(module, name):
        close = difflib.get_close_matches(name, vars(module), 1)
        meant = f": did you mean {close[0]}?" if close else ""
        raise NotFound(f"{key}: module {module_name} has no {name}{meant}")
    return getattr(module, name)


def make_extension(
    text: str, key: str, protocol: type, clock: Callable[[], float], config: object
) -> Any:
    """Return a new object of the class named ``my_module:MyCamera``.

    Raises:
        NotFound: as in `load_extension`.
        InvalidValue: as in `load_extension`; or the class raised an exception; or the object lacks
        something that `protocol` has.
    """
    kind = load_extension(text, key)
    try:
        made = kind(clock, config)
    except PerchError:
        raise
    except Exception as error:
        what = f"{text}(clock, {type(config).__name__}) raised {error_at(error)}"
        raise InvalidValue(f"{key}: {what}") from error
    lacks = [name for name in vars(protocol) if name[0] != "_" and not hasattr(made, name)]
    if lacks:
        needs = f"which a perchctl.{protocol.__name__} must have"
        raise InvalidValue(f"{key}: {text} lacks {', '.join(sorted(lacks))}, {needs}")
    return made


def error_at(error: BaseException) -> str:
    """Return the class and text of an error, and the last line of the traceback outside
    perchctl."""
    frames = traceback.extract_tb(error.__traceback__)
    yours = [frame for frame in frames if _PACKAGE not in Path(frame.filename).parents]
    place = f" ({Path(yours[-1].filename).name}, line {yours[-1].lineno})" if yours else ""
    return f"{type(error).__name__}: {error}{place}"


def _search_here() -> None:
    """Also search for modules in the current folder, but last, so that no library is shadowed."""
    here = str(Path.cwd())
    if here not in sys.path and "" not in sys.path:
        sys.path.append(here)

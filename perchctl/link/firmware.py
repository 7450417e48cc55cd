"""What is verified and set on a connected vehicle before it may fly."""

from __future__ import annotations

import math
import threading
from collections.abc import Mapping
from typing import Any

from perchctl.errors import ConnectionFailed, InvalidValue, NotFound, TimedOut
from perchctl.link.telemetry import NEEDED

NEEDED_PROTOCOL = 12
"""From firmware 2026.08 on: the supervisor's own port (docs/firmware.md, "Link")."""
PARAMETER_TIMEOUT_S = 2.0


def check_firmware(cf: Any, uri: str) -> None:
    """Raises ConnectionFailed for an old protocol, NotFound for a missing log variable."""
    version = cf.platform.get_protocol_version()
    if version < NEEDED_PROTOCOL:
        raise ConnectionFailed(
            f"the firmware at {uri} has protocol {version}, perchctl needs "
            f"{NEEDED_PROTOCOL} or later (release 2026.08): update the firmware"
        )
    for name in missing_variables(cf):
        raise NotFound(
            f"the firmware at {uri} has no log variable {name}, which perchctl "
            f"needs: update the firmware to release 2026.08 or later"
        )


def missing_variables(cf: Any) -> list[str]:
    """Those of the needed ones that the firmware does not log."""
    toc = cf.log.toc
    return [name for name in NEEDED if toc.get_element_by_complete_name(name) is None]


def set_parameters(
    cf: Any, uri: str, parameters: Mapping[str, float], needed_by: str | None = None
) -> None:
    """Set each parameter and verify it.

    `needed_by`: what they are for, where they are not the user's own. Raises NotFound for an
    unknown name, InvalidValue for a value that the vehicle does not keep, TimedOut without an
    answer.
    """
    for name, wanted in parameters.items():
        _check_known(cf, uri, name, needed_by)
        _set_parameter(cf.param, name, wanted)


def order_parameter(cf: Any, uri: str, name: str, value: float, needed_by: str) -> None:
    """Set one that is an order, and is not to be read back. Raises as `set_parameters`."""
    _check_known(cf, uri, name, needed_by)
    try:
        cf.param.set_value(name, str(value))
    except (AttributeError, ValueError, KeyError) as error:
        raise InvalidValue(f"parameter {name} cannot be set to {value}: {error}") from None


def _check_known(cf: Any, uri: str, name: str, needed_by: str | None) -> None:
    if cf.param.toc.get_element_by_complete_name(name) is not None:
        return
    if needed_by is None:
        remedy = ": correct link.parameters in the profile"
    else:
        remedy = f", which {needed_by} needs: update the firmware to release 2026.08 or later"
    raise NotFound(f"the firmware at {uri} has no parameter {name}{remedy}")


def _set_parameter(parameters: Any, name: str, wanted: float) -> None:
    """Set, then read it back from the vehicle and compare."""
    group, _, short = name.partition(".")
    answered = threading.Event()
    answers: list[str] = []

    def on_value(_name: str, value: str) -> None:
        answers.append(value)
        answered.set()

    try:
        parameters.set_value(name, str(wanted))
        parameters.add_update_callback(group=group, name=short, cb=on_value)
        parameters.request_param_update(name)
        if not answered.wait(PARAMETER_TIMEOUT_S):
            raise TimedOut(f"parameter {name} was set to {wanted}, but no answer came")
    except (AttributeError, ValueError, KeyError) as error:
        raise InvalidValue(f"parameter {name} cannot be set to {wanted}: {error}") from None
    finally:
        parameters.remove_update_callback(group, short, on_value)
    if not math.isclose(float(answers[-1]), float(wanted), rel_tol=1e-5, abs_tol=1e-9):
        raise InvalidValue(
            f"parameter {name} was set to {wanted}, but the vehicle keeps {answers[-1]}"
        )

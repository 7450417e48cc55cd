"""`perchctl make-target --measured-large, --measured-small`: sizes of the print into a profile."""

from __future__ import annotations

from pathlib import Path

from perchctl.commands.make_target_request import TargetOutcome, TargetRequest, requested_target
from perchctl.errors import InvalidValue, UsageError
from perchctl.files import check_place
from perchctl.profile import load_profile
from perchctl.target import (
    measured_target,
    new_profile_text,
    parse_length,
    updated_profile_text,
    write_profile,
)

BASE_FOR_NEW = "crazyflie"
"""What a new profile extends where -p names a file that does not exist yet."""


def write_measured(request: TargetRequest) -> TargetOutcome:
    """Write a profile with the measured sizes.

    Raises NotFound, InvalidValue, UsageError; then nothing has been written.
    """
    base, path = _profile_to_write(request)
    changed = path.exists() and request.output is None
    if changed and not request.force:
        raise InvalidValue(
            f"{path} exists already; add --force to write the sizes into it, "
            f"or -o NEW.yaml for a small profile that extends it"
        )
    check_place(path, request.force)
    profile = load_profile(base)
    found = measured_target(
        requested_target(request, profile),
        _measured(request.measured_large, "large"),
        _measured(request.measured_small, "small"),
    )
    if changed:
        text = updated_profile_text(path, path.read_text(encoding="utf-8"), found.target)
    else:
        text = new_profile_text(_named_from(base, path), found.target)
    write_profile(path, text, profile.model_copy(update={"target": found.target}))
    lines = [*found.notes, f"{'changed' if changed else 'wrote'} {path}: fly -p {path}"]
    record = {"files": [str(path)], "target": found.target.model_dump(mode="json")}
    return TargetOutcome({}, lines, record | {"notes": list(found.notes)})


def _profile_to_write(request: TargetRequest) -> tuple[str, Path]:
    """The profile that the sizes start from, and the file that gets them."""
    name = request.profile
    if request.output is not None:
        if request.output.suffix.lower() not in (".yaml", ".yml"):
            raise UsageError(f"-o {request.output}: measured sizes go into a profile, a .yaml file")
        return name or BASE_FOR_NEW, request.output
    if name is None or not ("/" in name or name.endswith((".yaml", ".yml"))):
        shown = name or BASE_FOR_NEW
        raise UsageError(
            f"name the profile that gets the sizes: -p my_vehicle.yaml, or -p {shown} "
            f"-o my_vehicle.yaml for a small new one that extends {shown}"
        )
    path = Path(name).expanduser()
    return (name if path.exists() else BASE_FOR_NEW), path


def _named_from(base: str, path: Path) -> str:
    """How the new profile at `path` names its base: a file by its path from there."""
    file = Path(base).expanduser()
    if not ("/" in base or base.endswith((".yaml", ".yml"))):
        return base
    same = file.resolve().parent == path.resolve().parent
    return file.name if same else str(file.resolve())


def _measured(text: str | None, name: str) -> float | None:
    return None if text is None else parse_length(text, f"--measured-{name}", bare_unit="mm")

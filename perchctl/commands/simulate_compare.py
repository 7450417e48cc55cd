"""The work behind `perchctl simulate --compare`: two profiles over the same seeds."""

from __future__ import annotations

from perchctl.analysis import profile_differences
from perchctl.commands.output import print_record
from perchctl.commands.positioning import positioned
from perchctl.commands.simulate_request import SimulateRequest, and_problem, fly_each
from perchctl.errors import PerchError
from perchctl.flight import (
    VariantResult,
    compare_variants,
    fly_variants,
    variants_record,
    variants_text,
    whole_seeds,
)
from perchctl.profile import load_profile

_NO_DIFFERENCE = ("name", "description", "date")


def run_compare(request: SimulateRequest) -> int:
    """Fly each seed by both profiles and print. Errors: NotFound, InvalidValue."""
    assert request.compare is not None
    other = positioned(load_profile(request.compare), request.positioning)
    profiles = (request.loaded(), other)
    names = (request.profile, request.compare)
    keys = profile_differences(*(p.model_dump(mode="json") for p in profiles))
    keys = {key: values for key, values in keys.items() if key not in _NO_DIFFERENCE}

    def report(results: list[VariantResult], problem: PerchError | None) -> None:
        pairs = [(a, b) for a, b in whole_seeds(results, len(profiles))]
        found = compare_variants(names, pairs)
        if request.as_json:
            record = {
                "a": names[0],
                "b": names[1],
                **variants_record(found),
                "profile": {key: {"a": a, "b": b} for key, (a, b) in keys.items()},
            }
            print_record(and_problem(record, problem))
            return
        print(variants_text(found))
        for key, (a, b) in keys.items():
            print(f"differs: {key} is {a} in A, {b} in B")
        if not keys:
            print("the profiles do not differ")

    return fly_each(
        lambda executor, note: fly_variants(profiles, request.seeds, executor, note),
        request,
        report,
        flights=len(profiles) * len(request.seeds),
        profiles=profiles,
    )

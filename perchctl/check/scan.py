"""Which vehicles answer, as rows."""

from __future__ import annotations

from perchctl.check.row import Row, failed, passed, skipped
from perchctl.link import UDEV_HELP, ScanResult

NO_ANSWER = "switch the vehicle on; a radio's address other than E7E7E7E7E7 goes with -u"


def rows(answering: ScanResult) -> list[Row]:
    """One for the radio, one for each vehicle."""
    radio = passed("radio", "scanned: channels 0 to 125 at 250K, 1M, 2M")
    if answering.radio:
        radio = skipped("radio", answering.radio, UDEV_HELP)
    found = [passed("address", f"{uri} answers") for uri in answering.uris]
    return [radio, *(found or [failed("address", "nothing answers", NO_ANSWER)])]


def others(uri: str, answering: ScanResult) -> str:
    """What to do about a vehicle that does not answer, given those that do."""
    there = [each for each in answering.uris if each != uri]
    if there:
        return f"these answer: {', '.join(there)}; give one with -u, or set link.uri"
    return "switch it on, look at its address; perchctl check --scan shows what answers"

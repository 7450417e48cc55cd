"""The live page of the commands that work on pictures."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

from perchctl.commands.output import say
from perchctl.display import LivePage
from perchctl.vision import CameraModel


def page_port(view: bool, port: int) -> int | None:
    """The port for `--view` and `--view-port` (0: any free one); None for no page."""
    return port if view or port > 0 else None


@contextlib.contextmanager
def live_page(camera: CameraModel, title: str, port: int | None) -> Iterator[LivePage | None]:
    """The page, its address on stderr; None without a port. Errors: InvalidValue."""
    if port is None:
        yield None
        return
    page = LivePage(camera, title, port)
    say(f"live page: {page.url}")
    try:
        yield page
    finally:
        page.close()
        if page.problem is not None:
            say(f"the live page failed: {page.problem}")

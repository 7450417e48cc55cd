"""Common parts of all reports: a single HTML file that runs no scripts and loads nothing."""

from __future__ import annotations

import base64
from functools import cache
from typing import Any

import jinja2
from markupsafe import Markup

import perchctl

POLICY = "default-src 'none'; img-src data:; media-src data:; style-src 'unsafe-inline'"
"""Content security policy, enforced by the browser: no scripts, and nothing from other servers."""


def render_template(package: str, name: str, **values: Any) -> Markup:
    """Render a template from the package's folder `templates`.

    A template of a whole page extends ``report.html``, which provides the style sheet and `POLICY`.
    Text in `values` is escaped. Raises jinja2.UndefinedError if a value is missing.
    """
    template = _environment(package).get_template(name)
    return Markup(template.render(values, policy=POLICY, version=perchctl.__version__))


@cache
def _environment(package: str) -> jinja2.Environment:
    folders = [jinja2.PackageLoader(package), jinja2.PackageLoader("perchctl")]
    return jinja2.Environment(
        loader=jinja2.ChoiceLoader(folders),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )


def data_url(kind: str, content: bytes) -> str:
    """Return content of a MIME type as a ``data:`` URL, for a page that contains its own images."""
    return f"data:{kind};base64,{base64.b64encode(content).decode('ascii')}"

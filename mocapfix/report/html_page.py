"""Rendering of self-contained HTML pages from the templates of this package."""

from functools import cache
from pathlib import Path

from jinja2 import Environment, PackageLoader, StrictUndefined

from mocapfix.files.output_files import replace_atomically
from mocapfix.report.sample_states import AMBER, BLUE, GREEN, RED, VIOLET

PAGE_COLOURS = {"green": GREEN, "red": RED, "amber": AMBER, "violet": VIOLET, "blue": BLUE}


def write_page(target: Path, template: str, **values: object) -> None:
    """Render a template to a file. Values are escaped unless they are Markup.

    Raises WriteError if `target` cannot be written.
    """
    text = _load_environment().get_template(template).render(colours=PAGE_COLOURS, **values)
    with replace_atomically(target) as part:
        part.write_text(text, encoding="utf-8", errors="backslashreplace", newline="\n")


@cache
def _load_environment() -> Environment:
    return Environment(
        loader=PackageLoader("mocapfix.report"), autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )

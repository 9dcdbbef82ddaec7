"""Write the generated tables of the documentation: `python docs/generate_tables.py`.

A table stands between `<!-- NAME -->` and `<!-- end -->`. A test checks that the committed tables are up to date.
"""

import re
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path

from mocapfix.lab.baseline import read_baseline
from mocapfix.option import Option
from mocapfix.options import OPTIONS, CleanOptions

DOCS = Path(__file__).parent


def build_option_table() -> str:
    """Return one table of all options for each stage."""
    tables: list[str] = []
    for stage in fields(CleanOptions):
        title = (type(stage.default).__doc__ or "").strip().rstrip(".")
        tables.append(f"### {title}\n")
        tables.append("| flag | Python | job file | default | meaning |\n|---|---|---|---|---|")
        for option in (option for option in OPTIONS if option.stage == stage.name):
            flags = ", ".join(f"`{flag}`" for flag in (option.flag, *option.aliases))
            job_key = f"`{option.job_key}`" if option.job_key else ""
            default = format_default(option.default, option)
            if option.lab_default is not None:
                default += f"; lab: {format_default(option.lab_default, option)}"
            tables.append(f"| {flags} | `{option.name}` | {job_key} | {default} | {option.help.replace('|', '&#124;')} |")
        tables.append("")
    return "\n".join(tables).rstrip()


def format_default(value: object, option: Option) -> str:
    """Return the default in the unit that users see."""
    if option.default_text:
        return option.default_text
    if isinstance(value, bool):
        return "on" if value else "off"
    values = value if isinstance(value, tuple) else (value,)
    texts = [f"{option.to_display(each):g}" if isinstance(each, int | float) else str(each) for each in values]
    return " ".join([", ".join(texts), option.unit]).strip()


def build_baseline_table() -> str:
    """Return the committed baseline as a table."""
    rows = ["| quantity | value | tolerance |", "|---|---:|---:|"]
    for name, entry in read_baseline(DOCS.parent / "scenes/bench/baseline.json").items():
        tolerances = [f"{entry.tolerance_percent:g} %"] if entry.tolerance_percent else []
        tolerances += [f"{entry.tolerance:g}"] if entry.tolerance else []
        rows.append(f"| {name} | {entry.value:.4g} | {' or '.join(tolerances)} |")
    return "\n".join(rows)


TABLES = {"options": build_option_table, "baseline": build_baseline_table}


def fill_tables(text: str) -> str:
    """Return a page with its generated tables replaced."""
    for name, build in TABLES.items():
        text = fill_section(text, name, build)
    return text


def fill_section(text: str, name: str, build: Callable[[], str]) -> str:
    """Return a page whose section `<!-- name -->` holds what `build` returns; it is called only if there is such a section."""
    pattern = rf"(<!-- {name} -->\n).*?(<!-- end -->)"
    return re.sub(pattern, lambda match: f"{match[1]}\n{build()}\n\n{match[2]}", text, flags=re.DOTALL)


def main() -> None:
    for page in sorted(DOCS.glob("*.md")):
        text = page.read_text(encoding="utf-8")
        page.write_text(fill_tables(text), encoding="utf-8")


if __name__ == "__main__":
    main()

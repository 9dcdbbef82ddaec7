"""The generated tables of the documentation are up to date, and the files that it links to exist."""

import importlib.util
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PAGES = sorted([*(ROOT / "docs").rglob("*.md"), *ROOT.glob("*.md")])


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_generated_tables_are_up_to_date(page: Path) -> None:
    spec = importlib.util.spec_from_file_location("generate_tables", ROOT / "docs" / "generate_tables.py")
    assert spec
    assert spec.loader
    generator = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(generator)
    text = page.read_text(encoding="utf-8")
    assert generator.fill_tables(text) == text, "run: python docs/generate_tables.py"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_to_files_exist(page: Path) -> None:
    links = re.findall(r"\]\(([^)#\s]+)", page.read_text(encoding="utf-8"))
    missing = [link for link in links if "://" not in link and not (page.parent / link).exists()]
    assert not missing


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_mentioned_modules_exist(page: Path) -> None:
    folders = ("mocapfix", "tests", "examples", "docs")
    modules = [path.as_posix() for folder in folders for path in (ROOT / folder).rglob("*.py")]
    mentioned = re.findall(r"`([\w/]+\.py)", page.read_text(encoding="utf-8"))
    assert not [name for name in mentioned if "my_" not in name and not any(module.endswith(f"/{name}") for module in modules)]

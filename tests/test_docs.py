"""The generated tables of the documentation are up to date, and the files that it links to exist."""

import importlib.util
import re
from pathlib import Path

import griffe
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


GALLERY = ROOT / "docs" / "gallery"
MAX_BYTES = {".png": 300_000, ".webp": 2_000_000}
MAX_GALLERY_BYTES = 3_000_000


def test_pictures_of_the_gallery_are_shown_and_small() -> None:
    links = [(page, link) for page in PAGES for link in re.findall(r"\]\(([^)#\s]+)", page.read_text(encoding="utf-8"))]
    sizes = {path: path.stat().st_size for path in GALLERY.iterdir()}
    assert sizes.keys() <= {(page.parent / link).resolve() for page, link in links}
    assert not [path.name for path, size in sizes.items() if size > MAX_BYTES[path.suffix]]
    assert 0 < sum(sizes.values()) <= MAX_GALLERY_BYTES


def test_every_section_of_the_gallery_has_a_caption_with_errors() -> None:
    text = (ROOT / "docs" / "index.md").read_text(encoding="utf-8")
    captions = dict(re.findall(r"<!-- ([\w-]+) -->\n(.*?)<!-- end -->", text, re.DOTALL))
    script = (ROOT / "docs" / "generate_gallery.py").read_text(encoding="utf-8")
    assert list(captions) == re.findall(r'^    "([\w-]+)": make_', script, re.MULTILINE)
    assert [name for name, caption in captions.items() if not re.search(r"\d mm\b", caption)] == ["session-page"]


@pytest.mark.parametrize(
    ("name", "field", "description"),
    [
        ("options.CleanOptions", "fill", "Gap filling."),  # the class of a stage's options
        ("options.FillOptions", "max_gap_s", "Leave longer gaps empty: `--max-gap SECONDS`."),  # an option
        ("options.PurposeOptions", "given", "The names of the options that were given"),  # a string below
        ("model.take.Take", "markers", "Positions in metres, NaN where a sample is missing."),  # the section Attributes
        ("contacts.contacts.Floor", "slope_z", "The same along Z."),  # a comment behind
        ("solve.single_pose.SolvedPose", "cost", "Half the sum of squares"),  # comments above
    ],
)
def test_site_describes_the_fields_of_a_class(name: str, field: str, description: str) -> None:
    module, _, class_name = name.rpartition(".")
    path, lines = ROOT / "mocapfix" / f"{module.replace('.', '/')}.py", griffe.LinesCollection()
    text = path.read_text(encoding="utf-8")
    lines[path] = text.splitlines()
    extensions = griffe.load_extensions(str(ROOT / "docs" / "describe_fields.py"))
    loaded = griffe.visit(
        f"mocapfix.{module}", path, text, extensions=extensions, docstring_parser="google", lines_collection=lines
    )
    sections = loaded[class_name].docstring.parsed
    rows = {row.name: row.description for section in sections if section.kind.value == "attributes" for row in section.value}
    assert rows[field].startswith(description)
    assert rows.keys() >= {each for each, member in loaded[class_name].attributes.items() if "property" not in member.labels}

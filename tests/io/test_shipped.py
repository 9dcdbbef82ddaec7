"""Finding and reading shipped files."""

import tomllib
from importlib import metadata
from pathlib import Path

import pytest
import yaml

from mocapfix.errors import MocapfixError, SceneError
from mocapfix.io import shipped


@pytest.mark.parametrize(("name", "file"), [("scenes", "skeletons/cmu31.yaml"), ("priors", "mean-pose.yaml")])
def test_shipped_folders_are_found(name, file):
    assert (shipped.find_shipped_folder(name) / file).is_file()


def test_folder_within_the_package_takes_precedence(tmp_path, monkeypatch):
    package = tmp_path / "mocapfix"
    (tmp_path / "scenes").mkdir()
    package.mkdir()
    monkeypatch.setattr(shipped, "__file__", str(package / "io" / "shipped.py"))
    assert shipped.find_shipped_folder("scenes") == tmp_path / "scenes"
    (package / "scenes").mkdir()
    assert shipped.find_shipped_folder("scenes") == package / "scenes"


def test_version_of_a_checkout_that_is_not_installed(monkeypatch: pytest.MonkeyPatch) -> None:
    def find_nothing(name: str) -> str:
        raise metadata.PackageNotFoundError(name)

    monkeypatch.setattr(metadata, "version", find_nothing)
    project = Path(__file__).parents[2] / "pyproject.toml"
    expected = tomllib.loads(project.read_text(encoding="utf-8"))["project"]["version"]
    assert shipped.get_version.__wrapped__() == expected


def test_every_shipped_yaml_is_read():
    paths = [*shipped.find_shipped_folder("scenes").rglob("*.yaml"), *shipped.find_shipped_folder("priors").glob("*.yaml")]
    assert len(paths) >= 4
    assert all(shipped.read_yaml(path) == yaml.safe_load(path.read_text(encoding="utf-8")) for path in paths)
    assert shipped.read_shipped_yaml("skeletons/cmu31.yaml")["name"] == "cmu31"


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", ": contains no key: value pairs; check that it is the right file."),
        (b"- a\n- b\n", ": contains no key: value pairs; check that it is the right file."),
        (b"a: 1\nb: [1, 2\nc: 3\n", ", line 3: not valid YAML (did not find expected ',' or ']')."),
        (b"a: 1\n\tb: 2\n", ", line 2: not valid YAML (found character '\\t' that cannot start any token)."),
        (b"C3D\x00\x01\x02", ": not valid YAML (control characters are not allowed)."),
    ],
    ids=["empty", "a list", "an open bracket", "a tab", "not text"],
)
def test_error_names_file_and_line(tmp_path, content, message):
    path = tmp_path / "set.yaml"
    path.write_bytes(content)
    with pytest.raises(SceneError) as raised:
        shipped.read_yaml(path)
    if "not valid YAML" in message:  # the explanation differs between the parsers of PyYAML
        assert str(raised.value).startswith(f"{path}{message.split('(')[0]}(")
        assert str(raised.value).endswith(").")
    else:
        assert str(raised.value) == f"{path}{message}"


@pytest.mark.parametrize(
    "value",
    ["2024-13-45", "!!timestamp x", "!!int x", "9" * 5000, "[" * 50_000, "{a: " * 50_000, "- " * 50_000, "[" * 101 + "]" * 101],
)
def test_value_that_cannot_be_built_is_an_error(tmp_path, value):
    path = tmp_path / "set.yaml"
    path.write_text(f"a: 1\nb: {value}\n" if value[0] != "-" else f"{value}\n", encoding="utf-8")
    with pytest.raises(SceneError, match=r"set\.yaml") as raised:
        shipped.read_yaml(path)
    assert "\n" not in str(raised.value)
    assert len(str(raised.value)) < 400


def test_depth_of_yaml():
    assert shipped.measure_yaml_depth("a: {b: [c]}\n" * 1000) == 0
    assert shipped.measure_yaml_depth("a: " + "[" * 150 + "]" * 150) > shipped.MAX_YAML_DEPTH
    assert shipped.measure_yaml_depth("a: '" + "[" * 150 + "'") == 1


def test_invalid_utf8_is_an_error(tmp_path):
    path = tmp_path / "set.yaml"
    path.write_bytes(b"a: \xff\xfe\x80")
    with pytest.raises(SceneError, match=r"set\.yaml: cannot be read \(.*utf-8"):
        shipped.read_yaml(path)


def test_missing_file_and_folder_are_errors(tmp_path):
    with pytest.raises(MocapfixError) as raised:
        shipped.read_yaml(tmp_path / "none.yaml")
    assert str(raised.value) == f"{tmp_path / 'none.yaml'}: cannot be read (No such file or directory)."
    with pytest.raises(SceneError, match="cannot be read"):
        shipped.read_yaml(tmp_path)


def test_aliases_that_multiply_are_refused(tmp_path):
    path, levels = tmp_path / "set.yaml", range(1, 9)
    lines = ["a0: &a0 [x, x]", *(f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 9)}]" for n in levels)]
    path.write_text("\n".join(lines), encoding="utf-8")
    with pytest.raises(SceneError, match="aliases"):
        shipped.read_yaml(path)
    path.write_text("a: &a [1, *a]\n", encoding="utf-8")
    with pytest.raises(SceneError, match="aliases"):
        shipped.read_yaml(path)
    path.write_text("a: &a [1, 2]\nb: *a\n", encoding="utf-8")
    assert shipped.read_yaml(path) == {"a": [1, 2], "b": [1, 2]}


@pytest.mark.parametrize("name", ["x" * 5000, "a\0b", ""])
def test_impossible_names_are_no_files(name):
    assert not shipped.is_existing_file(name)


def test_what_is_parsed_is_kept_until_a_file_changes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("mocapfix.kernels.compilation.CACHE_FOLDER", tmp_path)
    file, parsed = tmp_path / "lengths.yaml", list[int]()

    def parse() -> int:
        parsed.append(len(file.read_text(encoding="utf-8")))
        return parsed[-1]

    for text in ("one", "one", "three"):
        file.write_text(text, encoding="utf-8")
        assert shipped.keep_parsed("lengths", [file], parse) == len(text)
    assert parsed == [3, 5]
    (tmp_path / "lengths.pickle").write_bytes(b"damaged")
    assert shipped.keep_parsed("lengths", [file], parse) == 5

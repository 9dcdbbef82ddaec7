"""The extension of Blender: its zip file and its manifest."""

import importlib.util
import os
import re
import shutil
import subprocess
import tomllib
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
REQUIRED_FIELDS = ("schema_version", "id", "version", "name", "tagline", "maintainer", "type", "blender_version_min", "license")
TAGS = ("Animation", "Import-Export")
"""of those that Blender's extensions may have"""


@pytest.fixture(scope="module")
def archive(tmp_path_factory) -> Path:
    """The extension, built as users build it."""
    spec = importlib.util.spec_from_file_location("build_addon", ROOT / "addon" / "build_addon.py")
    assert spec
    assert spec.loader
    builder = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(builder)
    return builder.build_addon(tmp_path_factory.mktemp("dist"))


@pytest.fixture(scope="module")
def manifest(archive) -> dict:
    with zipfile.ZipFile(archive) as opened:
        return tomllib.loads(opened.read("blender_manifest.toml").decode())


def test_manifest_has_the_fields_that_blender_requires(manifest):
    assert not [field for field in REQUIRED_FIELDS if not manifest.get(field)]
    assert manifest["schema_version"] == "1.0.0"
    assert manifest["type"] == "add-on"
    assert re.fullmatch(r"[a-z][a-z0-9_]*", manifest["id"])
    assert set(manifest["tags"]) <= set(TAGS)
    assert manifest["license"] == ["SPDX:MIT"]


def test_texts_of_the_manifest_have_the_form_that_blender_requires(manifest):
    for text in (manifest["tagline"], *manifest["permissions"].values()):
        assert 0 < len(text) <= 64
        assert text[-1].isalnum()  # no full stop


def test_version_is_that_of_the_package(manifest, archive):
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert manifest["version"] == project["version"]
    assert archive.name == f"mocapfix_blender-{project['version']}.zip"


def test_archive_has_the_sources_and_the_license_at_its_top(archive):
    sources = {path.name for path in (ROOT / "addon" / "mocapfix_blender").glob("*.py")}
    with zipfile.ZipFile(archive) as opened:
        assert set(opened.namelist()) == sources | {"LICENSE", "blender_manifest.toml"}


def test_sources_import_neither_the_package_nor_compiled_libraries():
    for path in (ROOT / "addon" / "mocapfix_blender").glob("*.py"):
        imports = re.findall(r"^\s*(?:from|import) (\w+)", path.read_text(encoding="utf-8"), re.MULTILINE)
        assert not {"mocapfix", "numba", "scipy", "yaml"} & set(imports), path.name


@pytest.mark.skipif(shutil.which("make") is None, reason="make is not installed")
def test_make_builds_the_same_bytes_again(archive, tmp_path):
    shutil.copytree(ROOT / "addon", tmp_path / "addon", ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("Makefile", "LICENSE"):
        shutil.copy(ROOT / name, tmp_path / name)
    for path in (tmp_path / "addon").rglob("*.*"):
        os.utime(path, (1e9, 1e9))
    subprocess.run(["make", "addon"], cwd=tmp_path, check=True, capture_output=True)
    assert (tmp_path / "dist" / archive.name).read_bytes() == archive.read_bytes()

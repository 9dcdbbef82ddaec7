"""Hashes of options: the same for the same content, another for any change."""

from pathlib import Path

import pytest

from mocapfix.batch.records import hash_options, resolve_option_files
from mocapfix.options import CleanOptions, build_clean_options


def test_hash_changes_with_an_option_and_with_the_content_of_its_file(tmp_path: Path) -> None:
    subject = tmp_path / "jim.yaml"
    subject.write_text("a", encoding="utf-8")
    options = build_clean_options(subject=subject)
    first = hash_options(options)
    assert hash_options(build_clean_options(subject=subject)) == first
    assert hash_options(options.change(max_gap_s=1.0)) != first
    subject.write_text("b", encoding="utf-8")
    assert hash_options(options) != first


def test_files_of_options_become_absolute(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "jim.yaml").touch()
    monkeypatch.chdir(tmp_path)
    options = resolve_option_files(build_clean_options(subject="jim.yaml", marker_set="cmu41"))
    assert options.subject.subject == tmp_path / "jim.yaml"
    assert options.subject.marker_set == "cmu41"


def test_hash_depends_on_values_not_on_who_set_them() -> None:
    lab = CleanOptions().change(purpose="lab")
    assert hash_options(lab) == hash_options(lab.change(max_sd_m=0.020, feet="off"))
    assert hash_options(lab) != hash_options(CleanOptions())
    assert hash_options(CleanOptions().change(max_sd_m=0.020)) != hash_options(CleanOptions())

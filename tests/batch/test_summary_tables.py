"""The tables of a session: one row a take and subject, failures first, and both files hold the same."""

import csv
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pyarrow import parquet

from mocapfix.batch.records import TakeRecord
from mocapfix.batch.session_page import SUMMARY_COLUMNS, build_summary_row, list_summary_rows, write_summary_tables
from mocapfix.errors import WriteError
from tests.batch.session_records import build_done, build_failed, take_records


def read_rows(path: Path) -> list[dict[str, str]]:
    with path.open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def test_one_row_for_each_take_and_subject_and_failures_first(tmp_path: Path) -> None:
    records = [build_done("b.c3d", "Jim", "Ann"), build_failed("z.c3d"), build_done("a.c3d")]
    path, _ = write_summary_tables(tmp_path, records)
    rows = read_rows(path)
    assert [(row["take"], row["subject"], row["status"]) for row in rows] == [
        ("z.c3d", "", "failed"),
        ("a.c3d", "", "done"),
        ("b.c3d", "Jim", "done"),
        ("b.c3d", "Ann", "done"),
    ]
    assert (rows[0]["error"], rows[0]["filled"], rows[0]["fault_count"]) == ("it is empty.", "", "")
    assert (rows[1]["fault_count"], rows[1]["fault_count_gap"], rows[1]["fault_count_leading_gap"]) == ("51", "49", "0")
    assert {each.name for each in tmp_path.iterdir()} == {"summary.csv", "summary.parquet"}


def test_columns_name_their_units() -> None:
    assert {"duration_s", "rate_hz", "residual_mm", "worst_predicted_error_mm", "take_seconds"} <= set(SUMMARY_COLUMNS)


def test_columns_do_not_depend_on_the_takes(tmp_path: Path) -> None:
    _, path = write_summary_tables(tmp_path, [])
    empty = parquet.read_schema(path)
    write_summary_tables(tmp_path, [build_failed("a.c3d")])
    assert parquet.read_schema(path).equals(empty)
    assert parquet.read_table(path).num_rows == 1


@given(st.lists(take_records(), max_size=5))
@settings(max_examples=40, deadline=None)
def test_both_tables_hold_the_records(records: list[TakeRecord]) -> None:
    with TemporaryDirectory() as folder:
        csv_path, parquet_path = write_summary_tables(Path(folder), records)
        rows, table = read_rows(csv_path), parquet.read_table(parquet_path).to_pylist()
    assert len(rows) == len(table) == len(list(list_summary_rows(records)))
    for (record, figures), row, stored in zip(list_summary_rows(records), rows, table, strict=True):
        for name, value in build_summary_row(record, figures).items():
            assert stored[name] == value
            assert row[name] == ("" if value is None else str(value))


def test_folder_that_cannot_be_written_is_one_sentence(tmp_path: Path) -> None:
    with pytest.raises(WriteError, match=r"summary\.csv: cannot be written"):
        write_summary_tables(tmp_path / "removed", [])

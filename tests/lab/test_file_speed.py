import pytest

from mocapfix.io import capture
from mocapfix.lab import clean_speed
from mocapfix.synthetic import write_synthetic_take


def test_every_operation_is_timed_on_the_whole_take(monkeypatch):
    monkeypatch.setattr(clean_speed, "FILE_REPEATS", 1)
    rows = clean_speed.measure_file_speed(duration_s=2.0)
    assert [row["what"] for row in rows[:2]] == ["read C3D", "write C3D"]
    assert all(row["frames"] == 240 and float(row["ms"]) > 0 for row in rows)


def test_composed_take_has_53_markers_and_the_repaired_share_changes(tmp_path):
    truth = clean_speed.compose_file_take(2.0)
    write_synthetic_take(tmp_path / "a.c3d", truth)
    take = capture.read_take(tmp_path / "a.c3d")
    assert (len(take.labels), len(set(take.labels)), take.rate) == (53, 53, 120)
    clean_speed.build_take_jobs(tmp_path / "a.c3d")["write C3D"]()
    repaired = capture.read_take(tmp_path / "repaired.c3d")
    changed = (repaired.markers == 1.0).all(-1)
    assert not (take.markers == 1.0).any()
    assert changed.mean() == pytest.approx(clean_speed.REPAIRED_SAMPLE_SHARE, rel=0.2)

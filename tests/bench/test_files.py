import pytest

from mocapfix import read, synthetic
from mocapfix.bench import files


def test_every_row_is_timed_on_the_whole_take(monkeypatch):
    monkeypatch.setattr(files, "REPEATS", 1)
    rows = files.measured(seconds=2.0)
    assert [row["what"] for row in rows[:2]] == ["read C3D", "write C3D"]
    assert all(row["frames"] == 240 and row["ms"] > 0 for row in rows)


def test_the_composed_take_is_of_53_markers_and_the_mended_one_differs_as_it_says(tmp_path):
    truth = files.composed(2.0)
    synthetic.write(tmp_path / "a.c3d", truth)
    take = read.take(tmp_path / "a.c3d")
    assert (len(take.labels), len(set(take.labels)), take.rate) == (53, 53, 120)
    files.works(tmp_path / "a.c3d")["write C3D"]()
    mended = read.take(tmp_path / "mended.c3d")
    changed = (mended.markers == 1.0).all(-1)
    assert not (take.markers == 1.0).any()
    assert changed.mean() == pytest.approx(files.MENDED, rel=0.2)

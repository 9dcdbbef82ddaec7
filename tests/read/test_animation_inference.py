import pytest

from mocapfix.read.animation_inference import infer_rate


@pytest.mark.parametrize(
    ("spelled", "rate", "is_noted"),
    [
        (".0083", 120, True), ("0.0083333", 120, False), ("0.00833333", 120, False), ("0.033", 30, True), ("0.033333", 30, False),
        ("0.016666", 60, True), ("0.0166", 60, True), ("0.041667", 24, False), ("0.0333667", 30000 / 1001, False),
        ("0.04", 25, False), ("0.01", 100, False), ("8.3333e-3", 120, False), ("0.0101", 1 / 0.0101, False),
        ("0.2", 5, False), ("1", 1, False),
    ],
)  # fmt: skip
def test_rounded_frame_times_give_the_common_rate(spelled, rate, is_noted):
    inferred, notes = infer_rate(spelled)
    assert inferred == pytest.approx(rate, rel=1e-12)
    assert bool(notes) == is_noted
    assert all(spelled in note for note in notes)

import pytest

from mocapfix.model import stage_timer
from mocapfix.model.stage_timer import StageTimer


@pytest.fixture
def clock(monkeypatch):
    """Let every reading of the clock be one second after the previous one."""
    readings = iter(range(100))
    monkeypatch.setattr(stage_timer, "perf_counter", lambda: float(next(readings)))


def test_times_of_a_repeated_stage_are_added(clock):
    timer = StageTimer()
    for stage in ("read", "solve", "read"):
        with timer(stage):
            pass
    assert timer.stage_seconds == {"read": 2.0, "solve": 1.0, "total": 3.0}


def test_every_stage_is_reported_when_it_starts():
    started = []
    timer = StageTimer(report_progress=started.append)
    with timer("read"):
        assert started == ["read"]


def test_times_of_the_parts_of_a_stage_are_added_by_part_and_by_stage(monkeypatch):
    clock, processor = iter([0.0, 1.0, 1.0, 3.0, 3.0, 7.0]), iter([0.0, 2.0, 2.0, 6.0, 6.0, 6.5])
    monkeypatch.setattr(stage_timer, "perf_counter", lambda: next(clock))
    monkeypatch.setattr(stage_timer, "process_time", lambda: next(processor))
    timer = StageTimer()
    for part in ("feet", "limbs", "feet"):
        with timer("solve", part):
            pass
    assert timer.stage_seconds == {"solve": 7.0, "total": 7.0}
    assert timer.part_times == {
        "solve/feet": {"seconds": 5.0, "processor_seconds": 2.5},
        "solve/limbs": {"seconds": 2.0, "processor_seconds": 4.0},
    }

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

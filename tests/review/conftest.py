"""A cleaned take with faults, and a server that reviews it."""

import shutil
import threading
from collections.abc import Generator, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import pytest

from mocapfix import pipeline
from mocapfix.review.review_session import ReviewSession
from mocapfix.review.server import ReviewServer
from mocapfix.synthetic import compose_take, write_synthetic_take

SEED, DURATION_S, RATE_HZ = 3, 4.0, 60.0
STEM = "walk"


@dataclass(frozen=True)
class RunningServer:
    """A server that runs in a thread. `address` is that of its page, without the slash at its end."""

    address: str
    folder: Path
    session: ReviewSession
    server: ReviewServer


@pytest.fixture(scope="session")
def cleaned_take(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a damaged take, walk.c3d, and of its outputs, walk.mocapfix. Not to be changed."""
    folder = tmp_path_factory.mktemp("cleaned")
    path = folder / f"{STEM}.c3d"
    write_synthetic_take(path, compose_take(seed=SEED, seconds=DURATION_S, rate=RATE_HZ))
    pipeline.clean(path, prior="none").write(folder / f"{STEM}.mocapfix")
    return folder


@pytest.fixture
def folder(cleaned_take: Path, tmp_path: Path) -> Path:
    """A copy of the outputs, beside a copy of the take."""
    shutil.copytree(cleaned_take, tmp_path / "session")
    return tmp_path / "session" / f"{STEM}.mocapfix"


@contextmanager
def serve(folder: Path) -> Generator[RunningServer]:
    """Review the takes of a folder."""
    session = ReviewSession(folder)
    server = ReviewServer(session)
    thread = threading.Thread(target=server.serve, daemon=True)
    thread.start()
    yield RunningServer(server.address.rstrip("/"), folder, session, server)
    server.stop()
    thread.join(10.0)
    assert not thread.is_alive()


@pytest.fixture
def running(folder: Path) -> Iterator[RunningServer]:
    """A server that reviews the outputs."""
    with serve(folder) as server:
        yield server

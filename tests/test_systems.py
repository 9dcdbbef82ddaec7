"""Clean, batch and review without what only POSIX has. Windows itself is tested by the hosted workflow only."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from mocapfix.synthetic import compose_take, write_synthetic_take

TESTS = Path(__file__).parent
PACKAGE = TESTS.parent / "mocapfix"
POSIX_ONLY = re.compile(
    r"\bos\.(fork|forkpty|getuid|killpg|setsid|wait4)\b|\bsignal\.(SIGKILL|SIGHUP|SIGUSR\d|alarm|pause)\b"
    r"|^\s*(import|from) (fcntl|grp|pwd|resource|termios)\b|\"/(proc|dev)/",
    re.MULTILINE,
)
PLATFORM = re.compile(r"\bsys\.platform\b|\bos\.name\b|\bplatform\.(system|platform|machine)\b|\bimport platform\b")

SCRIPT = """
import json, sys, threading, urllib.request
from pathlib import Path
from mocapfix.cli.app import run_command_line
from mocapfix.review.review_session import ReviewSession
from mocapfix.review.server import ReviewServer

takes, out = map(Path, sys.argv[1:])

def run(*arguments):
    try:
        run_command_line(list(map(str, arguments)))
    except SystemExit as end:
        return end.code

if __name__ == "__main__":
    cleaned = run("clean", takes / "日.c3d", "--out", out / "cleaned")
    batch = run("batch", takes, "--out", out / "batch", "--workers", "1", "--people", "each-take")
    server = ReviewServer(ReviewSession(out / "cleaned"))
    threading.Thread(target=server.serve, daemon=True).start()
    session = json.load(urllib.request.urlopen(f"{server.address}api/session", timeout=60))
    print(json.dumps([cleaned, batch, len(session["takes"])]))
"""


@pytest.fixture(scope="module")
def environment(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """Return the environment of processes that lack what Windows lacks, with a terminal that lacks most characters."""
    paths = os.pathsep.join([str(TESTS / "other_system"), str(PACKAGE.parent)])
    return {**os.environ, "PYTHONPATH": paths, "PYTHONIOENCODING": "cp1252", "TMPDIR": str(tmp_path_factory.mktemp("temporary"))}


def run_python(environment: dict[str, str], *arguments: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, *map(str, arguments)]
    return subprocess.run(command, env=environment, capture_output=True, encoding="cp1252", check=False)


def test_clean_batch_and_review_need_nothing_of_posix(environment: dict[str, str], tmp_path: Path) -> None:
    takes = tmp_path / "takes"
    takes.mkdir()
    write_synthetic_take(takes / "日.c3d", compose_take(seconds=1.0, rate=30.0))
    for name in ("b", "c"):
        (takes / f"{name}.c3d").write_bytes((takes / "日.c3d").read_bytes())
    (takes / "faulty.c3d").write_bytes(b"no capture")
    script = tmp_path / "script.py"
    script.write_text(SCRIPT, encoding="utf-8")
    done = run_python(environment, script, takes, tmp_path)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout.splitlines()[-1]) == [0, 1, 1]
    assert done.stdout.startswith("?.c3d: ")
    assert "3 of 4 takes are done, 1 failed" in done.stdout
    records = [json.loads(path.read_text(encoding="utf-8")) for path in (tmp_path / "batch").rglob("*.record.json")]
    assert sorted((each["take"], each["reason"] or "") for each in records) == [
        ("b.c3d", ""),
        ("c.c3d", ""),
        ("faulty.c3d", "error"),
        ("日.c3d", ""),
    ]


def test_the_processes_of_that_test_lack_what_windows_lacks(environment: dict[str, str]) -> None:
    for code in ("import fcntl", "import os; os.fork()", "import importlib; importlib.import_module('pwd')"):
        done = run_python(environment, "-c", code)
        assert done.returncode == 1
        assert re.search("ModuleNotFoundError|AttributeError", done.stderr)
    code = "from mocapfix.io.files import get_system; print(get_system().name)"
    assert run_python(environment, "-c", code).stdout.strip() == "win32"


def test_the_product_asks_for_the_system_in_one_place() -> None:
    sources = {path.relative_to(PACKAGE).as_posix(): path.read_text(encoding="utf-8") for path in PACKAGE.rglob("*.py")}
    product = {name: text for name, text in sources.items() if not name.startswith("lab/")}
    assert [name for name, text in product.items() if PLATFORM.search(text)] == ["model/system.py"]
    assert not {name: found[0] for name, text in product.items() if (found := POSIX_ONLY.search(text))}

"""The interface of the review's server: who has access, what it answers, and what it does to the files."""

import http.client
import json
import re
import shutil
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.request
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mocapfix import pipeline
from mocapfix.errors import ReadError, WriteError
from mocapfix.io.capture import read_take
from mocapfix.io.changes_file import read_changes_file
from mocapfix.review.review_session import REVIEW_LOCK_NAME, ReviewSession
from mocapfix.review.server import ReviewServer
from mocapfix.review.take_files import find_cleaned_takes
from tests.review.conftest import RunningServer

RUN_DEPENDENT_SUFFIXES = (".rrd", ".report.json", ".report.html")
CLEANING_LIMIT_S = 120.0


def request(address: str, *, body: object = None, headers: dict[str, str] | None = None) -> tuple[int, bytes, dict[str, str]]:
    """Send a request, a POST if it has a body; return its status, its answer and the headers."""
    data = None if body is None else json.dumps(body).encode()
    sent = urllib.request.Request(address, data, ({"Content-Type": "application/json"} if data else {}) | (headers or {}))
    try:
        with urllib.request.urlopen(sent, timeout=30) as response:
            return response.status, response.read(), dict(response.headers)
    except urllib.error.HTTPError as error:
        return error.code, error.read(), dict(error.headers)


def fetch(running: RunningServer, path: str, body: object = None) -> Any:
    status, data, _ = request(f"{running.address}/api/{path}", body=body)
    assert status < 400, data
    return json.loads(data)


def edit(running: RunningServer, action: dict[str, Any], revision: str | None = None) -> Any:
    return fetch(running, "takes/walk/edit", {"revision": revision or fetch(running, "takes/walk")["revision"], "action": action})


def wait_for_run(running: RunningServer) -> dict[str, Any]:
    end = time.monotonic() + CLEANING_LIMIT_S
    while time.monotonic() < end:
        run = fetch(running, "takes/walk")["run"]
        if run["state"] != "running":
            return run
        time.sleep(0.1)
    raise AssertionError("the cleaning did not end")


def test_written_characters_are_listed_and_served(running: RunningServer) -> None:
    for name, suffix in (("hero", "glb"), ("my [x]", "vrm")):
        (running.folder / f"walk.{name}.{suffix}").write_bytes(suffix.encode())
        (running.folder / f"walk.{name}.map.yaml").touch()
    (running.folder / "walk.lost.map.yaml").touch()
    assert fetch(running, "takes/walk")["characters"] == ["hero", "my [x]"]
    address = f"{running.address}/api/takes/walk/characters?name="
    assert request(f"{address}hero")[:2] == (200, b"glb")
    assert request(f"{address}my%20%5Bx%5D")[:2] == (200, b"vrm")
    for name in ("lost", "..%2Fwalk", ""):
        assert request(address + name)[0] == 404


def test_page_and_assets_are_served_with_a_strict_policy(running: RunningServer) -> None:
    for path in ("/", "/assets/page.css", "/assets/main.js", "/assets/three.js"):
        status, data, headers = request(running.address + path)
        assert (status, bool(data)) == (200, True)
        assert "default-src 'none'" in headers["content-security-policy"]
    assert request(f"{running.address}/assets/../server.py")[0] == 404
    assert request(f"{running.address}/assets/nothing.js")[0] == 404


def test_assets_name_nothing_on_a_network() -> None:
    folder = Path(pipeline.__file__).parent / "review" / "page"
    texts = {path.name: path.read_text(encoding="utf-8") for path in folder.iterdir()}
    assert {"page.html", "page.css", "main.js"} <= set(texts)
    assert not [name for name, text in texts.items() if "http:" in text or "https:" in text or "innerHTML" in text]


@pytest.mark.parametrize(
    "headers",
    [
        {"Host": "example.com"},
        {"Host": "127.0.0.1"},
        {"Origin": "http://example.com"},
        {"Origin": "null"},
        {"Sec-Fetch-Site": "cross-site"},
        {"Sec-Fetch-Site": "same-site"},
    ],
)
def test_other_hosts_and_origins_are_refused(running: RunningServer, headers: dict[str, str]) -> None:
    for path, body in (("/", None), ("/api/session", None), ("/api/close", {})):
        assert request(running.address + path, body=body, headers=headers)[0] == 403
    assert request(f"{running.address}/api/session", headers={"Origin": f"http://127.0.0.1:{running.server.port}"})[0] == 200


def test_requests_without_the_token_are_refused(running: RunningServer) -> None:
    host, _, token = running.address.rpartition("/")
    other = token[:-1] + ("x" if token[-1] != "x" else "y")
    for path in ("/", "/api/session", f"/{other}/", f"/{token}x/api/session", f"/x{token}/", "/favicon.ico", f"//{token}/"):
        assert request(host + path)[0] == 403
    assert request(f"{host}/api/close", body={})[0] == 403
    assert request(f"{running.address}/api/close", body={}, headers={"Content-Type": "text/plain"})[0] == 403


def test_server_is_on_loopback_only(running: RunningServer) -> None:
    assert running.address.startswith(f"http://127.0.0.1:{running.server.port}/")
    with pytest.raises(WriteError, match=f"Port {running.server.port} cannot be used"):
        ReviewServer(running.session, running.server.port)


def test_samples_are_those_of_the_files(running: RunningServer) -> None:
    take = fetch(running, "takes/walk")
    before, after = (read_take(path) for path in (running.folder.parent / "walk.c3d", running.folder / "walk.c3d"))
    count, markers, joints = take["frame_count"], len(take["labels"]), len(take["joints"])
    data = request(f"{running.address}/api/takes/walk/samples?first=10&count={count}")[1]
    frames = count - 10
    sizes = [frames * markers * 3, frames * markers * 3, 0, frames * joints * 3, frames * markers]
    values = np.frombuffer(data[: 4 * sum(sizes)], "<f4")
    first, second, _, body, sd = np.split(values, np.cumsum(sizes)[:-1])
    np.testing.assert_array_equal(first.reshape(frames, markers, 3), before.markers[10:].astype("f4"))
    np.testing.assert_array_equal(second.reshape(frames, markers, 3), after.markers[10:].astype("f4"))
    states = np.frombuffer(data[4 * sum(sizes) :], np.uint8).reshape(frames, markers)
    is_filled = (~before.visible & after.visible)[10:]
    np.testing.assert_array_equal(states == 1, is_filled)
    assert np.isfinite(sd.reshape(frames, markers)[is_filled]).all()
    assert np.isnan(sd.reshape(frames, markers)[states == 0]).all()
    middle = np.nanmean(second.reshape(frames, markers, 3), axis=1)
    assert np.linalg.norm(body.reshape(frames, joints, 3).mean(1) - middle, axis=-1).max() < 0.3


def test_an_edit_of_an_old_revision_gets_the_new_state(running: RunningServer) -> None:
    """Two pages: the second decides on what it saw before the first decided."""
    old = fetch(running, "takes/walk")
    one, other = (change["id"] for change in old["changes"][:2])
    edit(running, {"type": "decide", "ids": [one], "decision": "reject"})
    late = {"revision": old["revision"], "action": {"type": "decide", "ids": [other], "decision": "keep"}}
    status, data, _ = request(f"{running.address}/api/takes/walk/edit", body=late)
    assert status == 409
    answer = json.loads(data)
    decisions = {change["id"]: change["decision"] for change in answer["take"]["changes"]}
    assert (decisions[one], decisions[other]) == ("reject", "accept")
    assert "was changed by another page" in answer["error"]


def test_pages_receive_each_others_edits(running: RunningServer) -> None:
    events: list[dict[str, Any]] = []
    remove = running.session.add_listener(events.append)
    change = fetch(running, "takes/walk")["changes"][0]["id"]
    revision = edit(running, {"type": "note", "id": change, "text": "<script>"})["revision"]
    remove()
    assert events == [{"type": "edited", "take": "walk", "revision": revision}]


def test_edits_at_the_same_time_are_all_in_the_file_or_refused(running: RunningServer) -> None:
    take = fetch(running, "takes/walk")
    ids = [change["id"] for change in take["changes"]][:6]

    def decide(name: str) -> int:
        body = {"revision": take["revision"], "action": {"type": "decide", "ids": [name], "decision": "reject"}}
        return request(f"{running.address}/api/takes/walk/edit", body=body)[0]

    with ThreadPoolExecutor(len(ids)) as pool:
        statuses = list(pool.map(decide, ids))
    assert sorted(statuses) == [200, *[409] * (len(ids) - 1)]
    rejected = [change["id"] for change in fetch(running, "takes/walk")["changes"] if change["decision"] == "reject"]
    assert rejected == [name for name, status in zip(ids, statuses, strict=True) if status == 200]


@pytest.mark.parametrize(
    "body",
    [
        {},
        {"revision": 1, "action": {}},
        {"revision": "x", "action": []},
        {"revision": "x", "action": {"type": "decide", "ids": "all", "decision": "reject"}},
        {"revision": "x", "action": {"type": "decide", "ids": [], "decision": "maybe"}},
        {
            "revision": "x",
            "action": {"type": "add", "corrections": [{"kind": "wrong", "markers": ["NO"], "first": 1, "last": 2}]},
        },
        {"revision": "x", "action": {"type": "remove", "index": 7}},
        [],
        "text",
    ],
)
def test_wrong_edits_get_a_sentence_and_change_nothing(running: RunningServer, body: object) -> None:
    path = running.folder / "walk.changes.yaml"
    before = path.read_bytes()
    status, data, _ = request(f"{running.address}/api/takes/walk/edit", body=body)
    assert 400 <= status < 500
    assert json.loads(data)["error"].endswith(".")
    assert path.read_bytes() == before


def test_a_decision_has_the_name_of_the_reviewer(running: RunningServer) -> None:
    running.session.reviewer = "Ann"
    ids = [each["id"] for each in fetch(running, "takes/walk")["changes"][:2]]
    edit(running, {"type": "decide", "ids": ids[:1], "decision": "accept", "reviewer": "somebody else"})
    running.session.reviewer = ""
    edit(running, {"type": "decide", "ids": ids[1:], "decision": "reject"})
    shown = {each["id"]: each["reviewer"] for each in fetch(running, "takes/walk")["changes"]}
    assert [shown[name] for name in ids] == ["Ann", ""]
    text = (running.folder / "walk.changes.yaml").read_text(encoding="utf-8")
    assert text.count("  reviewer: Ann\n") == text.count("reviewer:") == 1


def test_takes_that_are_not_there_are_refused(running: RunningServer) -> None:
    for path in ("takes/run", "takes/../walk", "takes/run/samples?first=0&count=1", "takes/walk/samples?first=x&count=1"):
        assert request(f"{running.address}/api/{path}")[0] in (404, 422)


def test_cleaning_again_writes_what_the_command_line_writes(running: RunningServer) -> None:
    take = fetch(running, "takes/walk")
    one, other = (change for change in take["changes"] if change["kind"] == "gap" and change["samples"] > 5), None
    rejected = next(one)
    edit(running, {"type": "decide", "ids": [rejected["id"]], "decision": "reject"})
    other = take["labels"][0]
    frames = {"first": take["first_frame"] + 20, "last": take["first_frame"] + 29}
    edit(running, {"type": "add", "corrections": [{"kind": "wrong", "markers": [other], **frames}]})
    expected = running.folder.parent / "expected"
    shutil.copytree(running.folder, expected)
    command = ["clean", str(running.folder.parent / "walk.c3d"), "--prior", "none", "--out", str(expected), "--overwrite"]
    command += ["--changes", str(expected / "walk.changes.yaml"), "--also", "gltf"]
    subprocess.run([sys.executable, "-m", "mocapfix", *command], check=True, stdout=subprocess.DEVNULL)
    assert fetch(running, "takes/walk/clean", {"extra_formats": "gltf"})["state"] == "running"
    status, data, _ = request(
        f"{running.address}/api/takes/walk/approve",
        body={"name": "Ann"},
    )
    assert (status, b"is being cleaned" in data) == (423, True)
    assert wait_for_run(running) == {"state": "done", "stage": "", "percent": 0, "message": ""}
    again = fetch(running, "takes/walk")
    assert again["export"]["written"] == {"extra_formats": ["gltf"], "rigs": [], "characters": []}
    assert {each["label"] for each in again["difference"]["markers"]} >= {*rejected["markers"], other}
    names = {path.name for path in expected.iterdir()} - {".review.lock"}
    assert {path.name for path in running.folder.iterdir()} - {".review.lock"} == names
    compared = [name for name in names if not name.endswith(RUN_DEPENDENT_SUFFIXES)]
    assert {"walk.c3d", "walk.bvh", "walk.glb", "walk.changes.yaml"} <= set(compared)
    for name in compared:
        assert (running.folder / name).read_bytes() == (expected / name).read_bytes(), name


def test_decisions_made_during_a_cleaning_are_in_its_outputs(running: RunningServer) -> None:
    one, other, *_ = (change for change in fetch(running, "takes/walk")["changes"] if change["kind"] == "gap")
    fetch(running, "takes/walk/clean", {})
    edit(running, {"type": "decide", "ids": [one["id"]], "decision": "reject"})
    edit(running, {"type": "note", "id": other["id"], "text": "ask Ann"})
    assert wait_for_run(running)["state"] == "done"
    changes = {change["id"]: change for change in fetch(running, "takes/walk")["changes"]}
    assert [(changes[each["id"]]["decision"], changes[each["id"]]["note"]) for each in (one, other)] == [
        ("reject", ""),
        ("accept", "ask Ann"),
    ]
    assert sum(change["is_reviewed"] for change in changes.values()) == 1


def test_a_failed_cleaning_leaves_the_outputs_and_gives_its_sentence(running: RunningServer) -> None:
    (running.folder.parent / "walk.c3d").write_bytes(b"no capture")
    fetch(running, "session")
    outputs = {path.name: path.read_bytes() for path in running.folder.iterdir() if path.name != ".review.lock"}
    request(f"{running.address}/api/takes/walk/clean", body={})
    status, data, _ = request(f"{running.address}/api/takes/walk")
    if status == 200:  # the input was read before it was damaged
        run = wait_for_run(running)
        assert run["state"] == "failed"
        assert "walk.c3d" in run["message"]
    else:
        assert "walk.c3d" in json.loads(data)["error"]
    left = {path.name: path.read_bytes() for path in running.folder.iterdir() if path.name != ".review.lock"}
    assert left == outputs


def test_a_cleaning_that_cannot_start_leaves_the_take_open(running: RunningServer, monkeypatch: pytest.MonkeyPatch) -> None:
    change = fetch(running, "takes/walk")["changes"][0]["id"]

    def fail(*_arguments: object, **_options: object) -> None:
        raise PermissionError(13, "Permission denied")

    with monkeypatch.context() as patch:
        patch.setattr(subprocess, "Popen", fail)
        status, data, _ = request(f"{running.address}/api/takes/walk/clean", body={})
    sentence = " cannot be cleaned: its process cannot be started (Permission denied); try again."
    assert (status, json.loads(data)["error"].endswith(sentence)) == (423, True)
    assert fetch(running, "takes/walk")["run"]["state"] == "idle"
    assert edit(running, {"type": "decide", "ids": [change], "decision": "accept"})["state"] == "in review"


def test_approval_has_name_and_date_and_ends_with_the_next_edit(running: RunningServer) -> None:
    change = fetch(running, "takes/walk")["changes"][0]["id"]
    assert fetch(running, "session")["takes"][0]["state"] == "untouched"
    assert request(f"{running.address}/api/takes/walk/approve", body={"name": "  "})[0] == 422
    approved = fetch(running, "takes/walk/approve", {"name": "Ann <b>"})
    assert (approved["state"], approved["approval"]["name"]) == ("approved", "Ann <b>")
    (entry,) = fetch(running, "session")["takes"]
    assert (entry["state"], entry["approved_by"]) == ("approved", "Ann <b>")
    assert edit(running, {"type": "decide", "ids": [change], "decision": "accept"})["state"] == "in review"
    assert fetch(running, "takes/walk/approve", {"name": None}) == {"approval": None, "state": "in review"}
    assert not (running.folder / "walk.approval.json").exists()


def test_damaged_outputs_get_a_sentence(running: RunningServer) -> None:
    (running.folder / "walk.changes.yaml").write_text("changes: 3", encoding="utf-8")
    status, data, _ = request(f"{running.address}/api/takes/walk")
    assert (status, "walk.changes.yaml" in json.loads(data)["error"]) == (422, True)
    assert "walk.changes.yaml" in fetch(running, "session")["takes"][0]["error"]
    assert (running.folder / "walk.changes.yaml").read_text(encoding="utf-8") == "changes: 3"


def test_large_session_is_listed_at_once_and_read_in_the_background(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("mocapfix.review.review_session.MAX_TAKES_READ_AT_ONCE", 2)
    root = folder.parent
    for n in range(4):
        shutil.copytree(folder, root / f"take{n}")
    events: list[dict[str, Any]] = []
    session = ReviewSession(root)
    session.add_listener(events.append)
    assert [each["state"] for each in session.describe()["takes"]] == [""] * 5
    threading.Thread(target=session.read_ahead, daemon=True).start()
    end = time.monotonic() + 30.0
    while "untouched" not in {each["state"] for each in session.describe()["takes"][-1:]} and time.monotonic() < end:
        time.sleep(0.05)
    assert {each["state"] for each in session.describe()["takes"]} == {"untouched"}
    session.approve("take2/walk", "Ann")
    states = {each["id"]: each["state"] for each in session.describe()["takes"]}
    assert states == dict.fromkeys(states, "untouched") | {"take2/walk": "approved"}


def test_the_take_of_the_first_page_is_read_ahead(folder: Path) -> None:
    for name in ("first", "second"):
        shutil.copytree(folder, folder.parent / name)
    changes = folder.parent / "second" / "walk.changes.yaml"
    changes.write_text(re.sub(r"predicted_mm: [\d.]+", "predicted_mm: 999.0", changes.read_text("utf-8"), count=1), "utf-8")
    session = ReviewSession(folder.parent)
    session.read_ahead()
    assert [name for name in ("first", "second") if (folder.parent / name / REVIEW_LOCK_NAME).exists()] == ["second"]
    session.close()
    with pytest.raises(ReadError):
        session.open_take("first/walk")


def test_folder_without_takes_is_refused(tmp_path: Path) -> None:
    for folder in (tmp_path, tmp_path / "nothing"):
        with pytest.raises(ReadError, match="name the output folder"):
            find_cleaned_takes(folder)
    (tmp_path / "walk.report.json").write_text("{}", encoding="utf-8")
    with pytest.raises(ReadError, match=r"walk\.report\.json: is damaged"):
        ReviewSession(tmp_path)


def test_server_ends_when_a_page_asks_for_it(folder: Path) -> None:
    server = ReviewServer(ReviewSession(folder))
    thread = threading.Thread(target=server.serve, daemon=True)
    thread.start()
    assert request(f"{server.address}api/close", body={})[0] == 200
    thread.join(10.0)
    assert not thread.is_alive()


def test_server_ends_when_the_last_page_is_closed(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("mocapfix.review.server.PAGE_CLOSED_LIMIT_S", 0.5)
    monkeypatch.setattr("mocapfix.review.server.KEEP_ALIVE_S", 0.2)
    server = ReviewServer(ReviewSession(folder))
    thread = threading.Thread(target=server.serve, daemon=True)
    thread.start()
    with urllib.request.urlopen(f"{server.address}api/events", timeout=30) as stream:
        assert stream.readline() == b": open\n"
        thread.join(1.5)
        assert thread.is_alive()
    thread.join(20.0)
    assert not thread.is_alive()


def test_killed_server_leaves_a_file_that_can_be_read(folder: Path) -> None:
    """Killed while decisions arrive one after the other: each that was confirmed is in the file."""
    command = [sys.executable, "-m", "mocapfix", "review", str(folder), "--no-browser"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout
        address = process.stdout.readline().split(": ", 1)[1].strip()
        take = json.loads(request(f"{address}api/takes/walk")[1])
        revision, confirmed = take["revision"], list[str]()
        killer = threading.Timer(0.3, process.kill)
        killer.start()
        try:
            for change in take["changes"] * 50:
                decision = "reject" if change["id"] not in confirmed else "keep"
                action = {"type": "decide", "ids": [change["id"]], "decision": decision}
                status, data, _ = request(f"{address}api/takes/walk/edit", body={"revision": revision, "action": action})
                assert status == 200
                revision = json.loads(data)["revision"]
                confirmed.append(change["id"])
        except (OSError, http.client.HTTPException):  # killed before an answer, or in the middle of it
            pass
        process.wait()
    capture = read_take(folder.parent / "walk.c3d")
    declined = {each.entry.id for each in read_changes_file(folder / "walk.changes.yaml", capture).declined}
    assert set(confirmed) <= declined
    assert len(declined) <= len(set(confirmed)) + 1


def test_review_of_a_take_opens_a_preview_and_cleans_it_in_full(folder: Path) -> None:
    shutil.rmtree(folder)
    command = [sys.executable, "-m", "mocapfix", "review", "--no-browser"]
    (folder.parent / "bad.c3d").write_bytes(b"no capture")
    bad = subprocess.run([*command, str(folder.parent / "bad.c3d")], capture_output=True, text=True, check=False, timeout=60)
    assert (bad.returncode, bad.stdout) == (1, "")
    assert "bad.c3d: has no format that mocapfix reads" in bad.stderr
    with subprocess.Popen([*command, str(folder.parent / "walk.c3d")], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout
        address = process.stdout.readline().split(": ", 1)[1].strip()
        take = json.loads(request(f"{address}api/takes/walk")[1])
        assert (take["is_preview"], take["run"]["state"]) == (True, "running")
        request(f"{address}api/close", body={})
        process.wait(30)
    assert (folder / "walk.changes.yaml").is_file()


def test_take_is_reviewed_by_one_process(folder: Path) -> None:
    """A review of the folder above is refused the take that another one has open."""
    session = ReviewSession(folder)
    session.open_take("walk")
    above = ReviewSession(folder.parent)
    with pytest.raises(WriteError, match="is being reviewed or cleaned by another process"):
        above.open_take("walk.mocapfix/walk")
    session.close()
    above.open_take("walk.mocapfix/walk")
    above.close()


def test_second_review_of_a_folder_is_refused_and_status_lists_it(folder: Path) -> None:
    command = [sys.executable, "-m", "mocapfix"]
    with subprocess.Popen([*command, "review", str(folder), "--no-browser"], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout
        process.stdout.readline()
        second = subprocess.run(
            [*command, "review", str(folder), "--no-browser"], capture_output=True, text=True, check=False, timeout=60
        )
        assert (second.returncode, f"process {process.pid}" in second.stderr) == (1, True)
        process.terminate()
        assert process.wait(20) in (0, 1)
    listed = subprocess.run([*command, "status", str(folder), "--json"], capture_output=True, text=True, check=True)
    assert [each["state"] for each in json.loads(listed.stdout)] == ["untouched"]

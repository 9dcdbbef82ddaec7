"""The list of kernels that are compiled first, and the processes that share the work."""

import os
import subprocess
import sys
import threading

import pytest
from numba import types

from mocapfix.kernels import precompilation
from mocapfix.kernels.forward_kinematics import KinematicTree
from mocapfix.kernels.precompilation import (
    CompilationSchedule,
    KernelSignature,
    describe_type,
    find_kernel,
    parse_type,
    precompile_kernels,
    read_signatures,
)

DEMO_CODE = """
import sys
from pathlib import Path
from numba.core.dispatcher import Dispatcher
from mocapfix import pipeline, synthetic
from mocapfix.kernels.precompilation import find_kernel, read_signatures

take = Path(sys.argv[1]) / "demo.c3d"
synthetic.write_synthetic_take(take, synthetic.compose_take(seed=0, seconds=4))
pipeline.clean(take).write(take.with_suffix(".mocapfix"))
listed = {(find_kernel(each.name), each.arguments) for each in read_signatures()}
for name, module in list(sys.modules.items()):
    if name.startswith("mocapfix.kernels."):
        for kernel in vars(module).values():
            if isinstance(kernel, Dispatcher) and kernel.py_func.__module__ == name:
                for arguments in kernel.overloads:
                    if (kernel, arguments) not in listed and not kernel.targetoptions.get("no_cpython_wrapper"):
                        print(name, kernel.py_func.__name__, arguments)
"""
TREE_TYPE = types.BaseTuple.from_types(
    tuple(types.Array(types.float64, dimensions, "C") for dimensions in range(1, len(KinematicTree._fields) + 1)), KinematicTree
)


@pytest.mark.parametrize(
    "described",
    [
        types.int64,
        types.boolean,
        types.none,
        types.Array(types.float32, 4, "A"),
        types.Array(types.uint8, 1, "C", readonly=True),
        types.UniTuple(types.Array(types.float64, 2, "C"), 3),
        types.Tuple((types.int64, TREE_TYPE)),
    ],
    ids=str,
)
def test_descriptions_of_types_are_read_as_they_were(described):
    shared = {}
    description = describe_type(described, shared)
    parsed = []
    for _, each in sorted(shared.values(), key=lambda entry: entry[0]):
        parsed.append(parse_type(each, parsed))
    assert parse_type(description, parsed) == described


def test_listed_kernels_exist_and_none_calls_itself():
    listed = read_signatures()
    assert listed
    for index, each in enumerate(listed):
        assert len(each.arguments) == find_kernel(each.name).py_func.__code__.co_argcount
        assert index not in each.callees
        assert all(set(listed[callee].callees) < set(each.callees) for callee in each.callees)


def test_the_list_has_every_kernel_that_the_demo_calls(tmp_path):
    """If it has not, docs/generate_kernel_signatures.py must be run."""
    done = subprocess.run([sys.executable, "-c", DEMO_CODE, str(tmp_path)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout == ""


def test_no_kernel_is_taken_before_those_that_it_calls_are_finished():
    chain = [KernelSignature(str(n), (), tuple(range(n))) for n in range(3)] + [KernelSignature("alone", (), ())]
    counts = []
    schedule = CompilationSchedule(chain, lambda done, total: counts.append((done, total)))
    assert [schedule.take(), schedule.take()] == [0, 3]
    waiting = threading.Thread(target=lambda: schedule.finish(schedule.take() or 0))
    waiting.start()
    schedule.finish(3)
    assert waiting.is_alive()
    schedule.finish(0)
    waiting.join()
    assert schedule.take() == 2
    assert schedule.take() is None
    assert counts == [(1, 4), (2, 4), (3, 4)]


@pytest.fixture
def short_list(monkeypatch):
    """Only the smallest kernels of the list."""
    listed = read_signatures()
    small = [each._replace(callees=()) for each in listed if each.name == "rigid_registration.transform_point_frames"]
    monkeypatch.setattr(precompilation, "read_signatures", lambda: small)
    return small


def test_kernels_are_compiled_once(short_list, tmp_path, monkeypatch):
    monkeypatch.setattr(precompilation, "find_cache_folder", lambda: tmp_path)
    assert not precompilation.is_precompiled()
    counts = []
    precompile_kernels(lambda done, total: counts.append((done, total)), processes=1)
    assert counts == [(1, 1)]
    assert precompilation.is_precompiled()
    monkeypatch.setattr(precompilation, "compute_kernels_digest", lambda: "of-other-sources")
    assert not precompilation.is_precompiled()
    precompile_kernels(lambda done, total: None, processes=1)
    assert len(list(tmp_path.iterdir())) == 1


def test_work_is_done_where_no_process_can_be_started(short_list, tmp_path, monkeypatch):
    monkeypatch.setattr(precompilation, "find_cache_folder", lambda: tmp_path)
    monkeypatch.setattr(sys, "executable", str(tmp_path / "no-interpreter"))
    precompile_kernels(lambda done, total: None, processes=3)
    assert precompilation.is_precompiled()


def test_a_worker_compiles_what_it_is_sent(tmp_path):
    name = "rigid_registration.transform_point_frames"
    index = next(n for n, each in enumerate(read_signatures()) if each.name == name)
    done = subprocess.run(
        [sys.executable, "-c", precompilation.WORKER_CODE],
        input=f"{index}\n",
        capture_output=True,
        text=True,
        check=True,
        env={**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)},
    )
    assert done.stdout == f"ready\n{index}\n"
    assert [path.name.partition("-")[0] for path in tmp_path.rglob("*.nbi")] == [name]
    assert precompilation.read_signatures() == read_signatures()

"""Where compiled kernels are kept, that what is out of date is neither used nor left behind, and what is compiled first."""

import inspect
import os
import runpy
import shutil
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest
from numba import types

from mocapfix.kernels import compilation
from mocapfix.kernels.compilation import (
    KERNELS_FOLDER,
    PACKAGE_FOLDER,
    compile_inner_kernel,
    find_kernel,
    group_kernels,
    list_named_tuple_files,
    parse_type,
    precompile_kernels,
    read_kernel_list,
)
from mocapfix.kernels.forward_kinematics import KinematicTree
from mocapfix.model import system

KERNEL_SOURCES = {
    "stats/pairs.py": """
        from typing import NamedTuple

        class Pair(NamedTuple):
            a: float
            b: float
        """,
    "kernels/inner.py": """
        from mocapfix.kernels.compilation import compile_inner_kernel

        @compile_inner_kernel
        def add(pair):
            return pair.a + pair.b
        """,
    "kernels/outer.py": """
        from mocapfix.kernels.compilation import compile_kernel
        from mocapfix.kernels.inner import add

        @compile_kernel
        def add_twice(pair):
            return add(pair) + add(pair)
        """,
    "kernels/kernel_signatures.json": """{"types": [{"stats.pairs.Pair": ["float64", "float64"]}], "kernels": []}""",
    "model/motion.py": "",
    "kernels/__init__.py": "",
    "__init__.py": "",
}
RUN_CODE = """
from mocapfix.kernels.outer import add_twice
from mocapfix.stats.pairs import Pair
print(add_twice(Pair(1.0, 2.0)), sum(add_twice.stats.cache_hits.values()))
"""
LATER_KERNEL_CODE = """
from numba import njit
from mocapfix.kernels.outer import add_twice
from mocapfix.stats.pairs import Pair
add_four_times = njit(lambda pair: add_twice(pair) + add_twice(pair))
print(add_twice(Pair(1.0, 2.0)), add_four_times(Pair(1.0, 2.0)), sum(add_twice.stats.cache_hits.values()))
"""
DEMO_CODE = """
import sys
from pathlib import Path
from mocapfix import pipeline, synthetic
from mocapfix.io.c3d import write_c3d
from mocapfix.kernels.compilation import read_kernel_list
from mocapfix.lab.hands import compose_hands
from mocapfix.model.windows import select_frames

take, fingers = Path(sys.argv[1]) / "demo.c3d", Path(sys.argv[1]) / "fingers.c3d"
synthetic.write_synthetic_take(take, synthetic.compose_take(seed=0, seconds=4))
write_c3d(fingers, select_frames(compose_hands(seed=0).take, slice(0, 400)))
for each in (take, fingers):
    pipeline.clean(each).write(each.with_suffix(".mocapfix"))
listed = {(name, arguments) for name, each in read_kernel_list().items() for arguments in each}
for name, module in list(sys.modules.items()):
    if name.startswith("mocapfix.kernels."):
        for kernel in vars(module).values():
            if hasattr(kernel, "py_func") and kernel.py_func.__module__ == name:
                for arguments in kernel.signatures:
                    full_name = f"{name}.{kernel.py_func.__name__}".removeprefix("mocapfix.kernels.")
                    if (full_name, arguments) not in listed:
                        print(full_name, arguments)
"""


@pytest.fixture
def package(tmp_path: Path) -> Path:
    """A package named mocapfix with two modules of kernels, one of which calls the other's, and the present cache."""
    folder = tmp_path / "mocapfix"
    for name, source in KERNEL_SOURCES.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(textwrap.dedent(source), encoding="utf-8")
    shutil.copy(inspect.getfile(compilation), folder / "kernels")
    shutil.copy(inspect.getfile(system), folder / "model")
    return folder


def start_run(package: Path, code: str = RUN_CODE, **environment: str) -> "subprocess.Popen[str]":
    """Start a process that calls the outer kernel, or runs other code."""
    cleared = {name: value for name, value in os.environ.items() if name != "NUMBA_CACHE_DIR"}
    return subprocess.Popen(
        [sys.executable, "-c", code],
        env={**cleared, "PYTHONPATH": str(package.parent), **environment},
        cwd=package.parent,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def run(package: Path, **environment: str) -> tuple[float, int]:
    """Call the outer kernel in a process of its own; return the result, and how often the cache had it."""
    process = start_run(package, **environment)
    output, errors = process.communicate()
    assert process.returncode == 0, errors
    result, hits = output.split()
    return float(result), int(hits)


def list_cache_folders(package: Path) -> list[Path]:
    return list((package / "kernels" / "__pycache__").glob("compiled-*"))


def test_a_changed_callee_or_named_tuple_is_compiled_again_with_its_callers_and_the_old_files_are_removed(package: Path) -> None:
    assert run(package) == (6.0, 0)
    assert run(package) == (6.0, 1)
    folders = list_cache_folders(package)
    inner, pairs = package / "kernels" / "inner.py", package / "stats" / "pairs.py"
    inner.write_text(inner.read_text(encoding="utf-8").replace("pair.a + pair.b", "pair.a - pair.b"), encoding="utf-8")
    assert run(package) == (-2.0, 0)
    folders += list_cache_folders(package)
    pairs.write_text(
        pairs.read_text(encoding="utf-8").replace("a: float\n    b: float", "b: float\n    a: float"), encoding="utf-8"
    )
    assert run(package) == (2.0, 0)
    folders += list_cache_folders(package)
    assert len(set(folders)) == len(folders) == 3


def test_a_kernel_from_the_cache_is_linked_with_one_that_is_compiled_later(package: Path) -> None:
    assert run(package) == (6.0, 0)
    output, errors = start_run(package, LATER_KERNEL_CODE).communicate()
    assert output.split() == ["6.0", "12.0", "1"], errors


def test_a_missing_source_is_an_error(package: Path) -> None:
    (package / "model" / "motion.py").unlink()
    process = start_run(package)
    assert "motion.py" in process.communicate()[1]
    assert process.returncode != 0


def test_a_read_only_package_uses_the_folder_of_the_user(package: Path, tmp_path: Path) -> None:
    (package / "kernels" / "__pycache__").write_bytes(b"")  # a file where the folder would be
    caches = {"XDG_CACHE_HOME": str(tmp_path / "user"), "LOCALAPPDATA": str(tmp_path / "user"), "HOME": str(tmp_path / "home")}
    assert run(package, **caches) == (6.0, 0)
    assert run(package, **caches) == (6.0, 1)


def test_kernels_work_where_nothing_can_be_written(package: Path, tmp_path: Path) -> None:
    (package / "kernels" / "__pycache__").write_bytes(b"")
    blocked = tmp_path / "blocked"
    blocked.write_bytes(b"")
    names = ("XDG_CACHE_HOME", "LOCALAPPDATA", "HOME", "NUMBA_CACHE_DIR")
    (package / "__init__.py").write_text(f"import tempfile; tempfile.gettempdir = lambda: {str(blocked)!r}\n", encoding="utf-8")
    assert run(package, **dict.fromkeys(names, str(blocked))) == (6.0, 0)


def test_the_folder_of_numba_cache_dir_is_used(package: Path, tmp_path: Path) -> None:
    assert run(package, NUMBA_CACHE_DIR=str(tmp_path / "cache")) == (6.0, 0)
    assert run(package, NUMBA_CACHE_DIR=str(tmp_path / "cache")) == (6.0, 1)
    assert list_cache_folders(package) == []


def test_the_module_that_runs_as_a_command_uses_the_same_folder() -> None:
    assert runpy.run_path(inspect.getfile(compilation))["CACHE_FOLDER"] == compilation.CACHE_FOLDER


def test_processes_may_start_at_once(package: Path) -> None:
    processes = [start_run(package) for _ in range(2)]
    assert [process.communicate()[0].split()[0] for process in processes] == ["6.0", "6.0"]
    assert run(package) == (6.0, 1)


def test_the_digest_covers_what_the_kernels_import() -> None:
    kernels = [path for path in KERNELS_FOLDER.rglob("*.py") if path.name != "compilation.py"]
    imported = [line for path in kernels for line in path.read_text(encoding="utf-8").splitlines()]
    others = {line.split()[1] for line in imported if line.startswith("from mocapfix.") and ".kernels" not in line}
    assert others == {"mocapfix.model.motion"}


def test_the_digest_covers_the_named_tuples_of_other_folders() -> None:
    files = {file.relative_to(PACKAGE_FOLDER).as_posix() for file in list_named_tuple_files()}
    others = {file for file in files if not file.startswith("kernels/")}
    assert others == {"solve/parallel.py", "stats/marker_distances.py"}


def test_inner_kernels_can_be_called_from_python() -> None:
    @compile_inner_kernel
    def double(x: float) -> float:
        return 2 * x

    assert [double(1), double(1.5)] == [2, 3.0]


def test_descriptions_of_types() -> None:
    tree = {"kernels.forward_kinematics.KinematicTree": ["float64[1C]"] * len(KinematicTree._fields)}
    fields = (types.Array(types.float64, 1, "C"),) * len(KinematicTree._fields)
    tree_type = types.BaseTuple.from_types(fields, KinematicTree)
    assert parse_type("none", []) == types.none
    assert parse_type("uint8[1C] readonly", []) == types.Array(types.uint8, 1, "C", readonly=True)
    assert parse_type(["int64", tree], []) == types.BaseTuple.from_types((types.int64, tree_type))
    assert parse_type("$0", [tree_type]) == tree_type


def test_listed_kernels_exist() -> None:
    kernels = read_kernel_list()
    assert kernels
    for name, each in kernels.items():
        assert {len(arguments) for arguments in each} == {find_kernel(name).py_func.__code__.co_argcount}


def test_of_two_processes_one_compiles_all_that_call_the_solver() -> None:
    kernels = list(read_kernel_list())
    groups = group_kernels(kernels, processes=2)
    assert sorted(name for group in groups for name in group) == sorted(kernels)
    levenberg_marquardt = {"levenberg_marquardt.solve_frames", "levenberg_marquardt.compute_cost_frames"}
    solver = levenberg_marquardt | {"schur.sum_pose_responses", "covariance.compute_uncertainty_frames"}
    assert [set(group) for group in groups if "levenberg_marquardt.solve_frames" in group] == [solver]
    assert group_kernels(kernels, processes=3) == [[name] for name in kernels]


def test_the_list_has_every_kernel_that_the_demo_and_hands_call(tmp_path: Path) -> None:
    """If it has not, docs/generate_kernel_signatures.py must be run."""
    done = subprocess.run([sys.executable, "-c", DEMO_CODE, str(tmp_path)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout == ""


@pytest.fixture
def short_list(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Only the smallest kernel of the list, and no kernels compiled."""
    name = "rigid_registration.transform_point_frames"
    small = {name: read_kernel_list()[name]}
    monkeypatch.setattr(compilation, "read_kernel_list", lambda: small)
    monkeypatch.setattr(compilation, "CACHE_FOLDER", tmp_path)


def test_listed_kernels_are_compiled_once(short_list: None) -> None:
    assert not compilation.is_precompiled()
    counts: list[tuple[int, int]] = []
    for _ in range(2):
        precompile_kernels(lambda done, total: counts.append((done, total)), processes=1)
    assert counts == [(1, 1)]
    assert compilation.is_precompiled()


def test_kernels_are_compiled_where_no_process_can_be_started(
    short_list: None, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def fail(*_arguments: object) -> None:
        raise FileNotFoundError

    monkeypatch.setattr(compilation, "_compile_in_processes", fail)
    precompile_kernels(lambda done, total: None)
    assert compilation.is_precompiled()

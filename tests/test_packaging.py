"""The installed package: built from the sdist, installed outside the checkout, run in another folder."""

import hashlib
import os
import shutil
import subprocess
import sys
import sysconfig
import tarfile
import venv
import zipfile
from pathlib import Path

import pytest

from mocapfix.cli.app import LAB_PACKAGES
from mocapfix.kernels.compilation import CACHE_FOLDER
from mocapfix.synthetic import compose_take, write_synthetic_take

CHECKOUT = Path(__file__).resolve().parents[1]
LAB_DATA = {"bench", "mnn-ik"}
"""the folder and the weights that only benchmarks read, which are not installed"""


def run_command(*command: str | Path, folder: Path) -> str:
    """Return the output of a command that must succeed, run in `folder` without the checkout on the path."""
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, encoding="utf-8", check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Build the sdist, and from it the wheel; return their paths."""
    folder = tmp_path_factory.mktemp("dist")
    run_command(sys.executable, "-m", "build", "--no-isolation", "--outdir", folder, CHECKOUT, folder=folder)
    return next(folder.glob("*.tar.gz")), next(folder.glob("*.whl"))


def copy_compiled_kernels(kernels: Path) -> None:
    """Copy the checkout's compiled kernels to another installation, where Numba names its folders after the modules' folders."""
    assert CACHE_FOLDER
    for path in [each for each in CACHE_FOLDER.rglob("*") if each.is_file()]:
        source = kernels / "terms" if path.parent.name.startswith("terms_") else kernels
        name = f"{source.name}_{hashlib.sha1(str(source).encode(), usedforsecurity=False).hexdigest()}"
        target = kernels / "__pycache__" / CACHE_FOLDER.name / (name if path.parent != CACHE_FOLDER else "") / path.name
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(path, target)


@pytest.fixture(scope="module")
def scripts(built: tuple[Path, Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the scripts folder of a new environment that contains the wheel and the libraries of the running environment.

    The libraries come from a .pth file. Python does not process .pth files in the folders that it names, so that an editable
    install of the checkout is not imported. What only the extra `train` installs is hidden. The checkout's compiled kernels are
    those of the wheel's sources too: compiling them again would take most of the test's time.
    """
    base = tmp_path_factory.mktemp("environment")
    venv.create(base, symlinks=os.name != "nt")
    paths = sysconfig.get_paths("venv", vars={name: str(base) for name in ("base", "platbase", "installed_base")})
    run_command(sys.executable, "-m", "pip", "--python", base, "install", "--no-deps", "--no-index", built[1], folder=base)
    for name in LAB_PACKAGES:
        text = f"raise ModuleNotFoundError('not installed', name={name!r})"
        (Path(paths["purelib"]) / f"{name}.py").write_text(text, encoding="utf-8")
    (Path(paths["purelib"]) / "libraries.pth").write_text(sysconfig.get_path("purelib"), encoding="utf-8")
    copy_compiled_kernels(Path(paths["purelib"]) / "mocapfix" / "kernels")
    return Path(paths["scripts"])


def test_wheel_contains_the_data_that_a_clean_reads_inside_the_package(built: tuple[Path, Path]):
    names = set(zipfile.ZipFile(built[1]).namelist())
    assert {name.split("/")[0] for name in names} == {"mocapfix", "mocapfix-0.1.0.dist-info"}
    files = (path.relative_to(CHECKOUT) for folder in ("scenes", "priors") for path in (CHECKOUT / folder).rglob("*"))
    needed = {f"mocapfix/{path.as_posix()}" for path in files if path.suffix and not LAB_DATA & {path.stem, path.parent.name}}
    assert {"mocapfix/scenes/marker-sets/cmu41.yaml", "mocapfix/priors/autoencoder.safetensors"} <= needed
    code = {f"mocapfix/{path.relative_to(CHECKOUT / 'mocapfix').as_posix()}" for path in (CHECKOUT / "mocapfix").rglob("*.py")}
    data = {name for name in names if not name.startswith("mocapfix-0.1.0") and name not in code}
    assert "mocapfix/py.typed" in data
    assert {name for name in data if name.startswith(("mocapfix/scenes/", "mocapfix/priors/"))} == needed
    assert code <= names


def test_sdist_is_complete(built: tuple[Path, Path]):
    with tarfile.open(built[0]) as archive:
        names = {name.split("/", 1)[1] for name in archive.getnames()}
    assert {"LICENSE", "CHANGELOG.md", "Makefile", "constraints.txt", "tests/test_packaging.py"} <= names
    assert not any(name.startswith((".venv", "shared")) for name in names)


def test_installed_package_finds_its_files(scripts: Path, tmp_path: Path):
    code = "import mocapfix; from mocapfix.io.shipped import find_shipped_folder as find; "
    code += "print(mocapfix.__file__, find('scenes'), find('priors'), sep='\\n')"
    module, scenes, priors = run_command(scripts / "python", "-c", code, folder=tmp_path).splitlines()
    package = Path(module).parent
    assert package.is_relative_to(scripts.parent)
    assert (Path(scenes), Path(priors)) == (package / "scenes", package / "priors")


@pytest.mark.parametrize("command", [("mocapfix",), ("python", "-m", "mocapfix")])
def test_installed_commands_run(scripts: Path, tmp_path: Path, command: tuple[str, ...]):
    assert "clean" in run_command(scripts / command[0], *command[1:], "--help", folder=tmp_path)


def test_a_take_is_cleaned_by_the_installed_package(scripts: Path, tmp_path: Path):
    write_synthetic_take(tmp_path / "walk.c3d", compose_take(seconds=1.0, rate=60.0))
    run_command(scripts / "python", "-m", "mocapfix", "clean", tmp_path / "walk.c3d", folder=tmp_path)
    kinds = ("c3d", "bvh", "subject.yaml", "changes.yaml", "report.json", "report.html", "rrd")
    written = {path.name for path in (tmp_path / "walk.mocapfix").iterdir() if path.stat().st_size}
    assert written == {f"walk.{kind}" for kind in kinds}


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("train", "twist", "--config", "a.yaml", "--data", ".", "-o", "a.safetensors"), "pip install 'mocapfix[train]'"),
        (("bench", "baseline"), "in a checkout of the repository"),
    ],
)
def test_lab_says_what_is_not_installed(scripts: Path, tmp_path: Path, arguments: tuple[str, ...], message: str):
    command = [scripts / "python", "-m", "mocapfix", *arguments]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, encoding="utf-8", check=False)
    assert done.returncode == 1
    assert message in " ".join(done.stderr.split())
    assert "Traceback" not in done.stderr

"""The packages to publish: built from the checkout, and installed into an empty environment with the libraries of an index.

`make test` leaves these tests to `make test-package`: they install the libraries and compile the kernels once more.
"""

import os
import re
import subprocess
import sys
import sysconfig
import tarfile
import tomllib
import venv
import zipfile
from email import message_from_bytes
from pathlib import Path

import pytest

from mocapfix.synthetic import compose_take, write_synthetic_take

CHECKOUT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((CHECKOUT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
LAB_DATA = {"bench", "mnn-ik"}
"""the folder and the weights that only benchmarks read, which are not installed"""
SYSTEM_VARIABLES = ("HOME", "TMPDIR", "SYSTEMROOT", "TEMP", "TMP", "USERPROFILE", "LOCALAPPDATA")
"""what processes need of the environment; without PYTHONPATH, and with PATH for the new environment alone: without a compiler"""


def run_command(*command: str | Path, folder: Path, environment: dict[str, str] | None = None) -> str:
    """Return the output of a command that must succeed."""
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, encoding="utf-8", check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Build the sdist, and from it the wheel; return their paths."""
    folder = tmp_path_factory.mktemp("dist")
    run_command(sys.executable, "-m", "build", "--no-isolation", "--outdir", folder, CHECKOUT, folder=folder)
    return next(folder.glob("*.tar.gz")), next(folder.glob("*.whl"))


@pytest.fixture(scope="module")
def scripts(built: tuple[Path, Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the scripts folder of a new environment that contains the wheel and what it requires."""
    base = tmp_path_factory.mktemp("environment")
    venv.create(base, symlinks=os.name != "nt")
    constraints = ("--constraint", CHECKOUT / "constraints.txt") if sys.version_info[:2] == (3, 11) else ()
    pip = (sys.executable, "-m", "pip", "--python", base, "install", "--quiet", "--no-compile")
    run_command(*pip, *constraints, built[1], folder=base)
    paths = sysconfig.get_paths("venv", vars={name: str(base) for name in ("base", "platbase", "installed_base")})
    return Path(paths["scripts"])


@pytest.fixture(scope="module")
def environment(scripts: Path) -> dict[str, str]:
    return {name: os.environ[name] for name in SYSTEM_VARIABLES if name in os.environ} | {"PATH": str(scripts)}


def test_index_accepts_the_packages(built: tuple[Path, Path]):
    run_command(sys.executable, "-m", "twine", "check", "--strict", *built, folder=built[0].parent)


def test_sdist_builds_the_wheel_of_the_checkout(built: tuple[Path, Path], tmp_path: Path):
    run_command(sys.executable, "-m", "build", "--no-isolation", "--wheel", "--outdir", tmp_path, CHECKOUT, folder=tmp_path)
    assert (tmp_path / built[1].name).read_bytes() == built[1].read_bytes()


def test_wheel_contains_the_data_that_a_clean_reads_inside_the_package(built: tuple[Path, Path]):
    names, information = set(zipfile.ZipFile(built[1]).namelist()), f"mocapfix-{PROJECT['version']}.dist-info"
    assert {name.split("/")[0] for name in names} == {"mocapfix", information}
    files = (path.relative_to(CHECKOUT) for folder in ("scenes", "priors") for path in (CHECKOUT / folder).rglob("*"))
    needed = {f"mocapfix/{path.as_posix()}" for path in files if path.suffix and not LAB_DATA & {path.stem, path.parent.name}}
    assert {"mocapfix/scenes/marker-sets/cmu41.yaml", "mocapfix/priors/autoencoder.safetensors"} <= needed
    code = {f"mocapfix/{path.relative_to(CHECKOUT / 'mocapfix').as_posix()}" for path in (CHECKOUT / "mocapfix").rglob("*.py")}
    data = {name for name in names if not name.startswith(information) and name not in code}
    assert "mocapfix/py.typed" in data
    assert {name for name in data if name.startswith(("mocapfix/scenes/", "mocapfix/priors/"))} == needed
    assert code <= names


def test_licences_of_code_and_weights_are_in_the_wheel(built: tuple[Path, Path]):
    wheel = zipfile.ZipFile(built[1])
    assert "MIT License" in wheel.read(f"mocapfix-{PROJECT['version']}.dist-info/licenses/LICENSE").decode()
    weights = [name for name in wheel.namelist() if name.endswith(".safetensors")]
    cards = [wheel.read(name.replace(".safetensors", ".md")).decode() for name in weights]
    assert len(cards) >= 6
    assert all("| source | licence |" in card for card in cards)


def test_description_has_no_link_of_a_checkout(built: tuple[Path, Path]):
    wheel = zipfile.ZipFile(built[1])
    metadata = message_from_bytes(wheel.read(f"mocapfix-{PROJECT['version']}.dist-info/METADATA"))
    assert metadata["Description-Content-Type"] == "text/markdown"
    links = ["".join(link) for link in re.findall(r"""\]\(([^)]*)|(?:src|href)="([^"]*)""", str(metadata.get_payload()))]
    assert all(link.startswith("https://") for link in links)
    site, repository = PROJECT["urls"]["Documentation"], PROJECT["urls"]["Changelog"].removesuffix("CHANGELOG.md")
    pages = [CHECKOUT / "docs" / re.sub(r"\.html(#.*)?$", ".md", link.removeprefix(site)) for link in links if site in link]
    files = [CHECKOUT / link.removeprefix(repository) for link in links if repository in link]
    assert {CHECKOUT / "docs" / "formats.md", CHECKOUT / "LICENSE"} <= {*pages, *files}
    assert any(page.suffix == ".png" for page in pages)
    assert all(path.is_file() for path in (*pages, *files))


def test_addresses_are_those_of_the_project():
    """The add-on and the citation state them again; every other file takes them from pyproject.toml."""
    urls = PROJECT["urls"]
    manifest = tomllib.loads((CHECKOUT / "addon/mocapfix_blender/blender_manifest.toml").read_text(encoding="utf-8"))
    citation = (CHECKOUT / "CITATION.cff").read_text(encoding="utf-8")
    assert manifest["website"] == urls["Homepage"]
    assert re.findall(r"^(?:url|repository-code): (.*)$", citation, re.MULTILINE) == [urls["Homepage"], urls["Source"]]
    texts = [*CHECKOUT.glob("*.*"), *(CHECKOUT / "docs").rglob("*.md"), *(CHECKOUT / "mocapfix").rglob("*.py")]
    named = {path.name for path in texts if path.is_file() and urls["Homepage"] in path.read_text(encoding="utf-8")}
    assert named == {"pyproject.toml", "CITATION.cff"}


def test_sdist_is_complete(built: tuple[Path, Path]):
    with tarfile.open(built[0]) as archive:
        names = {name.split("/", 1)[1] for name in archive.getnames()}
    assert {"LICENSE", "CHANGELOG.md", "Makefile", "constraints.txt", "docs/build_readme.py", "tests/test_packaging.py"} <= names
    assert not any(name.startswith((".venv", "shared")) for name in names)


def test_empty_environment_has_neither_the_checkout_nor_what_training_needs(
    scripts: Path, environment: dict[str, str], tmp_path: Path
):
    code = """
import shutil, sys
from importlib.util import find_spec
import mocapfix
from mocapfix.io.shipped import find_shipped_folder
print(mocapfix.__file__, find_shipped_folder("scenes"), find_shipped_folder("priors"), sep="\\n")
print([name for name in ("torch", "sklearn", "matplotlib", "pytest") if find_spec(name)])
print([name for name in ("cc", "gcc", "clang", "cl") if shutil.which(name)])
print(*sys.path, sep="\\n")
"""
    module, scenes, priors, libraries, compilers, *paths = run_command(
        scripts / "python", "-c", code, folder=tmp_path, environment=environment
    ).splitlines()
    package = Path(module).parent
    assert package.is_relative_to(scripts.parent)
    assert (Path(scenes), Path(priors)) == (package / "scenes", package / "priors")
    assert (libraries, compilers) == ("[]", "[]")
    assert not [path for path in paths if path and Path(path).is_relative_to(CHECKOUT)]


@pytest.mark.parametrize("command", [("mocapfix",), ("python", "-m", "mocapfix")])
def test_installed_commands_run(scripts: Path, environment: dict[str, str], tmp_path: Path, command: tuple[str, ...]):
    arguments = (scripts / command[0], *command[1:])
    assert "clean" in run_command(*arguments, "--help", folder=tmp_path, environment=environment)
    version = run_command(*arguments, "--version", folder=tmp_path, environment=environment)
    assert version == f"mocapfix {PROJECT['version']}\n"


def test_a_take_is_cleaned_without_a_compiler(scripts: Path, environment: dict[str, str], tmp_path: Path):
    write_synthetic_take(tmp_path / "walk.c3d", compose_take(seconds=1.0, rate=60.0))
    run_command(scripts / "mocapfix", "clean", tmp_path / "walk.c3d", folder=tmp_path, environment=environment)
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
def test_lab_says_what_is_not_installed(
    scripts: Path, environment: dict[str, str], tmp_path: Path, arguments: tuple[str, ...], message: str
):
    command = [scripts / "python", "-m", "mocapfix", *arguments]
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, encoding="utf-8", check=False)
    assert done.returncode == 1
    assert message in " ".join(done.stderr.split())
    assert "Traceback" not in done.stderr

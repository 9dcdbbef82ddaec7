"""The structure of the package: imports, sizes of modules, signatures and names. The caps are lowered, never raised."""

import ast
import re
import tomllib
from collections import defaultdict
from collections.abc import Iterator
from functools import cache
from itertools import pairwise
from pathlib import Path

PACKAGE = Path(__file__).parent.parent / "mocapfix"
MAX_ROOT_MODULES = 10
MAX_PRODUCT_MODULES, MAX_PRODUCT_LINES = 233, 62_551
MAX_LAB_MODULES, MAX_LAB_LINES = 47, 13_657
MAX_MODULES_WITH_ONE_IMPORTER = 42
MAX_MODULE_LINES = 600
MAX_IMPORT_LAYERS = 23
MAX_POSITIONAL_PARAMETERS = 7
MAX_TUPLE_RESULTS = 3
FOLDERS_THAT_USE_KERNELS = {"animations", "batch", "cli", "detect", "io", "kernels", "lab", "labels", "model", "solve", "stats"}
SOLVER_KERNELS = ("levenberg_marquardt", "normal_equations", "sweep", "covariance", "schur")
"""the kernels of which a minimisation consists"""


def name_of(path: Path) -> str:
    """Return a module's dotted name."""
    parts = path.relative_to(PACKAGE.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def folder_of(name: str) -> str:
    """Return the folder of the package in which a module is, "" for a module of the package itself."""
    parts = name.split(".")
    return parts[1] if len(parts) > 2 or (f"{name}." in packages() and name != PACKAGE.name) else ""


@cache
def sources() -> dict[str, str]:
    """Return the text of every module by its dotted name."""
    return {name_of(path): path.read_text(encoding="utf-8") for path in sorted(PACKAGE.rglob("*.py"))}


@cache
def modules() -> dict[str, ast.Module]:
    return {name: ast.parse(text) for name, text in sources().items()}


@cache
def packages() -> set[str]:
    """Return the names of the modules that contain others, each with a dot at its end."""
    return {f"{name.rpartition('.')[0]}." for name in modules()} - {"."}


@cache
def imports() -> dict[str, set[str]]:
    """Return the modules of the package that each module imports, inside functions and for types too."""
    found: dict[str, set[str]] = {name: set() for name in modules()}
    for name, tree in modules().items():
        for node in ast.walk(tree):
            if isinstance(node, ast.ImportFrom) and node.module:
                names = {f"{node.module}.{alias.name}" for alias in node.names}
                found[name] |= {each if each in modules() else node.module for each in names}
            elif isinstance(node, ast.Import):
                found[name] |= {alias.name for alias in node.names}
        found[name] = {each for each in found[name] if each in modules() and each != name}
    return found


def find_reachable(name: str) -> set[str]:
    """Return the modules that a module imports, directly or through others."""
    reached, waiting = set[str](), [name]
    while waiting:
        new = imports()[waiting.pop()] - reached
        reached |= new
        waiting += new
    return reached


@cache
def product() -> list[str]:
    """Return the modules outside `lab`."""
    return [name for name in modules() if folder_of(name) != "lab"]


@cache
def functions() -> list[tuple[str, ast.FunctionDef]]:
    return [
        (f"{name}.{node.name}", node)
        for name, tree in modules().items()
        for node in ast.walk(tree)
        if isinstance(node, ast.FunctionDef)
    ]


def test_docstrings_have_sections_instead_of_columns() -> None:
    """Arguments and fields are described in Google's sections, which the site renders as tables; indented blocks are literal."""
    column, header = re.compile(r"\S(.*\S)? {2,}\S|-{3,}$"), re.compile(r"(Args|Attributes|Raises):$")
    found: list[str] = []
    for name, tree in modules().items():
        for node in ast.walk(tree):
            if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef):
                lines = (ast.get_docstring(node) or "").splitlines()
                found += [f"{name}: {line}" for line in lines if column.match(line)]
                found += [f"{name}: {b}" for a, b in pairwise(lines) if header.match(a) and not re.match(r"    \S.*: \S", b)]
    assert not found


def test_imports_have_no_cycles() -> None:
    reachable = {name: find_reachable(name) for name in modules()}
    assert not [name for name in modules() if name in reachable[name]]


def test_imports_have_few_layers() -> None:
    depth: dict[str, int] = {}

    def measure(name: str) -> int:
        if name not in depth:
            depth[name] = 1  # a module of a cycle is counted once
            depth[name] = 1 + max((measure(each) for each in imports()[name]), default=0)
        return depth[name]

    deepest = max(modules(), key=measure)
    assert depth[deepest] <= MAX_IMPORT_LAYERS, f"{deepest} has {depth[deepest]} layers of imports below it"


def test_the_product_imports_neither_lab_nor_what_lab_alone_needs() -> None:
    assert not [(name, each) for name in product() for each in imports()[name] if folder_of(each) == "lab"]
    pattern = re.compile(r"\s*(?:from|import) +(?:torch|sklearn|matplotlib)\b")
    assert not [(name, line) for name in product() for line in sources()[name].splitlines() if pattern.match(line)]


def test_few_folders_use_the_kernels() -> None:
    users = {folder_of(name) for name in modules() if any(folder_of(each) == "kernels" for each in imports()[name])}
    assert users <= FOLDERS_THAT_USE_KERNELS


def test_poses_are_minimised_in_one_place() -> None:
    solver = {f"mocapfix.kernels.{name}" for name in SOLVER_KERNELS}
    users = {name for name in modules() if folder_of(name) != "kernels" and imports()[name] & solver}
    assert users == {"mocapfix.solve.minimise"}


def test_modules_are_few_and_not_long() -> None:
    lines = {name: text.count("\n") for name, text in sources().items()}
    lab = sorted(set(modules()) - set(product()))
    assert not {name: count for name, count in lines.items() if count > MAX_MODULE_LINES}
    assert len(list(PACKAGE.glob("*.py"))) <= MAX_ROOT_MODULES
    assert len(product()) <= MAX_PRODUCT_MODULES
    assert sum(lines[name] for name in product()) <= MAX_PRODUCT_LINES
    assert len(lab) <= MAX_LAB_MODULES
    assert sum(lines[name] for name in lab) <= MAX_LAB_LINES


def test_few_modules_have_one_importer() -> None:
    importers: dict[str, set[str]] = defaultdict(set)
    for name in product():
        for each in imports()[name]:
            importers[each].add(name)
    alone = [name for name in product() if len(importers[name]) == 1 and f"{name}." not in packages()]
    assert len(alone) <= MAX_MODULES_WITH_ONE_IMPORTER, alone


def test_functions_outside_the_kernels_have_few_positional_parameters() -> None:
    long = [
        name
        for name, node in functions()
        if ".kernels." not in name
        and len([a for a in node.args.posonlyargs + node.args.args if a.arg not in ("self", "cls")]) > MAX_POSITIONAL_PARAMETERS
    ]
    assert not long


def test_no_function_returns_a_long_bare_tuple() -> None:
    long = [
        name
        for name, node in functions()
        if isinstance(node.returns, ast.Subscript)
        and ast.unparse(node.returns.value) == "tuple"
        and isinstance(node.returns.slice, ast.Tuple)
        and len(node.returns.slice.elts) > MAX_TUPLE_RESULTS
    ]
    assert not long


def test_public_names_and_constants_are_unique_within_a_folder() -> None:
    places: dict[tuple[str, str], list[str]] = defaultdict(list)
    for module, tree in modules().items():
        folder = module.rpartition(".")[0]
        for node in tree.body:
            if isinstance(node, ast.FunctionDef | ast.ClassDef) and not node.name.startswith("_"):
                places[folder, node.name].append(module)
            elif isinstance(node, ast.Assign | ast.AnnAssign):
                targets = node.targets if isinstance(node, ast.Assign) else [node.target]
                names = {n.id for target in targets for n in ast.walk(target) if isinstance(n, ast.Name) and n.id.isupper()}
                for name in names - {"T"}:
                    places[folder, name].append(module)
    assert not {name: found for name, found in places.items() if len(found) > 1}


def list_names(tree: ast.Module) -> Iterator[str]:
    """Yield the names that a module defines: functions, classes, parameters and variables."""
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            yield node.name
        elif isinstance(node, ast.arg):
            yield node.arg
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            yield node.id


def test_forbidden_words_are_not_used() -> None:
    """The words stand in pyproject.toml: those of names, and regular expressions of phrases in code and documentation."""
    root = PACKAGE.parent
    forbidden = tomllib.loads((root / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["forbidden-words"]
    words, phrases = set(forbidden["names"]), re.compile("|".join(forbidden["phrases"]), re.IGNORECASE)
    texts = {path: path.read_text(encoding="utf-8") for folder in ("mocapfix", "tests") for path in (root / folder).rglob("*.py")}
    found = [
        f"{path.relative_to(root)}: {name}"
        for path, text in texts.items()
        if not words.isdisjoint(re.findall("[a-z]+", text.lower()))
        for name in list_names(ast.parse(text))
        if not words.isdisjoint(re.sub(r"(?<=[a-z])(?=[A-Z])", "_", name).lower().split("_"))
    ]
    paths = [*PACKAGE.rglob("*.py"), root / "README.md", *(root / "docs").rglob("*.md"), *(root / "scenes").rglob("*.yaml")]
    found += [
        f"{path.relative_to(root)}:{number}: {line.strip()}"
        for path in paths
        if phrases.search(text := path.read_text(encoding="utf-8"))
        for number, line in enumerate(text.splitlines(), 1)
        if phrases.search(line)
    ]
    assert not found

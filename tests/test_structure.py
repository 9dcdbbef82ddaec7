"""The structure and the vocabulary of the package: import layers, module sizes, signatures, and names that must not come back."""

import ast
import re
from collections import defaultdict
from functools import cache
from pathlib import Path

PACKAGE = Path(__file__).parent.parent / "mocapfix"
MAX_ROOT_MODULES = 16
MAX_IMPORT_LAYERS = 17
MAX_MODULE_LINES = 600
MAX_POSITIONAL_PARAMETERS = 7
MAX_TUPLE_RESULTS = 3

# Words of an earlier, private vocabulary. Each has a standard term; see docs/glossary.md.
BANNED_NAME_PARTS = (
    "said", "told", "heard", "hears", "worn", "wears", "wearing", "laid", "astray", "believed", "doubt", "doubted", "unsure",
    "vouched", "lesson", "learnt", "mended", "mend", "calmed", "trembling", "tremble", "whose", "alike", "kinds_of", "looked",
    "unshifted", "bridge", "bridged", "hers", "theirs", "listening", "listened", "listens", "foretold", "haunted", "recalled",
    "muddled", "torn", "shaken", "struck", "leant", "unbent", "spoilt", "gone", "nobody", "somebody", "stranger", "asked",
    "parted", "dressed", "understood", "touchable", "slacken", "lively",
)  # fmt: skip
BANNED_PHRASES = (
    r"\btold by\b", r"\bsays? of itself\b", r"\bis believed\b", r"\bnobody\b", r"\bsomebody\b", r"\bto the sky\b", r"\bvouch",
    r"\bmended?\b", r"\bastray\b(?!\")", r"\btrembl", r"\blistens? to\b", r"\bspeaks? for\b", r"\bcome to rest\b", r"\bworn\b",
    r"\bof one's own\b", r"\blearnt\b", r"\bmeanwhile\b", r"\banew\b", r"\bput back\b", r"\btakes? back\b", r"\btaken back\b",
    r"\bcomes? back\b", r"\btells? of\b", r"\bhardly counts\b",
)  # fmt: skip


def name_of(path: Path) -> str:
    """Return a module's dotted name."""
    parts = path.relative_to(PACKAGE.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


@cache
def modules() -> dict[str, ast.Module]:
    return {name_of(path): ast.parse(path.read_text(encoding="utf-8")) for path in sorted(PACKAGE.rglob("*.py"))}


def imported_modules(name: str) -> set[str]:
    """Return the modules of the package that a module imports when it is imported itself."""
    found: set[str] = set()

    def visit(statements: list[ast.stmt]) -> None:
        for each in statements:
            if isinstance(each, ast.If) and "TYPE_CHECKING" in ast.unparse(each.test):
                continue
            if isinstance(each, ast.ImportFrom) and each.module:
                found.update(f"{each.module}.{alias.name}" for alias in each.names)
                found.add(each.module)
            elif isinstance(each, ast.Import):
                found.update(alias.name for alias in each.names)
            elif isinstance(each, ast.If | ast.Try | ast.With):
                visit(each.body)

    visit(modules()[name].body)
    targets = {each for each in found if each in modules() and each != name}
    return {each for each in targets if each not in packages() or not any(other.startswith(f"{each}.") for other in targets)}


@cache
def packages() -> set[str]:
    """Return the names of the modules that contain others."""
    return {name.rpartition(".")[0] for name in modules()} - {""}


@cache
def functions() -> list[tuple[str, ast.FunctionDef]]:
    return [
        (f"{name}.{node.name}", node)
        for name, tree in modules().items()
        for node in ast.walk(tree)
        if isinstance(node, ast.FunctionDef)
    ]


def test_imports_have_no_cycles_and_few_layers() -> None:
    depth: dict[str, int] = {}

    def measure(name: str, chain: tuple[str, ...]) -> int:
        assert name not in chain, f"import cycle: {' > '.join((*chain, name))}"
        if name not in depth:
            depth[name] = 1 + max((measure(each, (*chain, name)) for each in imported_modules(name)), default=0)
        return depth[name]

    deepest = max(modules(), key=lambda name: measure(name, ()))
    assert depth[deepest] <= MAX_IMPORT_LAYERS, f"{deepest} has {depth[deepest]} layers of imports below it"


def test_root_of_the_package_is_small() -> None:
    assert len(list(PACKAGE.glob("*.py"))) <= MAX_ROOT_MODULES


def test_modules_are_not_long() -> None:
    lines = {name_of(path): len(path.read_text(encoding="utf-8").splitlines()) for path in PACKAGE.rglob("*.py")}
    assert not {name: count for name, count in lines.items() if count > MAX_MODULE_LINES}


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


def test_no_public_signature_has_a_bare_dict() -> None:
    def has_bare_dict(annotation: ast.expr | None) -> bool:
        return annotation is not None and re.search(r"\bdict\b(?!\[)", ast.unparse(annotation)) is not None

    bare = [
        name
        for name, node in functions()
        if not node.name.startswith("_")
        and (has_bare_dict(node.returns) or any(has_bare_dict(a.annotation) for a in node.args.args + node.args.kwonlyargs))
    ]
    assert not bare


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


def test_private_words_do_not_come_back_as_names() -> None:
    names: dict[str, str] = {}
    test_trees = {path.stem: ast.parse(path.read_text(encoding="utf-8")) for path in Path(__file__).parent.rglob("*.py")}
    for module, tree in (*modules().items(), *test_trees.items()):
        for node in ast.walk(tree):
            if isinstance(node, ast.FunctionDef | ast.ClassDef):
                name = node.name
            elif isinstance(node, ast.arg):
                name = node.arg
            elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
                name = node.id
            else:
                continue
            names[name] = f"{module}: {name}"
    banned = set(BANNED_NAME_PARTS)
    found = [
        place
        for name, place in names.items()
        if not banned.isdisjoint(re.sub(r"(?<=[a-z])(?=[A-Z])", "_", name).lower().split("_"))
    ]
    assert not found


def test_private_phrases_do_not_come_back_in_texts() -> None:
    root, banned = PACKAGE.parent, re.compile("|".join(BANNED_PHRASES), re.IGNORECASE)
    paths = [*PACKAGE.rglob("*.py"), root / "README.md", *(root / "docs").rglob("*.md"), *(root / "scenes").rglob("*.yaml")]
    found = [
        f"{path.relative_to(root)}:{number}: {line.strip()}"
        for path in paths
        for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1)
        if banned.search(line)
    ]
    assert not found

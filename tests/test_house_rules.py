"""What holds for the whole code base: import arrows, sizes, names, and the public surface."""

from __future__ import annotations

import ast
import inspect
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

import soma_core
from soma_core.plugin import hookspecs

ROOT = Path(__file__).resolve().parents[1]
SOURCES = sorted([*ROOT.glob("soma_core/**/*.py"), *ROOT.glob("plugins/*/soma_backend_*/**/*.py")])

MODULE_LINES = 400
FUNCTION_LINES = 60
NESTING = 3
TREE_MIB = 24

# A package imports from lower ranks and its own, never from higher ones.
RANKS = [
    {"errors", "paths", "cache", "files", "npz", "progress", "options"},
    {"geometry", "plugin"},
    {"kernels", "_inputs"},
    {"rig", "topology", "skeleton", "animation", "correctives"},
    {"backends", "io"},
    {"layer"},
    {"inversion"},
    {"native", "registration"},
    {"view"},
    {"motion"},
    {"config", "shape_space", "template", "testing"},
    {"evaluation"},
    {"tasks"},
    {"cli"},
]
RANK = {name: rank for rank, names in enumerate(RANKS) for name in names}

# Packages that stand alone: nothing else of the core, whatever its rank.
# The contract names the type of a check that a plugin may give; it is imported for typing only.
ALONE = {"geometry": {"errors"}, "plugin": {"errors", "paths", "cache", "testing"}}

TOP_LEVEL = {"soma_core", "plugins", "assets", "configs", "tests", "benchmarks", "docs", ".ci"}
VAGUE_NAMES = {"utils", "util", "common", "helpers", "misc"}
HEAVY = {"torch", "warp", "pxr", "trimesh"}

PUBLIC_NAMES = [
    "AssetError",
    "BackendError",
    "BackendSpec",
    "Generator",
    "Identity",
    "InputError",
    "InversionResult",
    "LinearBasis",
    "Motion",
    "Parameter",
    "PoseInversion",
    "Posed",
    "SomaError",
    "SomaLayer",
    "WrapPair",
    "__version__",
    "hookimpl",
    "load_canonical",
    "read_motion",
    "write_motion",
]
HOOKS = {
    "soma_backend": [],
    "soma_checks": [],
    "soma_convert": ["source", "output"],
    "soma_generator": ["spec", "device", "dtype", "options"],
}


def _label(path: Path) -> str:
    return str(path.relative_to(ROOT))


def _tree(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"))


def _package(path: Path) -> str:
    """The part of soma_core that a module belongs to: its folder, or itself."""
    return path.relative_to(ROOT / "soma_core").parts[0].removesuffix(".py")


def _imported_parts(tree: ast.AST) -> Iterator[str]:
    """Parts of soma_core that a module imports, at any depth, for typing or for use."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "imports are absolute"
            names = [f"{node.module}.{alias.name}" for alias in node.names]
        else:
            continue
        for name in names:
            parts = name.split(".")
            if parts[0] == "soma_core" and len(parts) > 1 and parts[1] in RANK:
                yield parts[1]


def _imported_packages(tree: ast.AST) -> set[str]:
    found: set[str] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found |= {alias.name.partition(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            found.add(node.module.partition(".")[0])
    return found


def _functions(tree: ast.AST) -> Iterator[ast.FunctionDef | ast.AsyncFunctionDef]:
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            yield node


def _depth(node: ast.AST) -> int:
    """How deep blocks are nested below `node`; an elif is no deeper than its if."""
    deepest = 0
    for field, value in ast.iter_fields(node):
        for child in value if isinstance(value, list) else [value]:
            if not isinstance(child, ast.AST) or isinstance(child, ast.FunctionDef | ast.ClassDef):
                continue
            is_elif = isinstance(node, ast.If) and field == "orelse" and isinstance(child, ast.If)
            is_block = isinstance(child, ast.If | ast.For | ast.While | ast.With | ast.Try)
            deepest = max(deepest, _depth(child) + int(is_block and not is_elif))
    return deepest


@pytest.mark.parametrize("path", [p for p in SOURCES if p.is_relative_to(ROOT / "soma_core")], ids=_label)
def test_imports_follow_the_arrows(path: Path) -> None:
    package = _package(path)
    if package == "__init__":
        return
    assert package in RANK, f"{package} has no place in RANKS; give it one"
    for part in _imported_parts(_tree(path)):
        allowed = part == package or (
            part in ALONE[package] if package in ALONE else RANK[part] <= RANK[package]
        )
        assert allowed, f"{_label(path)} imports soma_core.{part}, against the arrows"


@pytest.mark.parametrize("path", [p for p in SOURCES if p.is_relative_to(ROOT / "soma_core")], ids=_label)
def test_the_library_knows_no_hydra(path: Path) -> None:
    if RANK.get(_package(path), 0) < RANK["config"]:
        assert not _imported_packages(_tree(path)) & {"hydra", "omegaconf"}


@pytest.mark.parametrize("path", sorted((ROOT / "plugins").glob("*/**/*.py")), ids=_label)
def test_plugins_import_no_command(path: Path) -> None:
    assert not {"tasks", "cli", "config"} & set(_imported_parts(_tree(path)))


@pytest.mark.parametrize("path", sorted((ROOT / "soma_core" / "plugin").glob("*.py")), ids=_label)
def test_the_plugin_contract_is_light(path: Path) -> None:
    # torch is named in annotations, under TYPE_CHECKING; nothing else heavy may be.
    assert not _imported_packages(_tree(path)) & (HEAVY - {"torch"} | {"hydra", "numpy", "scipy"})


@pytest.mark.parametrize("path", SOURCES, ids=_label)
def test_modules_and_functions_stay_readable(path: Path) -> None:
    tree = _tree(path)
    assert len(path.read_text(encoding="utf-8").splitlines()) <= MODULE_LINES
    assert path.stem not in VAGUE_NAMES
    for function in _functions(tree):
        assert function.end_lineno is not None
        lines = function.end_lineno - function.lineno + 1
        assert lines <= FUNCTION_LINES, f"{_label(path)}: {function.name} has {lines} lines"
        assert _depth(function) <= NESTING, f"{_label(path)}: {function.name} is nested too deep"


@pytest.mark.parametrize("path", SOURCES, ids=_label)
def test_modules_say_what_they_offer_and_do_not_print(path: Path) -> None:
    tree = _tree(path)
    assert ast.get_docstring(tree)
    targets = [
        target.id
        for node in tree.body
        if isinstance(node, ast.Assign | ast.AnnAssign)
        for target in (node.targets if isinstance(node, ast.Assign) else [node.target])
        if isinstance(target, ast.Name)
    ]
    assert "__all__" in targets, f"{_label(path)} has no __all__"
    for node in ast.walk(tree):
        if isinstance(node, ast.ExceptHandler):
            assert node.type is not None, f"{_label(path)}:{node.lineno}: bare except"
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
            assert node.func.id != "print", f"{_label(path)}:{node.lineno}: print"


@pytest.mark.parametrize(
    "statement",
    ["import soma_core", "import soma_core.plugin.registry", "from soma_core import BackendSpec, hookimpl"],
)
def test_importing_loads_nothing_heavy(statement: str) -> None:
    script = f"{statement}\nimport sys; print(' '.join(sys.modules))"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    loaded = {name.partition(".")[0] for name in done.stdout.split()}
    assert not loaded & HEAVY


def test_declaring_every_installed_backend_imports_no_torch() -> None:
    script = (
        "from soma_core.plugin.registry import Registry\n"
        "registry = Registry()\n"
        "for name in registry.names(): registry.spec(name)\n"
        "import sys; print(' '.join(sys.modules))"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert not {name.partition(".")[0] for name in done.stdout.split()} & HEAVY


def _tracked() -> list[Path]:
    try:
        done = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        pytest.skip("not a git checkout")
    return [ROOT / name for name in done.stdout.split("\0") if name and (ROOT / name).is_file()]


def test_the_tracked_tree_stays_small() -> None:
    size = sum(path.stat().st_size for path in _tracked()) / 2**20
    assert size < TREE_MIB, f"the tracked tree holds {size:.1f} MiB"


def test_top_level_folders_are_the_planned_ones() -> None:
    folders = {path.relative_to(ROOT).parts[0] for path in _tracked() if path.parent != ROOT}
    assert folders <= TOP_LEVEL


def test_the_public_names_are_the_published_ones() -> None:
    assert sorted(soma_core.__all__) == PUBLIC_NAMES
    assert set(PUBLIC_NAMES) <= set(dir(soma_core))
    for name in PUBLIC_NAMES:
        assert getattr(soma_core, name) is not None


def test_an_unknown_public_name_is_refused() -> None:
    with pytest.raises(AttributeError, match="'SomaLayr'.*it offers.*SomaLayer"):
        _ = soma_core.SomaLayr


def test_the_hooks_keep_their_signatures() -> None:
    found = {
        name: list(inspect.signature(value).parameters)
        for name, value in vars(hookspecs).items()
        if name.startswith("soma_") and inspect.isfunction(value)
    }
    assert found == HOOKS

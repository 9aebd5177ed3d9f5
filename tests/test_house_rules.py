"""What holds for the whole code base: import arrows, sizes, names, and the public surface."""

from __future__ import annotations

import ast
import functools
import importlib
import inspect
import pkgutil
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import scipy.sparse.csgraph

import soma_core.plugin
from soma_core.plugin import hookspecs

ROOT = Path(__file__).resolve().parents[1]
_FOLDERS = ("soma_core/**/*.py", "plugins/*/soma_backend_*/**/*.py", "assets/make/*.py")
SOURCES = sorted(path for pattern in _FOLDERS for path in ROOT.glob(pattern))
CORE = [path for path in SOURCES if path.is_relative_to(ROOT / "soma_core")]

# What the author of a backend writes: our own plugins, their tests, and what a new one starts from.
AUTHORS = sorted({*ROOT.glob("plugins/**/*.py"), *ROOT.glob("soma_core/template/files/*.in")})
_IMPORT_OF_CORE = re.compile(
    r"^[ \t]*(?:from|import)[ \t]+(soma_core[\w.]*)(?:[ \t]+import[ \t]+(\([^)]*\)|.*))?$", re.MULTILINE
)

MODULE_LINES = 400
FUNCTION_LINES = 60
NESTING = 3
TREE_MIB = 28

# A package imports from lower ranks and its own, never from higher ones.
RANKS = [
    {
        "_lazy",
        "_version",
        "apart",
        "cache",
        "choices",
        "errors",
        "fbx_probe",
        "files",
        "json_file",
        "npz",
        "obj",
        "options",
        "parquet_file",
        "parquet_probe",
        "paths",
        "pickle_machine",
        "progress",
        "safe_pickle",
        "stored_matrix",
        "tensor_archive",
        "usd_probe",
        "usd_stage",
        "zip_archive",
    },
    {"geometry", "plugin"}, {"kernels", "_inputs", "_derived"},
    {"rig", "topology", "skeleton", "animation", "correctives"}, {"backends", "io"}, {"compiled", "points"},
    {"layer"}, {"inversion", "deploy"}, {"native", "registration"}, {"view"}, {"motion"},
    {"config", "shape_space", "template", "testing"}, {"evaluation", "viewer"}, {"tasks"}, {"cli"},
]  # fmt: skip
RANK = {name: rank for rank, names in enumerate(RANKS) for name in names}

# Lists of names that are loaded when they are first used; they follow no arrow.
LISTS = {"soma_core/__init__.py", "soma_core/motion/__init__.py", "soma_core/plugin/__init__.py"}

# Packages that stand alone: nothing else of the core, whatever its rank.
ALONE = {"geometry": {"errors"}, "plugin": {"_lazy", "_version", "errors", "paths", "cache"}}

TOP_LEVEL = {"soma_core", "plugins", "assets", "configs", "tests", "benchmarks", "docs", ".ci", ".github"}
EQUATIONS = {
    1: "topology/transfer.py",
    2: "geometry/rbf.py",
    3: "skeleton/joints.py",
    4: "skeleton/joints.py",
    5: "geometry/kabsch.py",
    6: "animation/skinning.py",
    7: "correctives/model.py",
    8: "geometry/kabsch.py",
}  # of the paper, and the one module that each is found in
VAGUE_NAMES = {"utils", "util", "common", "helpers", "misc"}
HEAVY = {"torch", "warp", "pxr", "trimesh"}

PUBLIC_NAMES = {
    "soma_core": """
        AnalyticalOptions AssetError AutogradOptions BackendError Camera CanonicalMesh HINGES Identity
        IdentityFit
        InputError InversionResult JointPrior JointRange Motion NativeFit NativeMotion NativeTransfer
        ParameterFit Point PointInversion PointResult PointSet PoseInversion PosePriors
        Posed Rig Sam3dFrames ShapeSpace SkinnedClip SmplChoices SmplMotion SomaError SomaLayer USER_JOINTS
        VertexSequence __version__ assets_dir canonical_landmarks default_registry diagnose_fit fit_identity
        fit_point_identity
        load_canonical load_point_set load_shape_space
        open_vertex_sequence read_amass read_camera read_cameras read_motion read_sam3d read_smpl
        skinned_clip write_amass write_gltf
        write_motion write_usd
    """,
    "soma_core.motion": """
        Animated BackendChoice CleanOptions Cleaned ClipStream ConvertOptions Converted DatasetOptions
        FitOptions FitPlan FolderConverted FrameRange IdentityChoice InversionChoice InvertOptions
        LimbSeconds Picture Played ShardsConverted SkeletonMotion WriteOptions animate clean convert
        convert_dataset convert_file convert_folder convert_people convert_shards finish_fit fit_chunks
        invert layout_of load_clip mirror mirrored_body motion_quality plan_fit read read_bvh resample
        retarget smooth stored_identity without_spikes write write_body write_bvh write_products
    """,
    "soma_core.plugin": """
        API_VERSION Axis BackendSpec BrokenBackendError Check CheckFailedError CheckNotRunError ClosestFaces
        Expressions FileNeeded Generator HasExpressions HasLinearBasis HasPoseVector HasPosed HasRandomPoses
        HasSkinning HasTriangles Level
        LinearBasis ModelMotion MotionFormat Parameter PluginError Registry SkinnedModel Unit WrapPair
        atomic_arrays atomic_write
        axis_angle_to_matrix
        cached_arrays check closest_point_on_triangle content_key data_dir file_sha256 hookimpl model_folders
        numbers_of_text open_npz_file pose_skinned read_obj read_pickled_arrays refuse_unreadable write_obj
    """,
    "soma_core.testing": """
        Context Report check_backend conformance_suite
    """,
}
HOOKS = {
    "soma_backend": [],
    "soma_checks": [],
    "soma_convert": ["source", "output"],
    "soma_generator": ["spec", "device", "dtype", "options"],
    "soma_motions": [],
}


def _label(path: Path) -> str:
    return str(path.relative_to(ROOT))


@functools.cache
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


def test_imports_follow_the_arrows() -> None:
    wrong = []
    for path in CORE:
        package = _package(path)
        assert _label(path) in LISTS or package in RANK, f"{package} has no place in RANKS; give it one"
        for part in set() if _label(path) in LISTS else _imported_parts(_tree(path)):
            below = part in ALONE[package] if package in ALONE else RANK[part] <= RANK[package]
            wrong += [] if part == package or below else [f"{_label(path)} imports soma_core.{part}"]
    assert not wrong, "against the arrows:\n" + "\n".join(wrong)


def _module(path: Path) -> str:
    """Dotted name of a source; a package's is that of its folder."""
    parts = path.relative_to(ROOT).with_suffix("").parts
    parts = parts[2:] if parts[0] == "plugins" else parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def _import_graph() -> dict[str, set[str]]:
    """Which module imports which, at any depth, for typing or for use."""
    sources = {_module(path): path for path in SOURCES}
    graph: dict[str, set[str]] = {}
    for module, path in sources.items():
        names: set[str] = set()
        for node in ast.walk(_tree(path)):
            if isinstance(node, ast.Import):
                names |= {alias.name for alias in node.names}
            elif isinstance(node, ast.ImportFrom):
                inside = {f"{node.module}.{alias.name}" for alias in node.names} & set(sources)
                names |= inside or {str(node.module)}
        graph[module] = names & set(sources)
    return graph


def test_no_imports_go_in_a_circle() -> None:
    graph = _import_graph()
    index = {name: place for place, name in enumerate(graph)}
    edges = np.array([[index[name], index[other]] for name, others in graph.items() for other in others])
    links = scipy.sparse.coo_array((np.ones(len(edges)), tuple(edges.T)), shape=(len(graph), len(graph)))
    count, label = scipy.sparse.csgraph.connected_components(links, connection="strong")
    names = np.array(list(graph))
    circles = [set(names[label == part].tolist()) for part in range(count) if (label == part).sum() > 1]
    assert not circles, f"imports go in a circle: {circles}"
    assert not [name for name, others in graph.items() if name in others], "a module imports itself"


def test_the_library_knows_no_hydra() -> None:
    below = [path for path in CORE if RANK.get(_package(path), 0) < RANK["config"]]
    assert not [_label(path) for path in below if _imported_packages(_tree(path)) & {"hydra", "omegaconf"}]


def test_plugins_import_no_command() -> None:
    paths = sorted((ROOT / "plugins").glob("*/**/*.py"))
    commands = {"tasks", "cli", "config"}
    assert not [_label(path) for path in paths if commands & set(_imported_parts(_tree(path)))]


def test_the_plugin_contract_is_light() -> None:
    # torch is named in annotations, under TYPE_CHECKING; nothing else heavy may be.
    heavy = HEAVY - {"torch"} | {"hydra", "numpy", "scipy"}
    paths = (ROOT / "soma_core" / "plugin").glob("*.py")
    assert not [_label(path) for path in paths if _imported_packages(_tree(path)) & heavy]


def test_modules_and_functions_stay_readable() -> None:
    wrong = []
    for path in SOURCES:
        lines = len(path.read_text(encoding="utf-8").splitlines())
        wrong += [f"{_label(path)} has {lines} lines"] if lines > MODULE_LINES else []
        wrong += [f"{_label(path)} says nothing"] if path.stem in VAGUE_NAMES else []
        for function in _functions(_tree(path)):
            assert function.end_lineno is not None
            lines = function.end_lineno - function.lineno + 1
            place = f"{_label(path)}: {function.name}"
            wrong += [f"{place} has {lines} lines"] if lines > FUNCTION_LINES else []
            wrong += [f"{place} is nested too deep"] if _depth(function) > NESTING else []
    assert not wrong, "\n".join(wrong)


def test_modules_say_what_they_offer_and_do_not_print() -> None:
    wrong = []
    for path in SOURCES:
        tree = _tree(path)
        targets = [
            target.id
            for node in tree.body
            if isinstance(node, ast.Assign | ast.AnnAssign)
            for target in (node.targets if isinstance(node, ast.Assign) else [node.target])
            if isinstance(target, ast.Name)
        ]
        wrong += [] if ast.get_docstring(tree) else [f"{_label(path)} has no docstring"]
        wrong += [] if "__all__" in targets else [f"{_label(path)} has no __all__"]
        for node in ast.walk(tree):
            if isinstance(node, ast.ExceptHandler) and node.type is None:
                wrong.append(f"{_label(path)}:{node.lineno}: bare except")
            called = node.func if isinstance(node, ast.Call) else None
            if isinstance(called, ast.Name) and called.id == "print":
                wrong.append(f"{_label(path)}:{called.lineno}: print")
    assert not wrong, "\n".join(wrong)


def test_each_equation_of_the_paper_is_found_by_its_number() -> None:
    text = {path: " ".join(path.read_text(encoding="utf-8").split()) for path in CORE}
    for number, place in EQUATIONS.items():
        named = [path for path in CORE if re.search(rf"[Ee]quation {number}\b", text[path])]
        assert [str(path.relative_to(ROOT / "soma_core")) for path in named] == [place]


@pytest.mark.parametrize(
    "statement",
    [
        "import soma_core",
        "import soma_core.plugin.registry",
        "from soma_core.plugin import BackendSpec, check, hookimpl",
    ],
)
def test_importing_loads_nothing_heavy(statement: str) -> None:
    script = f"{statement}\nimport sys; print(' '.join(sys.modules))"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    loaded = {name.partition(".")[0] for name in done.stdout.split()}
    assert not loaded & HEAVY


@pytest.mark.slow
def test_torch_kernels_import_no_warp() -> None:
    script = (
        "import sys; sys.modules['warp'] = None\n"
        "import torch\n"
        "from soma_core import PoseInversion, SomaLayer\n"
        "layer = SomaLayer('soma', lod='low', kernels='torch')\n"
        "identity = layer.identity()\n"
        "posed = layer.pose(identity, torch.zeros(1, 77, 3))\n"
        "PoseInversion(layer, kernels='torch')(posed.vertices, identity)"
    )
    subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)


def test_backend_authors_import_public_names_only() -> None:
    wrong = []
    for path in AUTHORS:
        for module, names in _IMPORT_OF_CORE.findall(path.read_text(encoding="utf-8")):
            private = set(re.findall(r"\w+", names)) - set(PUBLIC_NAMES.get(module, "").split())
            if module not in PUBLIC_NAMES or private:
                wrong.append(f"{_label(path)} imports {sorted(private)} of {module}")
    assert not wrong, "\n".join(wrong)


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


@pytest.mark.parametrize("package", PUBLIC_NAMES)
def test_the_public_names_are_the_published_ones(package: str) -> None:
    module, names = importlib.import_module(package), PUBLIC_NAMES[package].split()
    assert sorted(module.__all__) == names
    assert set(names) <= set(dir(module))
    for name in names:
        assert getattr(module, name) is not None


def test_a_public_name_has_one_import_path() -> None:
    names = [name for text in PUBLIC_NAMES.values() for name in text.split()]
    assert len(names) == len(set(names))


def test_plugins_written_for_the_first_import_paths_go_on() -> None:
    from soma_core import BackendSpec, hookimpl
    from soma_core.testing import check

    assert (BackendSpec, hookimpl, check) == (
        soma_core.plugin.BackendSpec,
        soma_core.plugin.hookimpl,
        soma_core.plugin.check,
    )


@pytest.mark.slow
def test_a_type_checker_sees_what_the_lazy_names_are(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(ROOT)
    api = pytest.importorskip("mypy.api")
    (tmp_path / "use.py").write_text(
        "import soma_core, soma_core.plugin\n"
        "reveal_type(soma_core.SomaLayer('soma'))\n"
        "reveal_type(soma_core.plugin.BackendSpec)"
    )
    found, errors, _ = api.run([str(tmp_path / "use.py")])  # as `mypy` is run here, which shares its cache
    assert not errors
    assert '"soma_core.layer.SomaLayer"' in found
    assert "-> soma_core.plugin.spec.BackendSpec" in found
    assert (ROOT / "soma_core" / "py.typed").is_file()


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


@pytest.mark.parametrize(
    "package", ["soma_core", "soma_core.motion", "soma_core.plugin", "soma_core.testing"]
)
def test_a_public_name_is_no_module(package):
    """Importing the module would put it in the place of what the package loads by that name."""
    module = importlib.import_module(package)
    modules = {each.name for each in pkgutil.iter_modules(module.__path__)}
    assert not modules & {*module.__all__}

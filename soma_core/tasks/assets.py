"""Check the assets, tell what a folder of them holds, choose one, list named points (`soma assets`)."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from soma_core.cache import atomic_text
from soma_core.errors import AssetError, SomaError
from soma_core.paths import assets_dir, assets_note, expanded, model_folders, shipped_assets
from soma_core.rig.landmarks import canonical_landmarks
from soma_core.rig.manifest import (
    CORRECTIVES_NAME,
    MANIFEST_NAME,
    NEUTRAL_NAME,
    PROCEDURAL_NAME,
    RESTORE,
    RIG_NAME,
    Manifest,
    check_files,
    read_manifest,
    verified_sha256,
)

__all__ = ["list_landmarks", "show_assets", "use_assets", "verify_assets"]

_PUBLISHED = "https://huggingface.co/nvidia/soma-x"
_MODELS = ("Anny", "GarmentMeasurements", "MHR", "SMPL", "SMPLX")

_MAKERS = "make"  # in a checkout, the scripts that make the assets lie among them


def _unlisted(root: Path, listed: set[str]) -> list[str]:
    """Files of the folder that the manifest does not know."""
    present = {path.relative_to(root).as_posix() for path in root.rglob("*") if path.is_file()}
    present = {name for name in present if name.partition("/")[0] != _MAKERS}
    hidden = {name for name in present if name.rpartition("/")[2].startswith(".")}
    return [
        f"{root / name}: not in {MANIFEST_NAME}. Remove it"
        for name in sorted(present - hidden - listed - {MANIFEST_NAME})
    ]


def _contents(root: Path, *, whole: bool = True) -> list[str]:
    """Open what no hash vouches for: keys, rig, shapes. Folders of the user's need no extra-low mesh."""
    from soma_core.rig.canonical import load_canonical
    from soma_core.rig.neutral import load_shape_space

    checks: list[Callable[[], object]] = [
        lambda: load_canonical("mid", root),
        lambda: load_canonical("low", root),
        lambda: _correctives(root),
    ]
    if whole:
        checks += [lambda: load_canonical("xlo", root), lambda: load_shape_space(root / NEUTRAL_NAME)]
    findings = []
    for check in checks:
        try:
            check()
        except AssetError as error:
            findings.append(str(error))
    return findings


def _correctives(root: Path) -> None:
    """Open the correctives, where there are any, and compare them with the rig."""
    from soma_core.correctives.weights import check_bind_pose, read_weights
    from soma_core.rig.canonical import load_canonical

    path = root / CORRECTIVES_NAME
    if path.is_file():
        check_bind_pose(path, read_weights(path), load_canonical("mid", root)[1])


def verify_assets(root: Path | None = None) -> list[str]:
    """Check every asset against the manifest, then that the files open and belong together.

    Args:
        root: assets folder; default: the shipped one.

    Returns:
        The names of the files that were checked.

    Raises:
        AssetError: one that lists every finding, each with what to do.
    """
    root = assets_dir() if root is None else Path(root)
    manifest = read_manifest(root)
    findings = check_files(root, manifest)
    if not manifest.listed:
        findings += _contents(root, whole=False)
        if findings:
            raise AssetError(root, cause="; ".join(findings), fix=f"See `soma assets show {root}`")
        return sorted(manifest.files)
    findings += [
        f"{root / MANIFEST_NAME}: does not list {name}. {RESTORE}"
        for name in (RIG_NAME, NEUTRAL_NAME, PROCEDURAL_NAME)
        if name not in manifest.files
    ]
    findings += _unlisted(root, set(manifest.files))
    findings = findings or _contents(root)
    if findings:
        cause = f"{len(findings)} finding{'s' if len(findings) > 1 else ''}\n  " + "\n  ".join(findings)
        raise AssetError(root, cause=cause, fix="Restore the files above")
    return sorted(manifest.files)


def use_assets(folder: str) -> str:
    """Remember which folder of assets is used from now on, ``shipped`` for that of the package.

    Returns:
        A sentence for the user.

    Raises:
        AssetError: a folder that cannot be read as assets; what was remembered stays.
    """
    if folder == "shipped":
        assets_note().unlink(missing_ok=True)
        return f"{shipped_assets()}: the shipped assets are used"
    root = expanded(folder).resolve()
    if root == shipped_assets().resolve():
        return use_assets("shipped")
    verify_assets(root)
    assets_note().parent.mkdir(parents=True, exist_ok=True)
    atomic_text(assets_note(), f"{root}\n")
    override = os.environ.get("SOMA_ASSETS")
    hidden = f"; SOMA_ASSETS={override} comes first as long as it is set" if override else ""
    return f"{root}: used from now on, until `soma assets use shipped`{hidden}"


@contextmanager
def _using(root: Path) -> Iterator[None]:
    """Let this process look into a folder of assets."""
    before = os.environ.get("SOMA_ASSETS")
    os.environ["SOMA_ASSETS"] = str(root)
    try:
        yield
    finally:
        if before is None:
            del os.environ["SOMA_ASSETS"]
        else:
            os.environ["SOMA_ASSETS"] = before


def show_assets(root: Path | None = None) -> list[str]:
    """Tell in lines what a folder of assets holds, what can be used of it, and what is missing.

    Args:
        root: the folder; default: the one in use.

    Raises:
        AssetError: no folder of assets.
    """
    chosen = root is not None
    root = assets_dir() if root is None else expanded(root)
    manifest = read_manifest(root)
    why = "SOMA_ASSETS" if os.environ.get("SOMA_ASSETS") else f"soma assets use, {assets_note()}"
    why = "named" if chosen else "shipped" if root == shipped_assets() else why
    lines = [f"folder       {root} ({why}; {'listed by a manifest' if manifest.listed else 'no manifest'})"]
    with _using(root):
        lines += [*_rig_lines(root), *_file_lines(root, manifest), *_model_lines()]
    return lines


def _rig_lines(root: Path) -> list[str]:
    from soma_core.backends.native import component_count
    from soma_core.rig.canonical import load_canonical

    lines: list[str] = []
    levels = []
    for lod in ("mid", "low", "xlo"):
        try:
            mesh, rig = load_canonical(lod, root)
        except AssetError as error:
            levels.append(f"no {lod} ({error.cause.partition(';')[0]})")
            continue
        levels.append(f"{lod} {mesh.vertex_count:,}")
        if lod == "mid":
            helpers = 0 if rig.procedural is None else len(rig.procedural.joint_names)
            twist = f"{helpers} twist joints" if helpers else "no twist joints, so no correctives"
            source = RIG_NAME if (root / RIG_NAME).is_file() else NEUTRAL_NAME
            lines = [f"rig          {rig.revision}, {rig.joint_count} joints, {twist}; from {source}"]
    try:
        count = f"{component_count(root / NEUTRAL_NAME)} components"
    except AssetError as error:
        count = f"none ({error.cause})"
    return [*lines, f"vertices     {'; '.join(levels)}", f"shape space  {count}"]


def _file_lines(root: Path, manifest: Manifest) -> list[str]:
    def state(name: str) -> str:
        if name not in manifest.files:
            return f"missing; published at {_PUBLISHED}"
        try:
            verified_sha256(root, manifest, name)
            if name == CORRECTIVES_NAME:
                _correctives(root)
        except SomaError as error:
            return f"cannot be used: {error}"
        licence = manifest.files[name].get("licence", "Apache-2.0")
        return f"{(root / name).stat().st_size / 2**20:.1f} MiB, {licence}"

    names = (NEUTRAL_NAME, RIG_NAME, PROCEDURAL_NAME, CORRECTIVES_NAME)
    return [f"file         {name}: {state(name)}" for name in names]


def _model_lines() -> list[str]:
    """Model folders that are found, and what each installed backend still lacks."""
    from soma_core.plugin.registry import default_registry

    lines = [
        f"models       {folder}: {', '.join(sorted(path.name for path in folder.iterdir())) or 'empty'}"
        for name in _MODELS
        for folder in model_folders(name)
        if folder.is_dir()
    ]
    registry = default_registry()
    for entry in registry.entries():
        try:
            spec = registry.spec(entry.name)
        except SomaError as error:
            lines.append(f"backend      {entry.name}: broken ({error})")
            continue
        lacking = [str(file.path) for file in spec.files if not file.path.is_file()]
        state = (
            f"lacks {', '.join(lacking)}; see `soma backends show {entry.name}`" if lacking else "can be used"
        )
        lines.append(f"backend      {entry.name}: {state} ({spec.licence})")
    return lines


def list_landmarks(picture: Path | None = None) -> str:
    """Names and vertex ids of the canonical landmarks, one a line; drawn into a PNG where one is named."""
    if picture is not None:
        from soma_core.view.landmark_picture import draw_landmarks

        draw_landmarks(picture)
    return "\n".join(f"{number:>5}  {name}" for name, number in canonical_landmarks().items())

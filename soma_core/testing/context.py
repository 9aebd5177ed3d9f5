"""What the checks look at: one backend, its parts built when they are first asked for."""

from __future__ import annotations

import functools
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from hydra import compose, initialize_config_dir
from omegaconf import DictConfig
from torch import Tensor

from soma_core.config.schema import register_schemas
from soma_core.errors import InputError
from soma_core.layer import SomaLayer
from soma_core.obj import read_obj
from soma_core.paths import configs_dir
from soma_core.plugin.discovery import CORE_PACKAGE, Offer
from soma_core.plugin.registry import Registry, default_registry
from soma_core.plugin.spec import BackendSpec, Generator, Parameter
from soma_core.rig import load_canonical
from soma_core.rig.mesh import CanonicalMesh
from soma_core.rig.skeleton import Rig
from soma_core.skeleton.identity import Identity
from soma_core.testing.global_state import changes, snapshot
from soma_core.testing.import_probe import ImportProbe, probe_import
from soma_core.testing.samples import Change, changed_rows, random_rows
from soma_core.topology.correspondence import Correspondence, load_correspondence
from soma_core.topology.frames import METRES, native_to_canonical
from soma_core.topology.transfer import filled_vertices

__all__ = ["CPU", "Bodies", "Context", "WrapMeshes"]

CPU = torch.device("cpu")

_RANDOM_BODIES = 4
"""Random identities that the checks of bodies look at: enough to meet a fault that every body has."""

_OF_LIBRARIES = ("the warning filters",)
"""What libraries change when they are imported, which is not their users' to answer for."""

_CHUNK = 32
"""Bodies generated at a time, to bound memory."""


@dataclass(frozen=True, kw_only=True, eq=False)
class WrapMeshes:
    """The two files of the wrap pair as they are: where, vertices (n, 3) and triangles (t, 3) of each."""

    native_path: Path
    path: Path
    native: np.ndarray
    native_triangles: np.ndarray
    vertices: np.ndarray
    triangles: np.ndarray


@dataclass(frozen=True, kw_only=True, eq=False)
class Bodies:
    """Prepared identities; row 0 is the default body, the others are random.

    Attributes:
        params: parameters of each row.
        native: native vertices (b, n, 3), native unit and axes.
        identity: what the layer makes of the parameters.
    """

    params: Mapping[str, Tensor]
    native: Tensor
    identity: Identity

    def label(self, row: int) -> str:
        """How to name body `row` in a message."""
        return "the default body" if row == 0 else f"random body {row}"


class Context:
    """One backend under check. Everything is in float64 on the CPU and by the torch reference.

    Args:
        name: the backend.
        options: options that it is built with.
        registry: where it is looked up.
        canonical: mesh and rig; default: the shipped ones.

    Attributes:
        first_changes: what building the first generator changed, which imports what it needs; None before.
        first_written: files of the package that it wrote.
    """

    def __init__(
        self,
        name: str,
        *,
        options: Mapping[str, Any] | None = None,
        registry: Registry | None = None,
        canonical: tuple[CanonicalMesh, Rig] | None = None,
    ) -> None:
        self.name, self.options = name, dict(options or {})
        self.registry = registry or default_registry()
        self._canonical = canonical
        self.first_changes: list[str] | None = None
        self.first_written: list[str] = []

    @property
    def offer(self) -> Offer:
        """Who offers the backend."""
        return self.registry.offers(self.name)[0]

    @functools.cached_property
    def import_probe(self) -> ImportProbe:
        """What declaring does in a fresh interpreter."""
        return probe_import(self.offer)

    @functools.cached_property
    def composed(self) -> DictConfig:
        """Group ``backend`` as ``backend=<name>`` on the command line composes it."""
        name, registry = self.name, self.registry
        folders = [folder for _, folder in registry.config_dirs()]
        clash = registry.config_clashes().get(f"backend/{name}.yaml")
        if clash is not None:
            raise clash
        shipped = any((folder / "backend" / f"{name}.yaml").is_file() for folder in folders)
        if self.offer.package != CORE_PACKAGE and not shipped:
            raise registry.missing_config(name)
        register_schemas()
        paths = ", ".join(f"'file://{folder}'" for folder in folders)
        with initialize_config_dir(version_base="1.3", config_dir=str(configs_dir())):
            overrides = [f"backend={name}", f"hydra.searchpath=[{paths}]"]
            return compose("animate", overrides=overrides).backend

    @property
    def spec(self) -> BackendSpec:
        """The declaration."""
        return self.registry.spec(self.name)

    @functools.cached_property
    def canonical(self) -> tuple[CanonicalMesh, Rig]:
        """The canonical mesh, at the LOD that wrap pairs are made for, and its rig."""
        return self._canonical or load_canonical("mid")

    @property
    def mesh(self) -> CanonicalMesh:
        """The canonical mesh."""
        return self.canonical[0]

    @property
    def rig(self) -> Rig:
        """The rig of the canonical mesh."""
        return self.canonical[1]

    @property
    def metres(self) -> float:
        """Length of one native unit."""
        return METRES[self.spec.unit]

    @property
    def native_frame(self) -> np.ndarray:
        """Matrix (3, 3) from the generator's unit and axes to metres, +Y up, +Z forward."""
        return self.metres * native_to_canonical(self.spec.up, self.spec.forward)

    @property
    def wrap_frame(self) -> np.ndarray:
        """The same for the wrap pair, whose axes may be declared apart."""
        up = self.spec.wrap_up or self.spec.up
        return self.metres * native_to_canonical(up, self.spec.wrap_forward or self.spec.forward)

    @functools.cached_property
    def wrap(self) -> WrapMeshes:
        """The wrap pair as read from its files; only for backends that declare one."""
        pair = self.spec.wrap
        assert pair is not None
        native, native_triangles = read_obj(pair.native)
        vertices, triangles = read_obj(pair.wrap)
        return WrapMeshes(
            native_path=pair.native, path=pair.wrap, native=native, native_triangles=native_triangles,
            vertices=vertices, triangles=triangles,
        )  # fmt: skip

    @functools.cached_property
    def covered(self) -> np.ndarray:
        """(v,) bool: canonical vertices that the wrap defines, all but the filled ones."""
        covered = np.ones(self.mesh.vertex_count, bool)
        covered[filled_vertices(self.spec, self.mesh)] = False
        return covered

    @functools.cached_property
    def correspondence(self) -> Correspondence:
        """Where each canonical vertex lies on the native surface; only for backends with a wrap pair."""
        assert self.spec.wrap is not None
        return load_correspondence(self.spec.wrap, self.mesh)

    @property
    def native_count(self) -> int:
        """Number of vertices that the generator must return."""
        return self.mesh.vertex_count if self.spec.wrap is None else len(self.wrap.native)

    def new_generator(self, *, dtype: torch.dtype = torch.float64, device: torch.device = CPU) -> Generator:
        """Build another generator; what the first one changes in the process is kept in `first_changes`."""
        with torch.enable_grad():
            before, files = snapshot(), self._files() if self.first_changes is None else {}
            made = self.registry.generator(self.name, device=device, dtype=dtype, options=self.options)
            if self.first_changes is None:
                self.first_changes = [each for each in changes(before) if each not in _OF_LIBRARIES]
                self.first_written = sorted({name for name, _ in self._files().items() - files.items()})
        return made

    def _files(self) -> dict[str, tuple[int, int]]:
        """When each file of the package was written last, and its size; bytecode apart."""
        module = sys.modules.get(self.offer.package)
        roots = [Path(each) for each in getattr(module, "__path__", ())]
        return {
            str(path.relative_to(root)): (path.stat().st_mtime_ns, path.stat().st_size)
            for root in roots
            for path in root.rglob("*")
            if path.is_file() and "__pycache__" not in path.parts
        }

    @functools.cached_property
    def generator(self) -> Generator:
        """A generator that is kept."""
        return self.new_generator()

    @functools.cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        """Parameters that the generator takes with these options.

        All without a group, and of the others those that it does not refuse by an InputError.
        """
        grouped = [item for item in self.spec.params if item.group]
        if all(map(self._takes, grouped[:1])) and self._takes(*grouped):
            return self.spec.params
        return tuple(item for item in self.spec.params if not item.group or self._takes(item))

    def _takes(self, *grouped: Parameter) -> bool:
        given = [item for item in self.spec.params if not item.group or item in grouped]
        try:
            with torch.no_grad():
                self.generator.rest(
                    {item.name: torch.full((1, *item.shape), item.default).double() for item in given}
                )
        except InputError:
            return False
        return True

    def default_params(self, count: int = 1, *, dtype: torch.dtype = torch.float64) -> dict[str, Tensor]:
        """`count` rows of defaults of the parameters without a group."""
        plain = [item for item in self.spec.params if not item.group]
        return {item.name: torch.full((count, *item.shape), item.default, dtype=dtype) for item in plain}

    def random_params(
        self, count: int = _RANDOM_BODIES, *, seed: int = 0, dtype: torch.dtype = torch.float64
    ) -> dict[str, Tensor]:
        """`count` random identities inside the declared ranges."""
        return random_rows(self.parameters, count, seed=seed, dtype=dtype)

    def generated(self, changes: Sequence[Change]) -> Iterator[tuple[Change, Tensor]]:
        """Each change with the native body (n, 3) that it gives."""
        for start in range(0, len(changes), _CHUNK):
            part = changes[start : start + _CHUNK]
            with torch.no_grad():
                bodies = self.generator.rest(changed_rows(self.parameters, part, dtype=torch.float64))
            yield from zip(part, bodies, strict=True)

    @functools.cached_property
    def layer(self) -> SomaLayer:
        """The forward path, transferred vertex by vertex, on the public joints alone."""
        return SomaLayer(
            self.name, options=self.options, dtype=torch.float64, kernels="torch", exact=True,
            procedural=False, canonical=self._canonical, registry=self.registry,
        )  # fmt: skip

    @functools.cached_property
    def bodies(self) -> Bodies:
        """The default body and random ones, transferred to the canonical mesh."""
        params = {
            name: torch.cat((torch.full_like(value[:1], self._default(name)), value))
            for name, value in self.random_params().items()
        }
        with torch.no_grad():
            return Bodies(
                params=params, native=self.generator.rest(params), identity=self.layer.identity(params)
            )

    def _default(self, name: str) -> float:
        return next(item.default for item in self.spec.params if item.name == name)

    def vertex(self, index: int) -> str:
        """How to name canonical vertex `index` in a message."""
        segments = [name for name, ids in self.mesh.segments.items() if index in ids]
        return f"canonical vertex {index}" + (f" ({', '.join(segments)})" if segments else "")

"""Distributions laid out on disk as pip leaves them: wheels and editable installs of the usual builders."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

IMPORTED = "raise RuntimeError('imported')\n"
"""Body of a package that a test must not import."""

_FINDER = """\
import importlib.util, sys
FOLDER = {folder!r}
class Finder:
    @classmethod
    def find_spec(cls, fullname, path=None, target=None):
        if fullname == {package!r}:
            return importlib.util.spec_from_file_location(fullname, FOLDER + "/__init__.py")
def install():
    sys.meta_path.append(Finder)
"""
"""What an editable install by setuptools of a flat layout leaves: a finder that knows one package."""


@dataclass(kw_only=True)
class Distribution:
    """A backend's distribution: what its wheel would hold."""

    name: str
    body: str = IMPORTED
    version: str = "1.0"
    distribution: str = ""
    package: str = ""
    requires: tuple[str, ...] = ()
    configs: Mapping[str, str] | None = None
    points: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.distribution = self.distribution or f"soma-backend-{self.name}"
        self.package = self.package or f"soma_backend_{self.name}"
        self.points = self.points or {self.name: self.package}
        if self.configs is None:
            text = f"name: {self.name}\nparams: {{size: null}}\noptions: {{}}\n"
            self.configs = {f"backend/{self.name}.yaml": text}

    def write_package(self, root: Path) -> Path:
        """Write the package into `root` and return its folder."""
        folder = root / self.package
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "__init__.py").write_text(self.body)
        for name, text in (self.configs or {}).items():
            path = folder / "configs" / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text)
        return folder

    def write_metadata(self, site: Path, *, source: Path | None = None, editable: bool = False) -> Path:
        """Write the dist-info folder into `site`, naming the local folder it was installed from."""
        info = site / f"{self.distribution.replace('-', '_')}-{self.version}.dist-info"
        info.mkdir(parents=True)
        lines = ["Metadata-Version: 2.1", f"Name: {self.distribution}", f"Version: {self.version}"]
        lines += [f"Requires-Dist: {each}" for each in self.requires]
        (info / "METADATA").write_text("\n".join(lines) + "\n")
        points = "".join(f"{name} = {target}\n" for name, target in self.points.items())
        (info / "entry_points.txt").write_text(f"[soma_core.backends]\n{points}")
        if source is not None:
            url = {"url": source.as_uri(), "dir_info": {"editable": True} if editable else {}}
            (info / "direct_url.json").write_text(json.dumps(url))
        return info

    def install(self, site: Path) -> Path:
        """Install a wheel: package and metadata in one folder; return the package."""
        self.write_metadata(site)
        return self.write_package(site)

    def install_editable(
        self, site: Path, checkout: Path, *, finder: bool = False, src: bool = False
    ) -> Path:
        """Install a checkout: its folder on the path, or (`finder`) an import hook that knows the package."""
        folder = self.write_package(checkout / "src" if src else checkout)
        self.write_metadata(site, source=checkout, editable=True)
        if finder:
            hook = f"__editable___{self.package}_finder"
            text = _FINDER.format(folder=str(folder), package=self.package)
            (site / f"{hook}.py").write_text(text)
            (site / f"__editable__.{self.package}.pth").write_text(f"import {hook}; {hook}.install()\n")
        else:
            (site / f"_{self.package}.pth").write_text(f"{folder.parent}\n")
        return folder

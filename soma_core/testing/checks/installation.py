"""Checks of what is installed: the import and the configuration."""

from __future__ import annotations

from typing import Any

from hydra.errors import HydraException
from omegaconf import OmegaConf

from soma_core.plugin.checks import CheckFailedError, check
from soma_core.plugin.options import checked_options, options_by_name
from soma_core.points.point_set import load_point_set
from soma_core.testing.context import Context

__all__ = ["CHECKS"]

_HEAVY = ("torch", "warp", "pxr", "trimesh", "jax", "tensorflow")
"""Packages that take a second or more to import; listing and `soma --help` must not pay for them."""


@check(
    "import-light",
    mend="import them inside `soma_generator`, or under `if TYPE_CHECKING:`",
    level="core",
    needs=("declares",),
)
def import_light(context: Context) -> None:
    """Importing and declaring loads no heavy library."""
    probe = context.import_probe
    loaded = [name for name in _HEAVY if name in probe.packages]
    if probe.error or loaded:
        raise CheckFailedError(
            f"import of {context.offer.target}",
            got=probe.error or f"an import of {', '.join(loaded)}",
            expected=f"a declaration that imports none of {', '.join(_HEAVY)}",
            fix="Import them inside soma_generator, or under `if TYPE_CHECKING:` for annotations.",
        )


@check("import-silent", mend="take out `print`; use `logging`", level="core", needs=("declares",))
def import_silent(context: Context) -> None:
    """Importing and declaring writes nothing and warns of nothing."""
    output = context.import_probe.output
    if output:
        raise CheckFailedError(
            f"import of {context.offer.target}",
            got=f"the output {output.splitlines()[0]!r:.200}",
            expected="nothing on stdout or stderr, no warnings",
            fix="Take the output out, or use logging inside soma_generator.",
        )


@check(
    "config-composes", mend="add the file; its `name:` is the backend's", level="core", needs=("declares",)
)
def config_composes(context: Context) -> None:
    """The package ships configs/backend/<name>.yaml, and hydra composes it; its point sets read."""
    where = f"configs/backend/{context.name}.yaml"
    try:
        name = context.composed.name
    except HydraException as error:
        raise CheckFailedError(
            where,
            got=f"{' '.join(str(error).split()):.200}",
            expected="a file with the keys name, params and options",
            fix="Correct the file.",
        ) from error
    if name != context.name:
        raise CheckFailedError(
            where, got=f"name: {name}", expected=f"name: {context.name}", fix="Correct the file."
        )
    own = [each for each, offer in context.registry.config_offers().items() if offer.name == context.name]
    for path in (path for folder in own for path in (folder / "point_sets").glob("*.json")):
        load_point_set(path)


@check(
    "config-complete",
    mend="list them; `null` is the default",
    level="core",
    needs=("config-composes", "options", "parameter-defaults"),
)
def config_complete(context: Context) -> None:
    """The config lists every parameter and option, with the defaults of Python."""
    config = OmegaConf.to_container(context.composed)
    assert isinstance(config, dict)
    options = options_by_name(checked_options(context.spec, {}))
    _compare(context, "params", config["params"], {item.name: item.default for item in context.spec.params})
    _compare(context, "options", config["options"], options)


def _compare(context: Context, key: str, found: dict[str, Any], declared: dict[str, Any]) -> None:
    where = f"configs/backend/{context.name}.yaml: {key}"
    missing = [name for name in declared if name not in found]
    strange = [name for name in found if name not in declared]
    if missing or strange:
        parts = [f"no {', '.join(missing)}"] * bool(missing) + [f"undeclared {', '.join(strange)}"] * bool(
            strange
        )
        raise CheckFailedError(
            where,
            got=f"{'; '.join(parts):.200}",
            expected=f"the {len(declared)} declared names",
            fix="List each of them: the command line sets no key that the file lacks.",
        )
    for name, value in found.items():
        if value is not None and value != declared[name] and str(value) != str(declared[name]):
            raise CheckFailedError(
                f"{where}.{name}",
                got=repr(value),
                expected=f"{declared[name]!r}, the default in Python, or null",
                fix="Make them equal, so that the command line and Python give one body.",
            )


CHECKS = (import_light, import_silent, config_composes, config_complete)

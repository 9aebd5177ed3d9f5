"""Checks of the declaration: what a backend says about itself before anything is built."""

from __future__ import annotations

from soma_core.plugin.checks import CheckFailedError, check
from soma_core.plugin.options import checked_options
from soma_core.testing.context import Context
from soma_core.topology.transfer import filled_vertices

__all__ = ["CHECKS"]


@check("declares", mend="see the stages `import`, `hooks` and `spec` below", level="core")
def declares(context: Context) -> None:
    """The plugin imports, implements the hooks and declares a backend."""
    context.registry.spec(context.name)


@check("licence", mend='state `licence="..."`', level="core", needs=("declares",))
def licence(context: Context) -> None:
    """The declaration states the licence of the model."""
    if not context.spec.licence.strip():
        raise CheckFailedError(
            "BackendSpec.licence",
            got=repr(context.spec.licence),
            expected="the licence of the model and its data, by SPDX id or in words",
            fix='State it, for example licence="CC-BY-NC-4.0".',
        )


@check(
    "described",
    mend="say what it changes, and what the ends of its range mean",
    level="core",
    needs=("declares",),
)
def described(context: Context) -> None:
    """The backend and each parameter are described in one line."""
    texts = {"BackendSpec.description": context.spec.description}
    texts |= {f"description of the parameter {item.name}": item.description for item in context.spec.params}
    for where, text in texts.items():
        if not text.strip() or "\n" in text:
            raise CheckFailedError(
                where,
                got=f"{text!r:.60}",
                expected="one line for people, which `soma backends show` prints",
                fix="Say what it changes, and what the ends of its range mean.",
            )


@check(
    "parameter-defaults",
    mend="correct default or range; values outside the range are allowed, but not sampled",
    level="core",
    needs=("declares",),
)
def parameter_defaults(context: Context) -> None:
    """Every parameter has its default inside its range."""
    for item in context.spec.params:
        low, high = item.range
        if not low <= item.default <= high:
            raise CheckFailedError(
                f"parameter {item.name}",
                got=f"default {item.default:g} and range {low:g} to {high:g}",
                expected="the default inside the range",
                fix="Correct default or range: sampling and the checks stay inside the range.",
            )


def _no_options(context: Context) -> str:
    return "" if context.spec.options else "the backend has no options"


@check(
    "options",
    mend="give the fields of the dataclass defaults",
    level="core",
    needs=("declares",),
    unless=_no_options,
)
def options(context: Context) -> None:
    """Every option has a default: the backend works by its name alone."""
    checked_options(context.spec, {})


@check("fill-segments", mend="`mouth_bag`, `eye_bags`", level="core", needs=("declares",))
def fill_segments(context: Context) -> None:
    """The segments to fill exist on the canonical mesh."""
    filled_vertices(context.spec, context.mesh)


def _no_files(context: Context) -> str:
    return "" if context.spec.files else "the backend needs no files of the user"


@check(
    "files-named",
    mend="add `description`, and `url` or `command`",
    level="core",
    needs=("declares",),
    unless=_no_files,
)
def files_named(context: Context) -> None:
    """Each file that the user must supply has a path and a source."""
    for needed in context.spec.files:
        parts = {
            "an absolute path": needed.path.is_absolute(),
            "a description": bool(needed.description.strip()),
            "a url or a command": bool(needed.url.strip() or needed.command.strip()),
        }
        missing = [part for part, there in parts.items() if not there]
        if missing:
            raise CheckFailedError(
                f"FileNeeded {needed.path}",
                got=f"no {', no '.join(part.partition(' ')[2] for part in missing)}",
                expected=", ".join(parts),
                fix="Add it: the message about a missing file tells the user how to come by it.",
            )


@check("own-checks", mend="return a list of `Check`, ids once each", level="core", needs=("declares",))
def own_checks(context: Context) -> None:
    """The hooks soma_checks and soma_motions, where they are, give what they must."""
    context.registry.checks(context.name)
    context.registry.formats(context.name)


CHECKS = (
    declares, licence, described, parameter_defaults, options, fill_segments, files_named, own_checks,
)  # fmt: skip

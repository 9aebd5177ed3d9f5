"""Errors of the public boundary: each names what was wrong and how to mend it."""

from __future__ import annotations

__all__ = ["AssetError", "InputError", "SomaError", "check_type"]


class SomaError(Exception):
    """Base of every error that SOMA Core raises on purpose; it can be pickled, as pools do."""

    def __reduce__(self) -> tuple[object, ...]:
        """Make the error again from its text and what it names."""
        return _restored, (type(self), self.args, vars(self))


def _restored(kind: type[SomaError], args: tuple[object, ...], names: dict[str, object]) -> SomaError:
    error = kind.__new__(kind, *args)
    error.args = args  # an OSError takes them from its constructor alone
    vars(error).update(names)
    return error


_LONGEST = 600
"""Letters of what was found in a file that are told; a number of a damaged one may have thousands."""


def _told(found: object) -> str:
    """What was found, for a terminal: no control characters, no halves of letters, and not too long."""
    text = str(found)
    if not text.isprintable():
        text = "".join(each if each.isprintable() or each == "\n" else ascii(each)[1:-1] for each in text)
    if len(text) <= _LONGEST:
        return text
    return f"{text[: _LONGEST // 2]} ... ({len(text)} letters) ... {text[-_LONGEST // 4 :]}"


class InputError(SomaError, ValueError):
    """An argument was refused.

    The text reads ``<argument>: got <got>, expected <expected>. <fix>``.
    """

    def __init__(self, argument: str, *, got: object, expected: object, fix: str) -> None:
        self.argument, self.got, self.expected, self.fix = argument, got, expected, fix
        super().__init__(f"{argument}: got {_told(got)}, expected {expected}. {fix}")


class AssetError(SomaError):
    """A file that SOMA Core needs is missing, damaged or of another revision.

    The text reads ``<path>: <cause>. <fix>``.
    """

    def __init__(self, path: object, *, cause: str, fix: str) -> None:
        self.path, self.cause, self.fix = str(path), cause, fix
        super().__init__(f"{path}: {_told(cause)}. {fix}")


def check_type(argument: str, value: object, *kinds: type, fix: str) -> None:
    """Refuse (InputError) what is of none of these types."""
    if isinstance(value, kinds):
        return
    names = ["None" if kind is type(None) else kind.__name__ for kind in kinds]
    plain = isinstance(value, str | int | float)
    got = f"{value!r} ({type(value).__name__})" if plain else f"a value of type {type(value).__name__}"
    raise InputError(argument, got=got, expected=" or ".join(names), fix=fix)

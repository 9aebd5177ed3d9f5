"""The stack machine that a pickle is a program for, without the instructions that look up or call.

Of the instructions only those are known here that lay out data. Where the program names a class or a
function, the name must be on a list, and all that is kept is a record of the name and what it would have
been called with. Nothing is hashed or compared but texts and small integers, every length is checked
against the file, and the number of instructions is bounded, so no program runs for long.
"""

from __future__ import annotations

import codecs
import mmap
import re
import struct
import warnings
from collections.abc import Callable
from typing import Any, NamedTuple

__all__ = [
    "STORED", "Global", "Machine", "PickleRules", "Record", "RefusedPickleError", "run_machine", "run_pickle",
]  # fmt: skip

_LONG_TEXT = 1024
"""Bytes from which on a string is left in the file until it is asked for."""

_LONGEST_NUMBER = 64
_LONGEST_NARROW = 2**20
"""Bytes of text from which on it must be Latin-1: one wider character makes four bytes of each."""

_WIDE = re.compile(rb"[\xc4-\xff]")
"""First bytes, in UTF-8, of what lies beyond Latin-1."""

_LARGEST_KEY, _MOST_KEYS = 2**31, 2**16
"""Of integers as keys: Python hashes them to themselves, and thousands can be made to collide."""


class Global(NamedTuple):
    """Name of a class or function; never looked up."""

    module: str
    name: str

    def __str__(self) -> str:
        return f"{self.module}.{self.name}"


class Record:
    """What a pickle would have made by calling `function`; `state` is what it would then have been given."""

    __slots__ = ("arguments", "function", "state")

    def __init__(self, function: Global, arguments: tuple[Any, ...]) -> None:
        self.function, self.arguments, self.state = function, arguments, None


class RefusedPickleError(ValueError):
    """Why this is nothing to read, said before it is known which file it is."""


class PickleRules(NamedTuple):
    """What a pickle of one kind may hold.

    `names` may be named; `purpose` says of what they are part; `stored` allows references to what lies
    outside of the pickle, which come as records of :data:`STORED`.
    """

    names: frozenset[Global]
    purpose: str
    stored: bool = False
    most_instructions: int = 1_000_000


STORED = Global("", "stored outside of the pickle")


def run_pickle(data: mmap.mmap | bytes, rules: PickleRules) -> Any:
    """Contents of a pickle of protocols 0 to 5 as None, bool, int, float, text, bytes, tuple, list, dict.

    Strings of Python 2 are read as Latin-1; long ones come as a memoryview of the file. Sets come as
    lists; everything else as a :class:`Record`.

    Raises:
        RefusedPickleError: damaged, or with names, keys or instructions beyond the rules.
    """
    return run_machine(Machine(data, rules))


def run_machine(machine: Machine) -> Any:
    """The same of a machine that is more than this one.

    Raises:
        RefusedPickleError: as :func:`run_pickle`.
    """
    try:
        return machine.run()
    except RefusedPickleError:
        raise
    except (IndexError, KeyError, TypeError, ValueError, struct.error, OverflowError, MemoryError) as error:
        raise RefusedPickleError(f"is no sound pickle ({type(error).__name__})") from error


class _Ordered(dict[Any, Any]):
    """A dictionary that the pickle makes by its class, and changes by what it calls its state."""


_DICTIONARIES = (Global("collections", "OrderedDict"), Global("collections", "defaultdict"))
_SETS = (Global("builtins", "set"), Global("__builtin__", "set"))


class Machine:
    """A pickle under way."""

    def __init__(self, file: mmap.mmap | bytes, rules: PickleRules) -> None:
        self._file, self._data, self._at = file, memoryview(file), 0
        self._rules, self._integer_keys = rules, 0
        self._stack: list[Any] = []
        self._marks: list[int] = []
        self._memo: dict[int, Any] = {}

    def run(self) -> Any:
        """Follow the program to its end and give what it leaves."""
        for _ in range(self._rules.most_instructions):
            code = self._take(1)[0]
            if code == ord("."):
                return self._stack[-1]
            step = _STEPS.get(code)
            if step is None:
                name = f"{chr(code)!r}" if 32 < code < 127 else f"{code:#04x}"
                raise RefusedPickleError(
                    f"is no pickle of plain data: instruction {name} at byte {self._at - 1}"
                )
            step(self)
        most = self._rules.most_instructions
        raise RefusedPickleError(f"is not {self._rules.purpose}: a pickle of more than {most} instructions")

    # Reading

    def _take(self, count: int) -> memoryview:
        end = self._at + count
        if count < 0 or end > len(self._data):
            raise RefusedPickleError(
                f"is cut off: {count} bytes are wanted at byte {self._at} of {len(self._data)}"
            )
        taken = self._data[self._at : end]
        self._at = end
        return taken

    def _line(self) -> bytes:
        end = self._file.find(b"\n", self._at)
        if end < 0:
            raise RefusedPickleError(f"is cut off: a line has no end at byte {self._at}")
        line = bytes(self._data[self._at : end])
        self._at = end + 1
        return line

    def number(self, layout: str) -> int:
        """Take a number of this layout."""
        return struct.unpack(layout, self._take(struct.calcsize(layout)))[0]

    def text(self, count: int) -> str | memoryview:
        """A string of Python 2: text where it is short, since keys are; bytes where it is long."""
        taken = self._take(count)
        return str(taken, "latin-1") if count < _LONG_TEXT else taken

    # The stack

    def push(self, value: Any) -> None:
        """Put a value onto the stack."""
        self._stack.append(value)

    def pop(self) -> Any:
        """Take the uppermost value, which must not lie under a mark."""
        if self._marks and len(self._stack) <= self._marks[-1]:
            raise RefusedPickleError("is no sound pickle: it takes a value that is not there")
        return self._stack.pop()

    def mark(self) -> None:
        """Remember how high the stack is."""
        self._marks.append(len(self._stack))

    def pop_mark(self) -> list[Any]:
        """Take all that lies above the last mark."""
        start = self._marks.pop()
        items = self._stack[start:]
        del self._stack[start:]
        return items

    def pop_tuple(self, count: int) -> None:
        """Put the uppermost values into a tuple."""
        items = tuple(self.pop() for _ in range(count))[::-1]
        self.push(items)

    def append(self, items: list[Any]) -> None:
        """Append to the uppermost list."""
        target = self._stack[-1]
        if type(target) is not list:
            raise RefusedPickleError(f"is no plain data: it appends to {_kind(target)}")
        target.extend(items)

    def update(self, items: list[Any]) -> None:
        """Set items of the uppermost dictionary: keys and values in turn."""
        target = self._stack[-1]
        if type(target) not in (dict, _Ordered) or len(items) % 2:
            raise RefusedPickleError(f"is no plain data: it sets items of {_kind(target)}")
        for key, value in zip(items[::2], items[1::2], strict=True):
            if type(key) not in (str, int):  # the hash of nested tuples can take for ever
                raise RefusedPickleError(f"is no plain data: a key is {_kind(key)}")
            if type(key) is int:
                self._count_key(key)
            target[key] = value

    def _count_key(self, key: int) -> None:
        self._integer_keys += 1
        if not -_LARGEST_KEY < key < _LARGEST_KEY or self._integer_keys > _MOST_KEYS:
            raise RefusedPickleError(
                f"is no plain data: more than {_MOST_KEYS} integers as keys, or one beyond {_LARGEST_KEY}"
            )

    # What stands for classes and calls

    def name(self, module: Any, name: Any) -> None:
        """Put a name that the rules allow onto the stack."""
        if type(module) is not str or type(name) is not str:
            raise RefusedPickleError(f"names a class by {_kind(module)} and {_kind(name)}")
        if (module, name) not in self._rules.names:
            shown = ascii(f"{module:.80}.{name:.80}")[1:-1]
            raise RefusedPickleError(f"asks for {shown}, which is no part of {self._rules.purpose}")
        self.push(Global(module, name))

    def call(self) -> None:
        """Make a record of a call."""
        arguments, function = self.pop(), self.pop()
        if type(function) is not Global or type(arguments) is not tuple:
            raise RefusedPickleError(f"is no plain data: it calls {_kind(function)}")
        if function in _SETS and all(type(values) is list for values in arguments):
            self.push([value for values in arguments for value in values])
            return
        empty = function in _DICTIONARIES and not any(type(value) is not Global for value in arguments)
        self.push(_Ordered() if empty else Record(function, arguments))

    def stored(self) -> None:
        """Make a record of a reference to what lies outside."""
        if not self._rules.stored:
            raise RefusedPickleError("is no pickle of plain data: it refers to something outside of it")
        self.push(Record(STORED, (self.pop(),)))

    def build(self) -> None:
        """Give a record its state."""
        state, target = self.pop(), self._stack[-1]
        if type(target) is _Ordered:
            return
        if type(target) is not Record:
            raise RefusedPickleError(f"is no plain data: it changes {_kind(target)}")
        target.state = state

    # Memory of what was made before

    def put(self, index: int) -> None:
        """Remember the uppermost value under a number."""
        if not 0 <= index < self._rules.most_instructions:  # integers that collide would take for ever
            raise RefusedPickleError(f"is no sound pickle: it remembers {index} values")
        self._memo[index] = self._stack[-1]

    def memoize(self) -> None:
        """Remember the uppermost value under the next number."""
        self._memo[len(self._memo)] = self._stack[-1]

    def get(self, index: int) -> None:
        """Put a remembered value onto the stack."""
        self.push(self._memo[index])

    # Numbers and strings written as lines

    def line_number(self) -> int:
        """Take a whole number that is written as a line."""
        return _parsed(self._line(), int)

    def line_integer(self) -> None:
        """Put a number or truth value that is written as a line onto the stack."""
        line = self._line()
        self.push({b"00": False, b"01": True}.get(line) if line in (b"00", b"01") else _parsed(line, int))

    def line_float(self) -> None:
        """Put a number that is written as a line onto the stack."""
        self.push(_parsed(self._line(), float))

    def line_string(self) -> None:
        """Put a string in quotes onto the stack."""
        line = self._line().strip()
        if len(line) < 2 or line[:1] not in (b"'", b'"') or line[-1:] != line[:1]:
            raise RefusedPickleError("is no sound pickle: a string is not in quotes")
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of escapes that newer versions of Python frown upon
            text = codecs.escape_decode(line[1:-1])[0]
        self.push(str(text, "latin-1") if len(text) < _LONG_TEXT else memoryview(text))

    def line_unicode(self) -> None:
        """Put a text that is written as a line onto the stack."""
        self.push(str(self._line(), "raw-unicode-escape"))

    def line_name(self) -> None:
        """Put a name that is written as two lines onto the stack."""
        module = str(self._line(), "utf-8", "replace")
        self.name(module, str(self._line(), "utf-8", "replace"))

    def stack_name(self) -> None:
        """Put the name that two texts on the stack make onto it."""
        name, module = self.pop(), self.pop()
        self.name(module, name)


def _parsed(line: bytes, kind: Callable[[bytes], Any]) -> Any:
    if len(line) > _LONGEST_NUMBER:
        raise RefusedPickleError(f"holds a number of {len(line)} digits")
    return kind(line.strip().removesuffix(b"L"))


def _kind(value: Any) -> str:
    return str(value) if type(value) is Global else f"a {type(value).__name__}"


def _bytes(layout: str) -> Callable[[Machine], None]:
    return lambda machine: machine.push(machine._take(machine.number(layout)))


def _text(layout: str) -> Callable[[Machine], None]:
    return lambda machine: machine.push(machine.text(machine.number(layout)))


def _unicode(layout: str) -> Callable[[Machine], None]:
    return lambda machine: machine.push(_decoded(machine._take(machine.number(layout))))


def _decoded(text: memoryview) -> str:
    if len(text) >= _LONGEST_NARROW and _WIDE.search(text):
        raise RefusedPickleError(f"holds a text of {len(text)} bytes, which are no array")
    return str(text, "utf-8", "surrogatepass")


def _number(layout: str) -> Callable[[Machine], None]:
    return lambda machine: machine.push(machine.number(layout))


def _long(layout: str) -> Callable[[Machine], None]:
    return lambda machine: machine.push(
        int.from_bytes(machine._take(machine.number(layout)), "little", signed=True)
    )


def _constant(value: object) -> Callable[[Machine], None]:
    return lambda machine: machine.push(value)


def _discard_mark(machine: Machine) -> None:
    machine.pop_mark()


def _dictionary(machine: Machine) -> None:
    items = machine.pop_mark()
    machine.push({})
    machine.update(items)


def _set_item(machine: Machine) -> None:
    value, key = machine.pop(), machine.pop()
    machine.update([key, value])


_STEPS: dict[int, Callable[[Machine], object]] = {
    ord(code): step
    for code, step in {
        "\x80": lambda m: m.number("<B"),  # the protocol, which the instructions tell better
        "\x95": lambda m: m.number("<Q"),  # a frame says how much to read ahead
        "(": Machine.mark, "0": Machine.pop, "1": _discard_mark,
        "2": lambda m: m.push(m._stack[-1]),
        "N": _constant(None), "\x88": _constant(True), "\x89": _constant(False),  # noqa: FBT003
        "I": Machine.line_integer, "L": lambda m: m.push(m.line_number()), "F": Machine.line_float,
        "K": _number("<B"), "M": _number("<H"), "J": _number("<i"), "G": _number(">d"),
        "\x8a": _long("<B"), "\x8b": _long("<i"),
        "S": Machine.line_string, "V": Machine.line_unicode, "U": _text("<B"), "T": _text("<i"),
        "\x8c": _unicode("<B"), "X": _unicode("<I"), "\x8d": _unicode("<Q"),
        "C": _bytes("<B"), "B": _bytes("<I"), "\x8e": _bytes("<Q"), "\x96": _bytes("<Q"),
        ")": lambda m: m.push(()), "t": lambda m: m.push(tuple(m.pop_mark())),
        "\x85": lambda m: m.pop_tuple(1), "\x86": lambda m: m.pop_tuple(2), "\x87": lambda m: m.pop_tuple(3),
        "]": lambda m: m.push([]), "l": lambda m: m.push(m.pop_mark()), "\x8f": lambda m: m.push([]),
        "\x91": lambda m: m.push(m.pop_mark()),
        "a": lambda m: m.append([m.pop()]), "e": lambda m: m.append(m.pop_mark()),
        "\x90": lambda m: m.append(m.pop_mark()),
        "}": lambda m: m.push({}), "d": _dictionary, "s": _set_item, "u": lambda m: m.update(m.pop_mark()),
        "p": lambda m: m.put(m.line_number()), "q": lambda m: m.put(m.number("<B")),
        "r": lambda m: m.put(m.number("<I")), "\x94": Machine.memoize,
        "g": lambda m: m.get(m.line_number()), "h": lambda m: m.get(m.number("<B")),
        "j": lambda m: m.get(m.number("<I")),
        "c": Machine.line_name, "\x93": Machine.stack_name,
        "R": Machine.call, "\x81": Machine.call, "b": lambda m: m.build(), "Q": Machine.stored,
    }.items()
}  # fmt: skip

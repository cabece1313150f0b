"""The small machine that a pickle is a program for, without the power to import or call anything.

It knows plain values, containers and the constructors that it is given; any other name ends the reading. What a file
can make it hold or do is bounded by the number of bytes that are really there.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterable
from typing import BinaryIO

from su3d_bench.core.files.unpacking import Allowance
from su3d_bench.formats.pickles.pickle_constructors import (
    Budget,
    Constructors,
    Forgotten,
    Inert,
    Named,
    RefusedError,
    Unbuilt,
    clip,
)

NEWEST_PROTOCOL = 5
# A map of ConceptGraphs takes less than a million, 100 for a detection of a kilobyte or more; each may make an object.
FREE_OPERATIONS, MOST_OPERATIONS = 1_000_000, 10_000_000
MOST_KEPT = 4 << 30  # bytes of all texts and arrays together
MOST_INTEGER_BYTES = 32
MOST_LINE = 1 << 20
CHUNK = 1 << 16
FORGET_FROM = 1 << 12  # smaller payloads are kept: they cost less than the look at where they belong
MOST_MEMO = 1 << 32  # what the binary operations can say
MOST_KEY = 1 << 60  # larger integers can be crafted to share one place in a dict
TRUTHS = {b"00": False, b"01": True}  # how protocols 0 and 1 write them


class PickleMachine:
    """Stack, marks and memory of one pickle; ``n_read`` is how far it has come."""

    def __init__(
        self,
        stream: BinaryIO,
        n_bytes: int,
        n_packed: int,
        constructors: Constructors,
        persistent: Callable[[object], object] | None,
        forget: frozenset[str],
        is_last: bool = True,
    ) -> None:
        self._stream, self._n_bytes, self.n_read = stream, n_bytes, 0
        self._constructors, self._persistent, self._forget = constructors, persistent, forget
        self._is_last = is_last  # nothing may stand behind it
        self._stack: list[object] = []
        self._frames: list[list[object]] = []  # what lies below each mark
        self._memo: dict[int, object] = {}
        self._n_kept = 0
        self._allowance = Allowance(n_packed)
        self._n_operations = min(MOST_OPERATIONS, max(FREE_OPERATIONS, n_packed))
        self._budget = Budget()

    def run(self) -> object:
        """The value that the pickle describes; ``RefusedError`` where it is damaged or more than plain data."""
        read = self._stream.read
        for _ in range(self._n_operations):
            code = read(1)
            self.n_read += 1
            if code == b".":
                return self._end()
            operation = OPERATIONS.get(code)
            if operation is None:
                raise RefusedError(f"operation 0x{code.hex()} is not read" if code else "it ends in the middle")
            operation(self)
        raise RefusedError(f"it takes more than {self._n_operations} operations")

    def _end(self) -> object:
        if len(self._stack) != 1 or self._frames:
            raise RefusedError("it does not end with one value")
        if self._is_last and self._stream.read(1):
            raise RefusedError("more bytes stand after its end")
        return self._stack[0]

    # ---- bytes of the file

    def take(self, n: int) -> bytes:
        """The next ``n`` bytes."""
        self._pass(n)
        parts = [self._read(min(n, CHUNK))]  # in parts, so that a promise of more than is there reserves nothing
        n -= len(parts[0])
        while n:
            parts.append(self._read(min(n, CHUNK)))
            n -= len(parts[-1])
        return parts[0] if len(parts) == 1 else b"".join(parts)

    def _read(self, n: int) -> bytes:
        content = self._stream.read(n)
        if len(content) != n:
            raise RefusedError("it ends in the middle")
        return content

    def _pass(self, n: int) -> None:
        self._check_left(n)
        self.n_read += n

    def _check_left(self, n: int) -> None:
        if n > self._n_bytes - self.n_read:
            raise RefusedError(f"it promises {n} bytes, {max(self._n_bytes - self.n_read, 0)} are left")

    def line(self) -> bytes:
        """The next line, without its end."""
        line = self._stream.readline(MOST_LINE)
        self._pass(len(line))
        if not line.endswith(b"\n"):
            raise RefusedError("a line has no end")
        return line[:-1]

    def size(self, n: int) -> int:
        """The unsigned number in the next ``n`` bytes."""
        return int.from_bytes(self.take(n), "little")

    def payload(self, n: int) -> bytes | Forgotten:
        """The next ``n`` bytes, or their place where they are to be forgotten."""
        if n >= FORGET_FROM and self._forget and self._is_below_forgotten():
            self._pass(n)
            while n:
                n -= len(self._read(min(n, CHUNK)))
            return Forgotten()
        self._check_left(n)
        self._keep(n)
        self._budget.n_bytes += n
        return self.take(n)

    def _keep(self, n: int) -> None:
        self._n_kept += n
        if self._n_kept > MOST_KEPT:
            raise RefusedError(f"it holds more than {MOST_KEPT >> 30} GiB")
        self._allowance.spend(n)

    def _is_below_forgotten(self) -> bool:
        """Whether a list or dict is under way whose key, which lies right below it, is to be forgotten.

        A finished one is followed by the next key.
        """
        for frame in (*self._frames[-16:], self._stack):
            tail = frame[-8:]
            for key, value, above in zip(tail, tail[1:], [*tail[2:], None], strict=False):
                is_under_way = isinstance(value, list | dict) and not isinstance(above, str)
                if is_under_way and isinstance(key, str) and key in self._forget:
                    return True
        return False

    # ---- stack and memory

    def push(self, value: object) -> None:
        self._stack.append(value)

    def _pop(self) -> object:
        if not self._stack:
            raise RefusedError("its stack is empty")
        return self._stack.pop()

    def _top(self) -> object:
        if not self._stack:
            raise RefusedError("its stack is empty")
        return self._stack[-1]

    def mark(self) -> None:
        self._frames.append(self._stack)
        self._stack = []

    def to_mark(self) -> list[object]:
        """Everything above the last mark, taken off with it."""
        if not self._frames:
            raise RefusedError("a mark is missing")
        items, self._stack = self._stack, self._frames.pop()
        return items

    def drop(self) -> None:
        if self._stack:
            self._stack.pop()
        else:
            self.to_mark()

    def duplicate(self) -> None:
        self.push(self._top())

    def put(self, index: int) -> None:
        value = self._top()
        if not 0 <= index < MOST_MEMO:
            raise RefusedError(f"a place {index} to remember")
        self._memo[index] = value
        if isinstance(value, Unbuilt):
            value.memo_keys.append(index)

    def memoize(self) -> None:
        self.put(len(self._memo))

    def get(self, index: int) -> None:
        if index not in self._memo:
            raise RefusedError(f"nothing is remembered under {index}")
        self.push(self._memo[index])

    # ---- numbers and texts

    def protocol(self) -> None:
        version = self.size(1)
        if version > NEWEST_PROTOCOL:
            raise RefusedError(f"protocol {version}, {NEWEST_PROTOCOL} is the newest known")

    def integer_line(self) -> int:
        text = self.line().removesuffix(b"L")
        try:
            if len(text) <= 3 * MOST_INTEGER_BYTES:
                return int(text)
        except ValueError:
            pass
        raise RefusedError(f"{clip(text)} is no integer")

    def truth_or_integer_line(self) -> None:
        line = self.line()
        if line in TRUTHS:
            return self.push(TRUTHS[line])
        if len(line) > MOST_INTEGER_BYTES or not line.removeprefix(b"-").isdigit():
            raise RefusedError(f"{clip(line)} is no integer")
        return self.push(int(line))

    def float_line(self) -> None:
        line = self.line()
        try:
            self.push(float(line))
        except ValueError as error:
            raise RefusedError(f"{clip(line)} is no number") from error

    def long(self, n: int) -> None:
        if n > MOST_INTEGER_BYTES:
            raise RefusedError(f"an integer of {n} bytes")
        self.push(int.from_bytes(self.take(n), "little", signed=True))

    def float(self) -> None:
        self.push(struct.unpack(">d", self.take(8))[0])

    def text(self, n: int, encoding: str = "utf-8") -> None:
        content = self.payload(n)
        if isinstance(content, bytes) and not content.isascii():
            self._keep(3 * n)  # one character of four bytes gives all of them four
        try:
            self.push(content if isinstance(content, Forgotten) else content.decode(encoding, "surrogatepass"))
        except UnicodeDecodeError as error:
            raise RefusedError(f"a text that is not {encoding}") from error

    def text_line(self) -> None:
        line = self.line()
        self._budget.n_bytes += len(line)
        try:
            self.push(line.decode("raw-unicode-escape"))
        except UnicodeDecodeError as error:
            raise RefusedError("a text with a wrong escape") from error

    # ---- containers

    def tuple(self, n: int) -> None:
        if len(self._stack) < n:
            raise RefusedError("its stack is empty")
        items = tuple(self._stack[-n:])
        del self._stack[-n:]
        self.push(items)

    def extend(self, items: Iterable[object]) -> None:
        target = self._top()
        if isinstance(target, list):
            target.extend(items)
        elif not isinstance(target, Inert):
            raise RefusedError(f"items for {clip(target)}")

    def append(self) -> None:
        self.extend([self._pop()])

    def set(self, items: list[object]) -> None:
        target = self._top()
        if isinstance(target, dict):
            target.update(pairs(items))
        elif not isinstance(target, Inert):
            raise RefusedError(f"items for {clip(target)}")

    def set_one(self) -> None:
        value, key = self._pop(), self._pop()
        self.set([key, value])

    # ---- objects

    def find(self, module: object, name: object) -> None:
        if not isinstance(module, str) or not isinstance(name, str):
            raise RefusedError("a name that is no text")
        if (module, name) not in self._constructors:
            raise RefusedError(f"it asks for {clip(f'{module}.{name}')}, which is no plain data")
        self.push(Named(module, name, self._constructors[module, name]))

    def global_line(self) -> None:
        module, name = self.line(), self.line()
        self.find(module.decode("latin1"), name.decode("latin1"))

    def global_on_stack(self) -> None:
        name, module = self._pop(), self._pop()
        self.find(module, name)

    def reduce(self) -> None:
        args, callee = self._pop(), self._pop()
        if not isinstance(callee, Named) or callee.construct is None or not isinstance(args, tuple):
            raise RefusedError(f"a call of {clip(str(callee) if isinstance(callee, Named) else callee)}")
        self.push(callee.construct(args, self._budget))

    def build(self) -> None:
        state, target = self._pop(), self._top()
        if isinstance(target, Unbuilt):
            self._stack[-1] = target.build(state)
            for key in target.memo_keys:
                if self._memo.get(key) is target:
                    self._memo[key] = self._stack[-1]
        elif not isinstance(target, Inert | dict):  # the state of an OrderedDict holds attributes, no items
            raise RefusedError(f"a state for {clip(target)}")

    def reference(self) -> None:
        if self._persistent is None:
            raise RefusedError("a reference to something outside of it")
        self.push(self._persistent(self._pop()))


def pairs(items: list[object]) -> Iterable[tuple[object, object]]:
    """Keys and values in turn; keys are texts, integers and the like, whose hash takes no time."""
    if len(items) % 2:
        raise RefusedError("a key without a value")
    for key in items[::2]:
        is_plain = key is None or isinstance(key, str | bytes | int)
        if not is_plain or (isinstance(key, int) and abs(key) >= MOST_KEY):
            raise RefusedError(f"{clip(key)} as a key")
    return zip(items[::2], items[1::2], strict=True)


M = PickleMachine
OPERATIONS: dict[bytes, Callable[[PickleMachine], object]] = {
    b"\x80": M.protocol,
    b"\x95": lambda m: m.take(8),  # the length of a frame: of use to who reads ahead
    b"(": M.mark,
    b"0": M.drop,
    b"1": M.to_mark,
    b"2": M.duplicate,
    b"N": lambda m: m.push(None),
    b"\x88": lambda m: m.push(True),
    b"\x89": lambda m: m.push(False),
    b"I": M.truth_or_integer_line,
    b"L": lambda m: m.push(m.integer_line()),
    b"J": lambda m: m.long(4),
    b"K": lambda m: m.push(m.size(1)),
    b"M": lambda m: m.push(m.size(2)),
    b"\x8a": lambda m: m.long(m.size(1)),
    b"\x8b": lambda m: m.long(m.size(4)),
    b"F": M.float_line,
    b"G": M.float,
    b"V": M.text_line,
    b"\x8c": lambda m: m.text(m.size(1)),
    b"X": lambda m: m.text(m.size(4)),
    b"\x8d": lambda m: m.text(m.size(8)),
    b"U": lambda m: m.text(m.size(1), "latin1"),  # texts of Python 2
    b"T": lambda m: m.text(m.size(4), "latin1"),
    b"C": lambda m: m.push(m.payload(m.size(1))),
    b"B": lambda m: m.push(m.payload(m.size(4))),
    b"\x8e": lambda m: m.push(m.payload(m.size(8))),
    b"\x96": lambda m: m.push(m.payload(m.size(8))),
    b")": lambda m: m.push(()),
    b"\x85": lambda m: m.tuple(1),
    b"\x86": lambda m: m.tuple(2),
    b"\x87": lambda m: m.tuple(3),
    b"t": lambda m: m.push(tuple(m.to_mark())),
    b"]": lambda m: m.push([]),
    b"l": lambda m: m.push(m.to_mark()),
    b"a": M.append,
    b"e": lambda m: m.extend(m.to_mark()),
    b"}": lambda m: m.push({}),
    b"d": lambda m: m.push(dict(pairs(m.to_mark()))),
    b"s": M.set_one,
    b"u": lambda m: m.set(m.to_mark()),
    b"p": lambda m: m.put(m.integer_line()),
    b"q": lambda m: m.put(m.size(1)),
    b"r": lambda m: m.put(m.size(4)),
    b"\x94": M.memoize,
    b"g": lambda m: m.get(m.integer_line()),
    b"h": lambda m: m.get(m.size(1)),
    b"j": lambda m: m.get(m.size(4)),
    b"c": M.global_line,
    b"\x93": M.global_on_stack,
    b"R": M.reduce,
    b"\x81": M.reduce,  # a new object: class and arguments lie as for a call
    b"b": M.build,
    b"Q": M.reference,
}

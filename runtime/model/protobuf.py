"""Protocol Buffers messages from the wire format, field by field: no field is read that is not asked for by its number.

The runtime then needs no protobuf package, and a file is read once, in time proportional to its size. A `Message` says what a message may
hold; whatever else a file holds is reported by name.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass

from runtime.model.format import ModelError

LARGEST_FIELDS = 2**18
"""Fields that are read of one file, a fraction of a second's work."""
LONGEST_VARINT = 10
LONGEST_SHOWN = 60
"""Characters of a name from the file that an error quotes."""

Value = int | memoryview
Fields = dict[str, list[Value]]


@dataclass(frozen=True)
class Message:
    """Fields of a Protocol Buffers message that a model may hold, by number: `once` at most once, `often` any number of times.

    `never`: names of some of the others, for messages.
    """

    name: str
    once: dict[int, str]
    often: dict[int, str]
    never: dict[int, str]

    def name_of(self, number: int) -> str:
        """What an error calls a field that a model must not hold."""
        return self.never.get(number, f"field {number}")


class Reader:
    """Reads the messages of one file, up to `LARGEST_FIELDS` fields in all."""

    def __init__(self) -> None:
        self.fields_left = LARGEST_FIELDS

    def known(self, message: memoryview, kind: Message) -> Fields:
        """`read` for a message that may hold nothing else."""
        fields, rest = self.read(message, kind)
        if rest:
            raise ModelError(f"found {rest[0]} in {kind.name}, which export-model does not write; export it again")
        return fields

    def read(self, message: memoryview, kind: Message) -> tuple[Fields, list[str]]:
        """The values of a message by field, and what else it holds. Raises `ModelError`, ValueError or IndexError."""
        names = kind.once | kind.often
        found: Fields = {name: [] for name in names.values()}
        rest = []
        for number, value in _wire_fields(message):
            self.fields_left -= 1
            if self.fields_left < 0:
                raise ModelError(f"found more than {LARGEST_FIELDS} fields; a model has fewer")
            if number not in names:
                rest.append(kind.name_of(number))
                continue
            if number in kind.once and found[names[number]]:
                raise ModelError(f"found {names[number]} twice in {kind.name}; export it again with export-model")
            found[names[number]].append(value)
        return found, rest


def number_of(values: list[Value]) -> int:
    """The number in a field that occurs at most once; 0 where the field is left out. Raises ValueError where the field holds bytes."""
    (value,) = values or [0]
    if not isinstance(value, int):
        raise ValueError("bytes in place of a number")
    return _signed(value)


def numbers_of(values: list[Value], most: int) -> list[int]:
    """The numbers of a repeated field, one by one or packed; of very many only the first `most`."""
    every = (value for part in values for value in ([part] if isinstance(part, int) else _packed(part)))
    return [_signed(value) for value in itertools.islice(every, most)]


def only_of(values: list[Value]) -> memoryview:
    """The bytes in a field that occurs at most once; empty where the field is left out."""
    (value,) = parts_of(values) or [memoryview(b"")]
    return value


def parts_of(values: list[Value]) -> list[memoryview]:
    """The values of a field of bytes. Raises ValueError if one is a number."""
    parts = [value for value in values if isinstance(value, memoryview)]
    if len(parts) < len(values):
        raise ValueError("a number in place of bytes")
    return parts


def text_of(values: list[Value]) -> str:
    """The text in a field that occurs at most once; empty where the field is left out."""
    return bytes(only_of(values)).decode("utf-8")


def shown(text: str) -> str:
    """A text from the file as an error quotes it: printable, and not too long."""
    plain = text if text.isprintable() else ascii(text)
    return plain if len(plain) <= LONGEST_SHOWN else f"{plain[:LONGEST_SHOWN]}..."


def _packed(part: memoryview) -> Iterator[int]:
    position = 0
    while position < len(part):
        value, position = _varint(part, position)
        yield value


def _signed(value: int) -> int:
    """A varint as the 64 bits with a sign that it stands for."""
    return (value & 2**64 - 1 ^ 2**63) - 2**63


def _wire_fields(message: memoryview) -> Iterator[tuple[int, Value]]:
    """Number and value of every field: a varint as a number, anything else as its bytes. Raises ValueError or IndexError."""
    position = 0
    while position < len(message):
        key, position = _varint(message, position)
        field, wire_type = key >> 3, key & 7
        if wire_type == 0:
            value, position = _varint(message, position)
            yield field, value
            continue
        if wire_type == 2:
            length, position = _varint(message, position)
        elif wire_type in (1, 5):
            length = 8 if wire_type == 1 else 4
        else:
            raise ValueError("unknown wire type")
        if position + length > len(message):
            raise ValueError("field beyond the end")
        yield field, message[position : position + length]
        position += length


def _varint(message: memoryview, position: int) -> tuple[int, int]:
    value = 0
    for offset in range(LONGEST_VARINT):
        byte = message[position + offset]
        value |= (byte & 0x7F) << (7 * offset)
        if byte < 0x80:
            return value, position + offset + 1
    raise ValueError("varint too long")

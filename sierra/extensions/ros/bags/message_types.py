"""The types of ROS messages as columns of a table.

The columns of a type follow from its definition alone, so all runs have the same columns, also where no message was recorded:

- a field of numbers, flags or text is a column; a field within a field is `pose.pose.position.x`;
- a time or a duration is one whole number of nanoseconds, in a column that ends in `_ns`; `header.stamp` is `header_stamp_ns`;
- an array of numbers, flags or texts is a LIST, without covariances unless they are asked for;
- of bytes (images, point clouds, maps) and of lists of messages, there is only the number of items, as `data.length`;
- a `byte` has a sign in ROS 1 (-128 to 127) and none in ROS 2 (0 to 255); a `char` has none in both.

Definitions in a bag are not trusted. `rosbags` makes Python code from them, so every name is checked before. Types that contain
themselves, have too many fields, or have lists of items without any bytes are refused: a small bag could occupy a machine.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cached_property, lru_cache
from operator import attrgetter
from typing import TYPE_CHECKING, Any, Literal

from sierra.extensions.ros.bags.containers import NS, Channel, damage
from sierra.ingest.base import UnreadableError
from sierra.util.lazy_definitions import dataclass, regex

if TYPE_CHECKING:
    import pyarrow as pa
    from rosbags.typesys.store import Typestore

NAME = regex(r"[A-Za-z][A-Za-z0-9_]*")
FIELDS, COLUMNS, ITEMS, TEXT = 10_000, 2_000, 100_000, 1 << 18
"""The limits on a type: its fields, its columns, the items of an array of fixed size, and the bytes of its definition."""
NESTED = regex(r"\]\s*\[")
EXPRESSION = regex(r"\([^()]*\(|<<")
"""Arrays of arrays and expressions, which no generated definition has: a few of them occupy the parser for hours."""
UNPARSED = regex(r'"(?:[^"\\]|\\.)*"|//[^\n]*|/\*.*?\*/', re.DOTALL)
"""Texts and comments in IDL."""
PRIMITIVES = {
    "bool": "bool_",
    "byte": "int8",
    "char": "uint8",
    **{name: name for name in ("int8", "int16", "int32", "int64", "uint8", "uint16", "uint32", "uint64")},
    "float32": "float32",
    "float64": "float64",
    "string": "string",
}
"""The types of values, with Arrow's names; a `byte` is that of ROS 1, which `rosbags` also returns for ROS 2."""
BYTES = ("byte", "char", "int8", "uint8")
TIMES = ("builtin_interfaces/msg/Time", "builtin_interfaces/msg/Duration")
STAMP, SECONDS, NANOSECONDS = "header.stamp", "sec", "nanosec"
OWN = 'messages = ["FOLDER"] names a folder of the project with its PACKAGE/msg/NAME.msg'
NONE: Mapping[str, str] = {}
EMPTY = "structure_needs_at_least_one_member"
BASE, NAMED, ARRAY, SEQUENCE = 1, 2, 3, 4
"""The kinds of fields, as `rosbags` numbers them."""
Kind = Literal["value", "list", "octet", "octets", "time", "length", "bytes"]


@dataclass(frozen=True, slots=True)
class Field:
    """One column: its name, its kind, Arrow's name of the type of its values, and the attributes that it is made from."""

    name: str
    kind: Kind
    type: str
    attributes: tuple[str, ...]

    @property
    def arrow(self) -> pa.DataType:
        import pyarrow as pa

        plain = getattr(pa, self.type)()
        return pa.list_(plain) if self.kind in ("list", "octets") else plain

    def values(self, attributes: Sequence[Sequence[Any]]) -> Sequence[object]:
        """Return the values of the column from the values of its attributes in each message."""
        match self.kind:
            case "time":
                return [seconds * NS + nanoseconds for seconds, nanoseconds in zip(*attributes, strict=True)]
            case "length" | "bytes":
                return [len(items) for items in attributes[0]]
            case "octet":
                return [value & 0xFF for value in attributes[0]]
            case "octets":
                return [items.view("uint8") for items in attributes[0]]
            case _:
                return attributes[0]


class MessageType:
    """A type of messages, with what is needed to read them."""

    def __init__(self, name: str, store: Typestore, *, ros1: bool, cure: str = "") -> None:
        """`cure` is the end of the error for a type that is not known."""
        self.name, self._cure = name, cure
        self._decode = store.deserialize_ros1 if ros1 else store.deserialize_cdr
        self._fields = store.fielddefs
        self._ros1 = ros1
        self._visited = 0
        self._least(name)
        self.fields = tuple(self._columns(name, "", ""))
        if len(self.fields) > COLUMNS:
            raise UnreadableError(f"the type {name!r} has {len(self.fields)} columns; {COLUMNS} is the maximum")

    @cached_property
    def _values(self) -> Callable[[object], tuple[Any, ...]]:
        names = [attribute for field in self.fields for attribute in field.attributes]
        if len(names) > 1:
            return attrgetter(*names)
        one = attrgetter(*names) if names else None
        return lambda message: (one(message),) if one else ()

    def message(self, data: bytes) -> object:
        """Return a message. It raises all kinds of errors: use it within `damage`."""
        return self._decode(data, self.name)

    def decoded(self, data: bytes) -> tuple[Any, ...]:
        """Return the values of the attributes of all fields. Raises UnreadableError."""
        with damage(f"a message of type {self.name!r}"):
            return self._values(self.message(data))

    def _of(self, name: str) -> Sequence[tuple[str, Any]]:
        """Return the fields of a type. Raises UnreadableError if it is unknown, or if there are too many."""
        if name not in self._fields:
            raise UnreadableError(f"the type {self.name!r} needs the type {name!r}, which is not known{self._cure}")
        fields = [one for one in self._fields[name][1] if one[0] != EMPTY]
        self._visited += len(fields) + 1
        if self._visited > FIELDS:
            raise UnreadableError(f"the type {self.name!r} has more than {FIELDS} fields")
        return fields

    def _least(self, name: str, within: tuple[str, ...] = ()) -> int:
        """Return a lower limit of the bytes of a message. Raises UnreadableError for types that are not read."""
        if name in within:
            raise UnreadableError(f"the type {name!r} contains itself")
        least = 0
        for field, (kind, detail) in self._of(name):
            inner, items = detail if kind in (ARRAY, SEQUENCE) else ((kind, detail), 1)
            if inner[0] == NAMED:
                size = self._least(inner[1], (*within, name))
            elif inner[1][0] in PRIMITIVES:
                size = 1
            else:
                raise UnreadableError(f"the field {field!r} of the type {name!r} is of type {inner[1][0]!r}, which is not read")
            if kind in (ARRAY, SEQUENCE) and not size:
                raise UnreadableError(f"the list {field!r} of the type {name!r} has items without fields")
            if kind == ARRAY and items > ITEMS:
                raise UnreadableError(f"the array {field!r} of the type {name!r} has {items} items; {ITEMS} is the maximum")
            least += 4 if kind == SEQUENCE else size * items
        return least

    def _columns(self, name: str, prefix: str, path: str) -> Iterator[Field]:
        from rosbags.typesys.base import normalize_fieldname

        for field, (kind, detail) in self._of(name):
            column, attribute = prefix + field, path + normalize_fieldname(field)
            if kind == NAMED and detail in TIMES:
                stamp = "header_stamp" if column == STAMP else column
                yield Field(f"{stamp}_ns", "time", "int64", (f"{attribute}.{SECONDS}", f"{attribute}.{NANOSECONDS}"))
            elif kind == NAMED:
                yield from self._columns(detail, f"{column}.", f"{attribute}.")
            elif kind == BASE:
                yield self._plain(column, detail[0], attribute, is_list=False)
            elif detail[0][0] == NAMED:
                yield Field(f"{column}.length", "length", "int64", (attribute,))
            elif kind == SEQUENCE and detail[0][1][0] in BYTES:
                yield Field(f"{column}.length", "bytes", "int64", (attribute,))
            else:
                yield self._plain(column, detail[0][1][0], attribute, is_list=True)

    def _plain(self, column: str, base: str, attribute: str, *, is_list: bool) -> Field:
        if base == "byte" and not self._ros1:
            return Field(column, "octets" if is_list else "octet", "uint8", (attribute,))
        return Field(column, "list" if is_list else "value", PRIMITIVES[base], (attribute,))


class MessageTypes:
    """The types of the channels of one bag."""

    def __init__(self, ros: str, messages: Mapping[str, str] = NONE) -> None:
        """Give what counts if the bag does not have the definition of a type: `messages`, or else the version `ros` of ROS 2.

        `messages` are definitions by the names of their types. An empty `ros` is no version.
        """
        self._ros, self._messages = ros, messages
        self._known: dict[tuple[str, str | None, str], MessageType] = {}

    def of(self, channel: Channel) -> MessageType:
        """Return the type of a channel. Raises UnreadableError if it is not known, or not read."""
        if not channel.type:
            what = f"the serialization {channel.definition!r}, not cdr"
            raise UnreadableError(f"the topic {channel.topic!r} has {what}")
        key = (channel.type, channel.definition, channel.digest)
        if key not in self._known:
            name = _full_name(channel.type)
            with damage(f"the definition of the type {channel.type!r}"):
                store = self._store(channel, name)
                cure = f"; {OWN}" if store is self._types_outside_bag else ""
                self._known[key] = MessageType(name, store, ros1=channel.ros1, cure=cure)
                _check_digest(channel, name, store)
        return self._known[key]

    def _store(self, channel: Channel, name: str) -> Typestore:
        from rosbags.typesys import Stores, get_typestore

        definition = channel.definition
        blank = definition is not None and not definition.strip() and not channel.ros1
        if definition is not None and not (blank and name in self._types_outside_bag.fielddefs):
            store = get_typestore(Stores.EMPTY)
            store.register(_parsed(definition, channel.language, name))
            return store
        if name not in self._types_outside_bag.fielddefs:
            raise UnreadableError(self._lacking(channel.type))
        return self._types_outside_bag

    def _lacking(self, name: str) -> str:
        given = [*(["messages"] if self._messages else []), *([f"ROS 2 {self._ros}"] if self._ros else [])]
        if not given:
            what = f"the bag does not have the definition of the type {name!r}"
            return f'{what}; ros = "humble" names the version of ROS 2 that recorded it, and {OWN}'
        return f"neither the bag nor {' nor '.join(given)} has the definition of the type {name!r}; {OWN}"

    @cached_property
    def _types_outside_bag(self) -> Typestore:
        """The types whose definitions need not be in the bag."""
        return _known_types(self._ros, tuple(self._messages.items()))


@lru_cache(maxsize=8)
def _known_types(ros: str, messages: tuple[tuple[str, str], ...]) -> Typestore:
    """Return the types of a version of ROS 2, or of none, and of definitions, which replace those of the same names."""
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores(f"ros2_{ros}") if ros else Stores.EMPTY)
    own = parsed_messages(dict(messages))
    for name in own:
        store.fielddefs.pop(name, None)
    store.register(own)
    return store


def parsed_messages(messages: Mapping[str, str]) -> dict[str, Any]:
    """Return the types that are defined by the names of their types. Raises UnreadableError."""
    types: dict[str, Any] = {}
    for name, text in messages.items():
        with damage(f"the definition of the type {name!r}"):
            parsed = _parsed(text, "msg", name)
            if parsed.keys() != {name}:
                raise UnreadableError(f"the definition of the type {name!r} defines other types too")
            types |= parsed
    return types


def _full_name(name: str) -> str:
    """Return the name of a type as ROS 2 writes it, with `msg`. Raises UnreadableError if it is not a name of a type."""
    parts = name.split("/")
    if not 2 <= len(parts) <= 3 or not all(map(NAME.fullmatch, parts)):
        raise UnreadableError(f"{name!r} is not the name of a type of messages")
    return "/".join(parts if len(parts) == 3 else (parts[0], "msg", parts[1]))


def _parsed(definition: str, language: str, name: str) -> Any:
    """Return the types in a definition. Raises UnreadableError for one that could become other code than a type."""
    from rosbags.typesys import get_types_from_idl, get_types_from_msg

    if len(definition) > TEXT:
        raise UnreadableError(f"the definition of the type {name!r} has more than {TEXT} bytes")
    if NESTED.search(definition) or (language == "idl" and EXPRESSION.search(UNPARSED.sub("", definition))):
        raise UnreadableError(f"the definition of the type {name!r} has arrays of arrays, or expressions within expressions")
    types: dict[str, Any] = {}
    if language == "msg":
        types |= get_types_from_msg(definition, name)
    else:
        for part in definition.split("=" * 80 + "\n"):
            head, _, rest = part.partition("\n")
            types |= get_types_from_idl(rest if head.startswith("IDL: ") else part) if part.strip() else {}
    for type_name, (constants, fields) in types.items():
        _full_name(type_name)  # only to check the name
        field_names = [field for field, _ in fields]
        base_types = [kind for _, kind, _ in constants] + [_base(detail) for _, detail in fields]
        has_valid_values = all(isinstance(value, str | bool | int | float) for _, _, value in constants)
        names = (*field_names, *(constant for constant, _, _ in constants))
        if not has_valid_values or not all(map(NAME.fullmatch, names)):
            raise UnreadableError(f"the type {type_name!r} has a field without a valid name or value")
        if len(set(field_names)) < len(field_names):
            raise UnreadableError(f"the type {type_name!r} has two fields of the same name")
        for base_type in base_types:
            if base_type not in PRIMITIVES and not NAME.fullmatch(base_type):
                _full_name(base_type)  # only to check the name
    return types


def _base(detail: Any) -> str:
    """Return the name of the type of a field, or of its items."""
    kind, inner = detail
    if kind in (ARRAY, SEQUENCE):
        if not isinstance(inner[1], int):
            raise UnreadableError("has an array without a size")
        return _base(inner[0])
    return str(inner if kind == NAMED else inner[0])


def _check_digest(channel: Channel, name: str, store: Typestore) -> None:
    """Check that the definition is the one that the messages were recorded with. Raises UnreadableError."""
    if channel.digest in ("", "*") or (not channel.ros1 and not channel.digest.startswith("RIHS01_")):
        return
    found = store.generate_msgdef(name)[1] if channel.ros1 else store.hash_rihs01(name)
    if found != channel.digest:
        raise UnreadableError(f"the messages were recorded with another definition of {name!r} (its hash differs)")

"""YAML text -> plain values, each checked for type and finiteness.

The size of a file bounds the time to read it: values are counted during reading, aliases included.
"""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Iterable, Iterator, Mapping
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

import yaml
import yaml.composer
import yaml.constructor

from ce_gym.model.errors import RobotError, invalid_value, unknown_name
from ce_gym.model.formats.text_file import one_line, read_text

_REQUIRED: Any = object()


LARGEST_TREE = 50_000
"""Most values in a file; values that aliases repeat count each time."""
LONGEST_SCALAR = 10_000
"""Most characters of one value."""


class _Loader(yaml.SafeLoader):
    """Safe YAML of limited size, in which `5e4` is a number (as in YAML 1.2) and a mapping has every key once."""

    def __init__(self, stream: str):
        super().__init__(stream)
        self._total = 0  # values so far, aliases included
        self._sizes: dict[int, int] = {}  # values in each finished node

    def compose_node(self, parent: yaml.Node | None, index: int) -> yaml.Node | None:
        event, total_before = self.peek_event(), self._total
        if isinstance(event, yaml.ScalarEvent) and len(event.value) > LONGEST_SCALAR:
            raise _refused(event, f"a value of {len(event.value)} characters: expected at most {LONGEST_SCALAR}")
        node = super().compose_node(parent, index)
        if isinstance(event, yaml.AliasEvent) and id(node) not in self._sizes:
            raise _refused(event, f"alias {event.anchor!r} stands inside its own anchor: expected no self-reference")
        self._total += self._sizes[id(node)] if isinstance(event, yaml.AliasEvent) else 1
        self._sizes.setdefault(id(node), self._total - total_before)
        if self._total > LARGEST_TREE:
            raise _refused(event, f"more than {LARGEST_TREE} values, aliases counted: expected fewer")
        return node

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict:
        seen = set()
        for key, _ in node.value:
            if isinstance(key, yaml.ScalarNode) and key.value != "<<":
                if key.value in seen:
                    raise yaml.constructor.ConstructorError(
                        None, None, f"duplicate key {key.value!r}: expected each name once", key.start_mark
                    )
                seen.add(key.value)
        return super().construct_mapping(node, deep)


_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float", re.compile(r"[-+]?(\d+(\.\d*)?|\.\d+)[eE][-+]?\d+$"), list("-+0123456789.")
)


def _refused(event: yaml.Event, problem: str) -> yaml.composer.ComposerError:
    return yaml.composer.ComposerError(None, None, problem, event.start_mark)


def parse_yaml(text: str) -> Any:
    """Return the content of a YAML or JSON text.

    Raises:
        ValueError: The text is malformed or too large; one line with the place.
    """
    try:
        return yaml.load(text, _Loader)
    except Exception as error:  # PyYAML also lets IndexError, AttributeError and others out, as for `!!int ''`
        raise ValueError(_problem(error)) from None


def read_yaml(path: Path) -> Section:
    """Read a YAML file that holds one mapping.

    Raises:
        RobotError: The file is missing, malformed, too large, empty, or holds something else.
    """
    text = read_text(path, "a YAML file")
    try:
        data = parse_yaml(text)
    except ValueError as error:
        raise RobotError(f"{path}: malformed YAML: expected a mapping ({error})") from None
    if data is None:
        raise RobotError(f"{path}: the file is empty: expected a mapping")
    return Section(str(path), "", data)


def _problem(error: Exception) -> str:
    problem = getattr(error, "problem", None) or one_line(error)
    mark = getattr(error, "problem_mark", None)
    return f"line {mark.line + 1}: {problem}" if mark else problem


class Section:
    """A mapping in a file with its path of keys; every value is checked when it is read.

    Attributes:
        aliases: Names that stand for others where names are keys or in lists, such as names of joints for the links
            that they move.
    """

    def __init__(self, file: str, path: str, data: object, aliases: Mapping[str, str] | None = None):
        self.file, self.path, self.aliases = file, path, aliases or {}
        if not isinstance(data, dict):
            raise invalid_value(file, path or "top level", data, "a mapping")
        for key in data:
            if not isinstance(key, str):
                raise self.invalid(key, key, "a name; put quotes around it")
        self.data: dict[str, Any] = data

    def __contains__(self, key: str) -> bool:
        return key in self.data

    def __iter__(self) -> Iterator[str]:
        return iter(self.data)

    def key(self, key: object) -> str:
        """Return the full name of a key, for messages."""
        return f"{self.path}.{key}" if self.path else str(key)

    def invalid(self, key: object, value: object, expected: str) -> RobotError:
        """Return the error for a value under a key, see `errors.invalid_value`."""
        return invalid_value(self.file, self.key(key), value, expected)

    def unknown(self, key: str, name: object, known: Iterable[str], expected: str) -> RobotError:
        """Return the error for a name under a key, or in the mapping itself for an empty key."""
        return unknown_name(self.file, self.key(key) if key else self.path or "top level", name, known, expected)

    def allow(self, *keys: str) -> Section:
        """Refuse keys other than these; return the section itself."""
        for key in self.data:
            if key not in keys:
                raise self.unknown("", key, keys, "a key that exists")
        return self

    def get(self, key: str, default: Any = _REQUIRED, expected: str = "a value") -> Any:
        """Return the raw value, or the default; without a default the key must be there."""
        if key in self.data:
            return self.data[key]
        if default is _REQUIRED:
            raise self.invalid(key, None, expected)
        return default

    def section(self, key: str) -> Section:
        """Return the mapping under `key`; an empty one if the key is missing."""
        return Section(self.file, self.key(key), self.get(key, {}), self.aliases)

    def sections(self) -> Iterator[tuple[str, Section]]:
        """Iterate over the keys and the mappings under them."""
        return ((key, self.section(key)) for key in self.data)

    def text(self, key: str, default: Any = _REQUIRED, choices: tuple[str, ...] = ()) -> str:
        """Return a piece of text, one of `choices` if there are any."""
        value = self.get(key, default, "text")
        if value is default:
            return value
        if not isinstance(value, str) or not value.strip():
            raise self.invalid(key, value, "text")
        if choices and value not in choices:
            raise self.unknown(key, value, choices, "one of")
        return value

    def number(self, key: str, default: Any = _REQUIRED) -> float:
        """Return a finite number."""
        value = self.get(key, default, "a finite number")
        return value if value is default else finite(self.file, self.key(key), value)

    def vector(self, key: str, count: int, default: Any = _REQUIRED) -> tuple[float, ...]:
        """Return `count` finite numbers."""
        value = self.get(key, default, f"a list of {count} numbers")
        if value is default:
            return value
        if not isinstance(value, list) or len(value) != count:
            raise self.invalid(key, value, f"a list of {count} numbers")
        return tuple(finite(self.file, f"{self.key(key)}[{i}]", item) for i, item in enumerate(value))

    def numbers(self) -> tuple[tuple[str, float], ...]:
        """Return all pairs of a mapping from names to finite numbers."""
        return tuple((self.named(key), self.number(key)) for key in self.data)

    def named(self, key: str) -> str:
        """Return the name that a key stands for, see `aliases`."""
        name = self.aliases.get(key, key)
        if name != key and name in self.data:
            raise self.invalid(key, key, f"each joint once; {name!r} is the link that it moves")
        return name

    def numbers_for(self, names: Collection[str]) -> dict[str, float]:
        """Return a number for each name in a mapping whose keys may be patterns such as "*_hip".

        A full name goes before patterns, a later pattern before an earlier one. Keys that are neither a pattern nor one
        of `names` are kept, for `check_robot` to report.
        """
        return {name: self.number(key) for name, key in self.keys_for(names).items()}

    def keys_for(self, names: Collection[str]) -> dict[str, str]:
        """Return the key that applies to each name, see `numbers_for`."""
        keys: dict[str, str] = {}
        for key in self:
            if not set(key) & set("*?["):
                continue
            fitting = [name for alias, name in self.aliases.items() if fnmatchcase(alias, key)]
            matches = [name for name in names if fnmatchcase(name, key) or name in fitting]
            if not matches:
                raise self.unknown("", key, names, "a pattern that fits a name")
            keys |= dict.fromkeys(matches, key)
        return keys | {self.named(key): key for key in self if not set(key) & set("*?[")}

    def list(self, key: str) -> list[Any]:
        """Return a list, empty if the key is missing."""
        value = self.get(key, [])
        if not isinstance(value, list):
            raise self.invalid(key, value, "a list")
        return value

    def texts(self, key: str) -> tuple[str, ...]:
        """Return a list of texts, empty if the key is missing."""
        for i, item in enumerate(self.list(key)):
            if not isinstance(item, str):
                raise invalid_value(self.file, f"{self.key(key)}[{i}]", item, "text")
        return tuple(self.aliases.get(name) or name for name in self.list(key))


def finite(file: str, key: str, value: object) -> float:
    """Return `value` as a float if it is a finite number (true and false are not numbers)."""
    if isinstance(value, int | float) and not isinstance(value, bool):
        try:
            if math.isfinite(value):
                return float(value)
        except OverflowError:  # an integer beyond the range of floats
            value = "a number with hundreds of digits"
    raise invalid_value(file, key, value, "a finite number")


def frozen(value: Any) -> Any:
    """Return nested lists and dictionaries as tuples, dictionaries as tuples of pairs, so that they can be hashed."""
    if isinstance(value, dict):
        return tuple((str(key), frozen(item)) for key, item in value.items())
    return tuple(frozen(item) for item in value) if isinstance(value, list) else value

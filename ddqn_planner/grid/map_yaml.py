"""The YAML of map files, read as map_server's library (yaml-cpp) reads it."""

from __future__ import annotations

import math
import re
from typing import Any, Final

import yaml

# Bytes by which yaml-cpp tells UTF-16 and UTF-32 without a byte order mark, too.
ENCODINGS: Final = (
    (b"\xef\xbb\xbf", "utf-8-sig"),
    (b"\x00\x00\xfe\xff", "utf-32"),
    (b"\xff\xfe\x00\x00", "utf-32"),
    (b"\xfe\xff", "utf-16"),
    (b"\xff\xfe", "utf-16"),
)
WITHOUT_MARK: Final = (
    (rb"\x00\x00\x00[^\x00]", "utf-32-be"),
    (rb"[^\x00]\x00\x00\x00", "utf-32-le"),
    (rb"\x00[^\x00]", "utf-16-be"),
    (rb"[^\x00]\x00", "utf-16-le"),
)

# Characters that end a line or a file for PyYAML, but not for yaml-cpp.
NOT_SPECIAL: Final = str.maketrans(dict.fromkeys("\0\x85\u2028\u2029", "\ufffd"))
DIRECTIVES: Final = re.compile(
    r"(?:[ \t]*(?:#[^\r\n]*)?(?:\r\n?|\n)|%[^\r\n]*(?:\r\n?|\n))*"
)

NUMBER: Final = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?\s*", re.ASCII)
INTEGER: Final = re.compile(
    r"([-+]?)(?:0[xX]([0-9a-fA-F]+)|(0[0-7]*)|([1-9]\d*))\s*", re.ASCII
)
SPECIAL: Final = {
    ".inf": math.inf,
    "+.inf": math.inf,
    "-.inf": -math.inf,
    ".nan": math.nan,
}
YES: Final = ("y", "yes", "true", "on")
NO: Final = ("n", "no", "false", "off")


class _Loader(yaml.BaseLoader):
    """Reads each scalar as text.

    It knows no tags and no merge keys, so that no code can run.
    """

    # PyYAML allows tabs within scalars and comments only, and takes the last of equal
    # keys.

    def check_printable(self, data: Any) -> None:
        """Accept each character: most that are not printable stand in comments."""

    def scan_to_next_token(self) -> None:
        """Move on to the next token, over white space, tabs and comments."""
        while True:
            while self.peek() in " \t\ufeff":
                if self.peek() == "\t" and not self.flow_level:
                    self.allow_simple_key = False  # a tab does not indent
                self.forward()
            if self.peek() == "#":
                while self.peek() not in "\0\r\n":
                    self.forward()
            if not self.scan_line_break():  # type: ignore[no-untyped-call]
                return
            if not self.flow_level:
                self.allow_simple_key = True

    def scan_plain_spaces(self, indent: int, start_mark: Any) -> Any:
        """Return the white space at this place in a plain scalar, as a list of texts.

        It may have tabs, unlike in PyYAML, whose method handles line breaks.
        """
        length = 0
        while self.peek(length) in " \t":
            length += 1
        white = self.prefix(length)
        self.forward(length)
        if self.peek() not in "\r\n":
            return [white] if white else None
        return super().scan_plain_spaces(indent, start_mark)

    def compose_node(self, parent: Any, index: Any) -> Any:
        """Compose a node whose anchor may have been used before."""
        event: Any = self.peek_event()  # type: ignore[no-untyped-call]
        if not isinstance(event, yaml.AliasEvent):
            self.anchors.pop(event.anchor, None)
        return super().compose_node(parent, index)

    def construct_mapping(self, node: Any, deep: bool = False) -> dict[Any, Any]:
        """Return the first of the values of each key that is a scalar."""
        mapping: dict[str, Any] = {}
        for key, value in node.value:
            if isinstance(key, yaml.ScalarNode) and key.value not in mapping:
                mapping[key.value] = self.construct_object(value, deep=deep)
        return mapping


def read_yaml(content: bytes) -> Any:
    """Return the first document of a YAML file: text, lists and dictionaries.

    Bytes that are no UTF-8 are kept as `os.fsdecode` keeps them; a ValueError says what
    is no YAML.
    """
    text = _decoded(content).translate(NOT_SPECIAL)
    begin = DIRECTIVES.match(text)
    if begin is not None and not text.startswith("---", begin.end()):
        text = text[begin.end() :]  # directives without a document's start are ignored
    try:
        loader = _Loader(text)
        try:
            return loader.get_data() if loader.check_node() else None
        finally:
            loader.dispose()
    except (yaml.YAMLError, OverflowError, RecursionError) as error:
        raise ValueError(f"not a YAML file ({' '.join(str(error).split())})") from None


def _decoded(content: bytes) -> str:
    """Return the text of a YAML file; see `read_yaml` for bytes that are no UTF-8."""
    encoding = _encoding_of(content)
    errors = "surrogateescape" if encoding.startswith("utf-8") else "replace"
    return content.decode(encoding, errors)


def _encoding_of(content: bytes) -> str:
    """Return the encoding that yaml-cpp takes the first bytes of a file for."""
    for mark, encoding in ENCODINGS:
        if content.startswith(mark):
            return encoding
    for pattern, encoding in WITHOUT_MARK:
        if re.match(pattern, content):
            return encoding
    return "utf-8"


def as_float(text: Any) -> float:
    """Return the number that a scalar is to yaml-cpp; else a ValueError."""
    if isinstance(text, str):
        if NUMBER.fullmatch(text):
            return float(text)
        if text.lower() in SPECIAL:
            return SPECIAL[text.lower()]
    raise ValueError(f"{text!r} is no number")


def as_truth(text: Any) -> bool:
    """Return whether a scalar is true: a whole number except 0, or a word for yes.

    A scalar that is neither true nor false is a ValueError.
    """
    if not isinstance(text, str):
        raise ValueError(f"{text!r} is no truth value")
    integer = INTEGER.fullmatch(text)
    if integer is not None and _fits_into_int(integer):
        return _magnitude(integer) != 0
    word = text.lower()
    if word in YES + NO and text in (word, word.upper(), word.capitalize()):
        return word in YES
    raise ValueError(f"{text!r} is no truth value")


def _fits_into_int(integer: re.Match[str]) -> bool:
    """Return whether C++ can hold a match of `INTEGER` as an int."""
    number = _magnitude(integer)
    if integer[1] == "-":
        number = -number
    return -(2**31) <= number < 2**31


def _magnitude(integer: re.Match[str]) -> int:
    """Return the number of a match of `INTEGER`, without its sign."""
    _, hexadecimal, octal, decimal = integer.groups()
    if hexadecimal:
        return int(hexadecimal, 16)
    if octal:
        return int(octal, 8)
    return int(decimal)

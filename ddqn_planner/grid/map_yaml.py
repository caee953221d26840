"""The YAML of map files, with tabs, double keys and Latin-1 as for map_server."""

from __future__ import annotations

import re
from typing import Any, Final

import yaml

NUMBER: Final = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?\s*", re.ASCII)
WHOLE_NUMBER: Final = re.compile(r"[-+]?\d+", re.ASCII)
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

    def construct_mapping(self, node: Any, deep: bool = False) -> dict[Any, Any]:
        """Return the first of the values of each key that is a scalar."""
        mapping: dict[str, Any] = {}
        for key, value in node.value:
            if isinstance(key, yaml.ScalarNode) and key.value not in mapping:
                mapping[key.value] = self.construct_object(value, deep=deep)
        return mapping


def read_yaml(content: bytes) -> Any:
    """Return the first document in the content of a YAML file.

    It is made of texts, lists and dictionaries, or None if there is none. Bytes that
    are no UTF-8 are kept as `os.fsdecode` keeps them; a ValueError says what is no
    YAML.
    """
    text = content.decode("utf-8-sig", "surrogateescape")
    try:
        loader = _Loader(text)
        try:
            return loader.get_data() if loader.check_node() else None
        finally:
            loader.dispose()
    except (yaml.YAMLError, OverflowError, RecursionError) as error:
        raise ValueError(f"not a YAML file ({' '.join(str(error).split())})") from None


def as_float(text: Any) -> float:
    """Return the number that a scalar is to yaml-cpp; else a ValueError."""
    if isinstance(text, str) and NUMBER.fullmatch(text):
        return float(text)
    raise ValueError(f"{text!r} is no number")


def as_truth(text: Any) -> bool:
    """Return whether the text of a scalar means true: a number except 0, or "yes".

    A text that is neither true nor false, or no text, is a ValueError.
    """
    if not isinstance(text, str):
        raise ValueError(f"{text!r} is no truth value")
    if WHOLE_NUMBER.fullmatch(text):
        return int(text) != 0
    word = text.lower()
    if word in YES + NO and text in (word, word.upper(), word.capitalize()):
        return word in YES
    raise ValueError(f"{text!r} is no truth value")

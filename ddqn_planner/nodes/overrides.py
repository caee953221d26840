"""What the command line and its parameter files set, and what of it nobody reads."""

import difflib
import re
from collections.abc import Collection, Iterable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, Final, NamedTuple

import yaml

from ddqn_planner.files import read_file

MAX_FILE_BYTES: Final = 2**24  # of a parameter file

PARAMETERS: Final = "ros__parameters"
QOS: Final = "qos_overrides."
TOPICS_OF_ROS: Final = ("/clock", "/parameter_events", "/rosout", "/tf", "/tf_static")
SIMILAR: Final = 0.6  # of two names: the cutoff of difflib
MOST_NAMES: Final = 5  # of sections that a warning lists


class Section(NamedTuple):
    """The parameters of the nodes whose full name a pattern matches."""

    name: str
    parameters: list[str]

    @property
    def last(self) -> str:
        """The part that is the node's own name."""
        return self.name.rpartition("/")[2]

    def is_for(self, node: str) -> bool:
        """Return whether it is for a node, by its full name."""
        wildcards = {"**": "(/[^/]+)*", "*": "/[^/]+"}
        tokens = filter(None, self.name.split("/"))
        pattern = "".join(
            wildcards.get(token, "/" + re.escape(token)) for token in tokens
        )
        return re.fullmatch(pattern, node) is not None


def nearest(name: str, names: Iterable[str]) -> str:
    """Return which of some names is most like another one; empty if none is."""
    by_lower = {other.casefold(): other for other in names}
    similar = difflib.get_close_matches(name.casefold(), by_lower, 1, SIMILAR)
    return by_lower[similar[0]] if similar else ""


def unread_names(names: Iterable[str], known: Collection[str], node: str) -> str:
    """Return which parameters a node does not have; empty if it has all."""
    unknown = [name for name in names if name not in known and not name.startswith(QOS)]
    if not unknown:
        return ""
    similar = [nearest(name, known) for name in unknown]
    told = ", ".join(
        f"{name} (the nearest is {other})" if other else name
        for name, other in zip(unknown, similar, strict=True)
    )
    return (
        f"{node} does not know, and does not read: {told}; --help lists what it knows"
    )


def unread_qualities(
    names: Iterable[str], names_read: Collection[str], node: str
) -> list[str]:
    """Return a sentence for each quality of service of a topic that a node does not read.

    Parameters
    ----------
    names : iterable of str
        Parameters that a user set.
    names_read : collection of str
        Parameters that the node reads.
    node : str
        The node's name.
    """
    qualities = [name for name in names_read if name.startswith(QOS)]
    problems = []
    for name in names:
        if not name.startswith(QOS) or name in names_read:
            continue
        topic = name.removeprefix(QOS).partition(".")[0]
        if topic in TOPICS_OF_ROS:
            continue
        nearest_name = nearest(name, qualities)
        remedy = "it reads no such topic"
        if nearest_name:
            remedy = f"the nearest is {nearest_name}"
        problems.append(f"{node} has no subscription for {name} now; {remedy}")
    return problems


def unread_sections(
    arguments: Sequence[str], known: Collection[str], node: str
) -> list[str]:
    """Return which parameter files, and settings of -p, are for other nodes alone."""
    told = []
    for source, sections in _sources(arguments):
        if not sections:
            continue
        own = [section for section in sections if section.is_for(node)]
        if not own:
            told.append(f"{source} sets nothing of {node}: {_remedy(sections, node)}")
        elif all(section.last == "**" for section in own):
            told += [
                f"{source}: the section {other.name} is not for {node}; {_rename(other, node)}"
                for other in sections
                if other not in own and _is_meant(other, known, node)
            ]
    return told


def _is_meant(section: Section, known: Collection[str], node: str) -> bool:
    """Return whether a section for no other node than this one may have been meant for it."""
    has_namespace = section.name.count("/") > 1
    is_similar = nearest(section.last, [node.rpartition("/")[2]]) != ""
    return (
        not has_namespace
        and is_similar
        and any(name in known for name in section.parameters)
    )


def _remedy(sections: Sequence[Section], node: str) -> str:
    names = [section.name for section in sections]
    shown = ", ".join(names[:MOST_NAMES]) + ", ..." * (len(names) > MOST_NAMES)
    name = node.rpartition("/")[2]
    other = nearest(name, [section.last for section in sections])
    remedy = f"add a section {node}: or /**:"
    if other:
        remedy = _rename(
            next(section for section in sections if section.last == other), node
        )
    return f"it is for {shown}; {remedy}"


def _rename(section: Section, node: str) -> str:
    name = node.rpartition("/")[2]
    if section.last == name:  # in another namespace
        return f"write {node}: or /**/{name}: instead of {section.name}:"
    return (
        f"write {node.removeprefix('/')}: instead of {section.name.removeprefix('/')}:"
    )


def _sources(arguments: Sequence[str]) -> Iterator[tuple[str, list[Section]]]:
    """Yield each parameter file, and each -p with a node's name, and its sections."""
    is_for_ros, rest = False, iter(arguments)
    for argument in rest:
        if argument in ("--ros-args", "--"):
            is_for_ros = argument == "--ros-args"
        elif is_for_ros and argument == "--params-file":
            file = next(rest, "")
            # ROS has read it before, or has said what is wrong with it.
            with suppress(OSError, ValueError, yaml.YAMLError, RecursionError):
                document = yaml.load(
                    read_file(Path(file), MAX_FILE_BYTES), Loader=yaml.BaseLoader
                )
                yield file, [*_sections(document)]
        elif is_for_ros and argument in ("-p", "--param"):
            rule = next(rest, "")
            target, _, _ = rule.partition(":=")
            node, colon, parameter = target.rpartition(":")
            if colon:
                yield f"-p {rule}", [Section("/" + node.lstrip("/"), [parameter])]


def _sections(tree: Any, name: str = "") -> Iterator[Section]:
    if not isinstance(tree, dict):
        return
    for key, below in tree.items():
        if key == PARAMETERS:
            yield Section(name, [*_parameters(below)])
        else:
            yield from _sections(below, f"{name}/{key.strip('/')}")


def _parameters(tree: Any, prefix: str = "") -> Iterator[str]:
    for key, below in tree.items() if isinstance(tree, dict) else ():
        if isinstance(below, dict):
            yield from _parameters(below, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}"


def wrong_argument(arguments: Sequence[str]) -> str:
    """Return which argument or parameter file ROS cannot read, and a remedy; empty if none."""
    is_for_ros, rest = False, iter(arguments)
    for argument in rest:
        wrong = ""
        if argument in ("--ros-args", "--"):
            is_for_ros = argument == "--ros-args"
        elif is_for_ros and argument == "--params-file":
            wrong = _wrong_file(next(rest, ""))
        elif is_for_ros and argument in ("-p", "--param"):
            wrong = _wrong_rule(next(rest, ""))
        if wrong:
            return wrong
    return ""


def _wrong_rule(rule: str) -> str:
    """Return why a setting of -p cannot be read; empty if it can."""
    target, assignment, value = rule.partition(":=")
    if not assignment:
        return (
            f"-p {rule} has no ':='; write -p NAME:=VALUE, as in -p robot_radius:=0.3"
        )
    node, colon, name = target.rpartition(":")
    if colon and "/" in node:
        return f"-p {rule} names a node with '/'; write -p {node.split('/')[-1]}:{name}:={value}"
    if not value.strip():
        return f"-p {rule} has no value; give one, and for an empty text: -p \"{target}:=''\""
    try:
        yaml.load(value, Loader=yaml.BaseLoader)
    except yaml.YAMLError as error:
        return (
            f"-p {rule}: the value is no YAML ({_reason(error)}); put a text in quotes"
        )
    return ""


def _wrong_file(file: str) -> str:
    """Return why a parameter file cannot be read; empty if it can."""
    form = "write NODE:, below it ros__parameters:, and below that NAME: VALUE"
    try:
        document = yaml.load(Path(file).read_bytes(), Loader=yaml.BaseLoader)
    except OSError as error:
        return f"the parameter file {file!r} cannot be read ({error.strerror}); check the path"
    except (ValueError, yaml.YAMLError, RecursionError) as error:
        return f"the parameter file {file!r} is no YAML ({_reason(error)}); correct it"
    if not document:
        return f"the parameter file {file!r} is empty; {form}, or leave it out"
    if not [*_sections(document)]:
        similar = nearest(PARAMETERS, _keys(document))
        instead = f", but {similar}" if similar else ""
        return f"the parameter file {file!r} has no {PARAMETERS}{instead}; {form}"
    return ""


def _keys(tree: Any) -> Iterator[str]:
    for key, below in tree.items() if isinstance(tree, dict) else ():
        yield key
        yield from _keys(below)


def _reason(error: Exception) -> str:
    """Return why a text is no YAML, with the line where that is known."""
    if isinstance(error, yaml.MarkedYAMLError) and error.problem_mark is not None:
        return f"line {error.problem_mark.line + 1}: {error.problem}"
    return str(error).partition("\n")[0]

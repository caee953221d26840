"""What the command line and its parameter files set, and what of it nobody reads."""

import difflib
import re
from collections.abc import Collection, Iterable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Final, NamedTuple

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

    pattern: str  # as "/**/planner": ** matches any namespaces, and * one name
    parameters: list[str]  # names

    @property
    def node_name(self) -> str:
        """The last part of the pattern, for the node's own name."""
        return _node_name(self.pattern)

    def is_for(self, node: str) -> bool:
        """Return whether the pattern matches the full name of a node."""
        wildcards = {"**": "(/[^/]+)*", "*": "/[^/]+"}
        tokens = filter(None, self.pattern.split("/"))
        expression = "".join(
            wildcards.get(token, "/" + re.escape(token)) for token in tokens
        )
        return re.fullmatch(expression, node) is not None


class Source(NamedTuple):
    """A parameter file of the command line, or a setting of -p for a named node."""

    words: str  # what warnings call it
    sections: list[Section]


def _node_name(full_name: str) -> str:
    """Return the name of a node, or of a pattern, without its namespace."""
    return full_name.rpartition("/")[2]


def nearest(name: str, names: Iterable[str]) -> str:
    """Return which of `names` is most like a name; empty if none is like it."""
    names_by_lower = {candidate.casefold(): candidate for candidate in names}
    similar = difflib.get_close_matches(name.casefold(), names_by_lower, 1, SIMILAR)
    return names_by_lower[similar[0]] if similar else ""


def unread_names(
    names: Iterable[str], declared_names: Collection[str], node: str
) -> str:
    """Return a sentence about the parameters that a node does not have; empty if none.

    Parameters
    ----------
    names : iterable of str
        Parameters that a user set.
    declared_names : collection of str
        Parameters that the node has.
    node : str
        The node's full name.
    """
    unknown_names = []
    for name in names:
        if name in declared_names or name.startswith(QOS):
            continue
        similar_name = nearest(name, declared_names)
        hint = f" (the nearest is {similar_name})" if similar_name else ""
        unknown_names.append(f"{name}{hint}")
    if not unknown_names:
        return ""
    listing = ", ".join(unknown_names)
    problem = f"{node} does not know, and does not read: {listing}"
    return f"{problem}; --help lists what it knows"


def unread_qualities(
    names: Iterable[str], declared_names: Collection[str], node: str
) -> list[str]:
    """Return a sentence about each ``qos_overrides`` parameter that a node lacks.

    The node has such parameters for its subscriptions. Parameters for topics of which
    ROS itself reads the quality of service are left out.

    Parameters
    ----------
    names : iterable of str
        Parameters that a user set.
    declared_names : collection of str
        Parameters that the node has.
    node : str
        The node's full name.
    """
    declared_qualities = [name for name in declared_names if name.startswith(QOS)]
    problems = []
    for name in names:
        if not name.startswith(QOS) or name in declared_names:
            continue
        topic = name.removeprefix(QOS).partition(".")[0]
        if topic in TOPICS_OF_ROS:
            continue
        similar_name = nearest(name, declared_qualities)
        remedy = "it reads no such topic"
        if similar_name:
            remedy = f"the nearest is {similar_name}"
        problems.append(f"{node} has no subscription for {name} now; {remedy}")
    return problems


def unread_sections(
    arguments: Sequence[str], declared_names: Collection[str], node: str
) -> list[str]:
    """Return a sentence about each part of the command line that a node does not read.

    It is a parameter file or a -p that is for other nodes alone, or a section of a file
    that may be meant for the node, but has another name.

    Parameters
    ----------
    arguments : sequence of str
        The command line.
    declared_names : collection of str
        Parameters that the node has.
    node : str
        The node's full name.
    """
    problems = []
    for source in _sources(arguments):
        problems += _unread_sections_of(source, declared_names, node)
    return problems


def _unread_sections_of(
    source: Source, declared_names: Collection[str], node: str
) -> list[str]:
    """Return a sentence about each part of a source that a node does not read.

    The arguments are those of `unread_sections`.
    """
    words, sections = source
    if not sections:
        return []
    own_sections = [section for section in sections if section.is_for(node)]
    if not own_sections:
        return [f"{words} sets nothing of {node}: {_remedy(sections, node)}"]
    if any(section.node_name != "**" for section in own_sections):
        return []  # besides a section for the node, others are for other nodes
    problems = []
    for section in sections:
        is_other = section not in own_sections
        if is_other and _is_meant(section, declared_names, node):
            problem = f"the section {section.pattern} is not for {node}"
            problems.append(f"{words}: {problem}; {_rename(section, node)}")
    return problems


def _is_meant(section: Section, declared_names: Collection[str], node: str) -> bool:
    """Return whether a section that is for no node may be meant for this node.

    It has no namespace, a similar name, and parameters that the node has.
    """
    has_namespace = section.pattern.count("/") > 1
    has_similar_name = nearest(section.node_name, [_node_name(node)]) != ""
    has_parameters = any(name in declared_names for name in section.parameters)
    return not has_namespace and has_similar_name and has_parameters


def _remedy(sections: Sequence[Section], node: str) -> str:
    """Return in words for which nodes sections are, and which section a node needs.

    `node` is the node's full name. A section with a similar name is to be renamed.
    """
    listing = ", ".join(section.pattern for section in sections[:MOST_NAMES])
    if len(sections) > MOST_NAMES:
        listing += ", ..."
    remedy = f"add a section {node}: or /**:"
    node_names = [section.node_name for section in sections]
    similar_name = nearest(_node_name(node), node_names)
    if similar_name:
        similar_section = sections[node_names.index(similar_name)]
        remedy = _rename(similar_section, node)
    return f"it is for {listing}; {remedy}"


def _rename(section: Section, node: str) -> str:
    """Return how to write the name of a section for a node."""
    name = _node_name(node)
    if section.node_name == name:  # in another namespace
        return f"write {node}: or /**/{name}: instead of {section.pattern}:"
    old_name = section.pattern.removeprefix("/")
    return f"write {node.removeprefix('/')}: instead of {old_name}:"


class Option(NamedTuple):
    """An argument for ROS that sets parameters."""

    is_file: bool  # of --params-file; else of -p
    value: str  # the file, or NAME:=VALUE; empty if the command line ends before it


def _options(arguments: Sequence[str]) -> Iterator[Option]:
    """Yield the options of a command line that set parameters."""
    is_for_ros = False
    remaining_arguments = iter(arguments)
    for argument in remaining_arguments:
        if argument in ("--ros-args", "--"):
            is_for_ros = argument == "--ros-args"
        elif is_for_ros and argument in ("--params-file", "-p", "--param"):
            value = next(remaining_arguments, "")
            yield Option(argument == "--params-file", value)


def _sources(arguments: Sequence[str]) -> Iterator[Source]:
    """Yield each parameter file, and each -p with the name of a node."""
    for option in _options(arguments):
        if option.is_file:
            # ROS has read the file before, or has said what is wrong with it.
            with suppress(OSError, ValueError, yaml.YAMLError, RecursionError):
                text = read_file(Path(option.value), MAX_FILE_BYTES)
                document = yaml.load(text, Loader=yaml.BaseLoader)
                yield Source(option.value, [*_sections(document)])
            continue
        target, _, _ = option.value.partition(":=")
        node, colon, parameter = target.rpartition(":")
        if colon:
            section = Section("/" + node.lstrip("/"), [parameter])
            yield Source(f"-p {option.value}", [section])


def _sections(document: object, pattern: str = "") -> Iterator[Section]:
    """Yield the sections of a YAML document, or of its part below a pattern."""
    if not isinstance(document, dict):
        return
    for key, part in document.items():
        if key == PARAMETERS:
            yield Section(pattern, [*_parameters(part)])
        else:
            yield from _sections(part, f"{pattern}/{key.strip('/')}")


def _parameters(part: object, prefix: str = "") -> Iterator[str]:
    """Yield the names of the parameters of a section, with dots between nested keys."""
    if not isinstance(part, dict):
        return
    for key, value in part.items():
        if isinstance(value, dict):
            yield from _parameters(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}"


def wrong_argument(arguments: Sequence[str]) -> str:
    """Return why ROS cannot read an argument, with a remedy; empty if it reads all."""
    for option in _options(arguments):
        value = option.value
        problem = _wrong_file(value) if option.is_file else _wrong_rule(value)
        if problem:
            return problem
    return ""


def _wrong_rule(rule: str) -> str:
    """Return why a setting of -p, NAME:=VALUE, cannot be read; empty if it can."""
    target, assignment, value = rule.partition(":=")
    if not assignment:
        example = "write -p NAME:=VALUE, as in -p robot_radius:=0.3"
        return f"-p {rule} has no ':='; {example}"
    node, colon, name = target.rpartition(":")
    if colon and "/" in node:
        remedy = f"write -p {_node_name(node)}:{name}:={value}"
        return f"-p {rule} names a node with '/'; {remedy}"
    if not value.strip():
        remedy = f"give one, and for an empty text: -p \"{target}:=''\""
        return f"-p {rule} has no value; {remedy}"
    try:
        yaml.load(value, Loader=yaml.BaseLoader)
    except yaml.YAMLError as error:
        problem = f"the value is no YAML ({_reason(error)})"
        return f"-p {rule}: {problem}; put a text in quotes"
    return ""


def _wrong_file(file: str) -> str:
    """Return why a parameter file cannot be read; empty if it can."""
    name = f"the parameter file {file!r}"
    form = "write NODE:, below it ros__parameters:, and below that NAME: VALUE"
    try:
        document = yaml.load(Path(file).read_bytes(), Loader=yaml.BaseLoader)
    except OSError as error:
        return f"{name} cannot be read ({error.strerror}); check the path"
    except (ValueError, yaml.YAMLError, RecursionError) as error:
        return f"{name} is no YAML ({_reason(error)}); correct it"
    if not document:
        return f"{name} is empty; {form}, or leave it out"
    if not [*_sections(document)]:
        similar = nearest(PARAMETERS, _keys(document))
        instead = f", but {similar}" if similar else ""
        return f"{name} has no {PARAMETERS}{instead}; {form}"
    return ""


def _keys(document: object) -> Iterator[str]:
    """Yield all keys of a YAML document, at any depth."""
    if isinstance(document, dict):
        for key, part in document.items():
            yield key
            yield from _keys(part)


def _reason(error: Exception) -> str:
    """Return why a text is no YAML, with the number of the line if it is known."""
    if isinstance(error, yaml.MarkedYAMLError) and error.problem_mark is not None:
        return f"line {error.problem_mark.line + 1}: {error.problem}"
    return str(error).partition("\n")[0]

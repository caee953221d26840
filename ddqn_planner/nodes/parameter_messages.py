"""Parameters as `ros2 param set` and other clients send them."""

from collections.abc import Callable, Sequence

from rcl_interfaces.msg import Parameter as ParameterMessage
from rclpy.parameter import Parameter

from ddqn_planner.nodes.declared import Parameters, read_all
from ddqn_planner.nodes.overrides import unread_names


def parameters_from_messages(
    messages: Sequence[ParameterMessage],
    declared: Parameters,
    has_parameter: Callable[[str], bool],
    node_name: str,
) -> list[Parameter]:
    """Return parameters with their values in the types that the node declares.

    Parameters
    ----------
    messages
        The parameters of one request.
    declared
        The node's own parameters.
    has_parameter
        Whether the node has a parameter of a name, its own or one of ROS.
    node_name
        The node's full name, for errors.

    Raises
    ------
    ValueError
        If the node cannot set a parameter; with the remedy.
    """
    names = [message.name for message in messages]
    _check_names(names)
    unknown = [name for name in names if not has_parameter(name)]
    if unknown:
        raise ValueError(unread_names(unknown, declared, node_name))
    _check_writable(names, declared)
    parameters = [_from_message(message) for message in messages]
    return _with_declared_types(parameters, declared)


def _with_declared_types(
    parameters: Sequence[Parameter], declared: Parameters
) -> list[Parameter]:
    """Return parameters with values of declared types; those of ROS as they are.

    A ValueError names all values that a declared parameter cannot have.
    """
    values = {
        parameter.name: parameter.value
        for parameter in parameters
        if parameter.name in declared
    }
    checked_values = read_all(declared, values)
    return [
        Parameter(parameter.name, value=checked_values[parameter.name])
        if parameter.name in checked_values
        else parameter
        for parameter in parameters
    ]


def _check_names(names: Sequence[str]) -> None:
    """Raise a ValueError if a name is empty, or comes twice in one request."""
    if not all(names):
        raise ValueError("a parameter has no name; give one")
    repeated = {name for name in names if names.count(name) > 1}
    if repeated:
        wrong = f"{', '.join(sorted(repeated))} is set twice in one request"
        raise ValueError(f"{wrong}; give one value each")


def _check_writable(names: Sequence[str], declared: Parameters) -> None:
    """Raise a ValueError if one of the parameters may only be set at the start."""
    for name in names:
        if name in declared and declared[name].read_only:
            start = f"set it at the start, with -p {name}:=VALUE or in a file"
            raise ValueError(f"{name} is read-only; {start}")


def _from_message(message: ParameterMessage) -> Parameter:
    """Return a parameter as rclpy has it; ValueError if its type is unknown."""
    try:
        parameter: Parameter = Parameter.from_parameter_msg(message)
    except ValueError as error:
        remedy = "give one of rcl_interfaces/msg/ParameterType"
        raise ValueError(f"{error}; {remedy}") from None
    return parameter

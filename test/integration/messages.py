"""Messages of every kind for the property tests of the nodes: whole ones, and malformed
ones.
"""

import array
import math

from geometry_msgs.msg import Point, Pose, PoseStamped, Quaternion
from hypothesis import strategies as st
from nav_msgs.msg import OccupancyGrid
from rcl_interfaces.msg import Parameter, ParameterValue
from std_msgs.msg import Header

from ddqn_planner.nodes.conversions import quaternion

# A string of a message ends at its first NUL, and is UTF-8.
TEXTS = st.text(
    st.characters(exclude_categories=["Cs"], exclude_characters="\0"), max_size=30
)
ODD = st.sampled_from([math.nan, math.inf, -math.inf])
NUMBERS = (
    st.floats()
    | st.floats(-10, 10)
    | st.sampled_from([1e300, -1e300, 5e-324, 1e38])
    | ODD
)
# The checks of messages refuse the greatest float32.
NUMBERS_32 = (
    st.floats(-(2.0**127), 2.0**127, width=32) | st.floats(-2, 2, width=32) | ODD
)
INTEGERS = st.integers(-(2**63), 2**63 - 1) | st.integers(-1, 101)
FRAMES = st.sampled_from(["map", "map", "map", "", "odom", "/map", "ma" * 500]) | TEXTS
HEADERS = st.builds(lambda frame: Header(frame_id=frame), FRAMES)
POINTS = st.builds(lambda x, y, z: Point(x=x, y=y, z=z), NUMBERS, NUMBERS, NUMBERS)
QUATERNIONS = st.floats(-7, 7).map(quaternion) | st.builds(
    lambda x, y, z, w: Quaternion(x=x, y=y, z=z, w=w),
    NUMBERS,
    NUMBERS,
    NUMBERS,
    NUMBERS,
)
POSES = st.builds(lambda p, q: Pose(position=p, orientation=q), POINTS, QUATERNIONS)
STAMPED_POSES = st.builds(lambda h, p: PoseStamped(header=h, pose=p), HEADERS, POSES)
PARAMETER_VALUES = st.builds(
    ParameterValue,
    type=st.integers(0, 11) | st.just(255),
    bool_value=st.booleans(),
    integer_value=INTEGERS,
    double_value=NUMBERS,
    string_value=TEXTS,
    byte_array_value=st.lists(st.binary(min_size=1, max_size=1), max_size=3),
    bool_array_value=st.lists(st.booleans(), max_size=3),
    integer_array_value=st.lists(INTEGERS, max_size=3),
    double_array_value=st.lists(NUMBERS, max_size=3),
    string_array_value=st.lists(TEXTS, max_size=3),
)


def some_parameters(names: list[str]) -> st.SearchStrategy[list[Parameter]]:
    name = st.sampled_from(names) | TEXTS
    return st.lists(st.builds(Parameter, name=name, value=PARAMETER_VALUES), max_size=4)


@st.composite
def maps(draw: st.DrawFn) -> OccupancyGrid:
    """A map: turned, of any values, and often malformed in one way or more."""
    message = OccupancyGrid(header=draw(HEADERS))
    width, height = draw(st.integers(0, 7)), draw(st.integers(0, 7))
    message.info.width, message.info.height = width, height
    message.info.resolution = draw(st.just(0.5) | NUMBERS_32)
    message.info.origin = draw(POSES)
    values = draw(
        st.lists(st.integers(-128, 127), min_size=width * height, max_size=50)
    )
    message.data = array.array(
        "b", values[: draw(st.sampled_from([width * height, None]))]
    )
    if draw(st.booleans()):
        message.info.width = draw(st.sampled_from([1, 2**16, 2**31, 2**32 - 1]))
    return message

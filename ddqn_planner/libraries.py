"""What to install where a library is missing that not every part of the package needs."""

from __future__ import annotations

from typing import Final

ROS: Final = "install ROS 2 Jazzy and source it, or in the repository: pip install '.[ros]'"

TRAINING: Final = "pip install torch gymnasium"

REMEDIES: Final = {
    "gymnasium": TRAINING,
    "matplotlib": "pip install matplotlib",
    "mcap": "pip install mcap-ros2-support",
    "mcap_ros2": "pip install mcap-ros2-support",
    "numba": "pip install numba",
    "rclpy": ROS,
    "safetensors": "pip install safetensors",
    "torch": TRAINING,
}
"""By module, except those of ROS's messages."""


def with_remedy(error: Exception) -> str:
    """Return what an error says, and what to install if it is a missing library."""
    library = (getattr(error, "name", None) or "").partition(".")[0]
    of_ros = library.endswith(("_interfaces", "_msgs", "_srvs"))
    remedy = ROS if of_ros else REMEDIES.get(library)
    return f"{error}; {remedy}" if remedy else str(error)

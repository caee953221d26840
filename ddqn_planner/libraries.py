"""What to install where a library is missing that not every part of the package needs."""

from __future__ import annotations

from typing import Final

ROS: Final = "install ROS 2 Jazzy and source it, or in the repository: pip install '.[ros]'"

PACKAGES: Final = {
    "gymnasium": "torch gymnasium",
    "matplotlib": "matplotlib",
    "mcap": "mcap-ros2-support",
    "mcap_ros2": "mcap-ros2-support",
    "numba": "numba",
    "rerun": "'rerun-sdk>=0.39'",
    "safetensors": "safetensors",
    "torch": "torch gymnasium",
}
"""What to give to pip, by module."""


def with_remedy(error: Exception) -> str:
    """Return what an error says, and what to install if it is a missing library."""
    library = (getattr(error, "name", None) or "").partition(".")[0]
    if library == "rclpy" or library.endswith(("_interfaces", "_msgs", "_srvs")):
        return f"{error}; {ROS}"
    if library in PACKAGES:
        return f"{error}; pip install {PACKAGES[library]}"
    return str(error)

"""Packages of ROS that a node can use, but does not need."""

import os


def apt_install(package: str) -> str:
    """Return the command that installs a package for the sourced ROS release."""
    release = os.environ.get("ROS_DISTRO", "jazzy")
    return f"apt install ros-{release}-{package}"

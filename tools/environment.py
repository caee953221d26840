"""Makes the Makefile's virtual environment, and prints the extras to install into it.

python3 tools/environment.py .venv

Any Python can read this file, so that one that is too old says so.
"""

import os
import subprocess
import sys

OLDEST = (3, 10)
SUPPORTED = ("jazzy", "kilted", "lyrical", "rolling")
FACTS = "import sys, pip; sys.stdout.write(str(sys.version_info[:3]))"

folder = sys.argv[1]
version = ".".join(map(str, sys.version_info[:2]))
remedy = "name another one, such as make PYTHON=python3.12"

if sys.version_info[:2] < OLDEST:
    sys.exit(
        sys.executable
        + " is Python "
        + version
        + "; 3.10 or later is needed: "
        + remedy
    )

try:
    import ensurepip  # noqa: F401
    import venv  # noqa: F401
except ImportError:
    package = "apt install python" + version + "-venv"
    sys.exit(
        sys.executable
        + " cannot make virtual environments: "
        + package
        + ", or "
        + remedy
    )


def answer(python, program):
    """Return what a program prints, or None if it fails."""
    options = {"stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL, "check": False}
    try:
        run = subprocess.run([python, "-c", program], **options)
    except OSError:
        return None
    return run.stdout.decode() if run.returncode == 0 else None


distribution = os.environ.get("ROS_DISTRO", "")
if distribution and distribution not in SUPPORTED:
    sys.exit(
        "ROS 2 " + distribution + " is sourced; this package is for Jazzy and later. "
        "Run make in a shell that sources no ROS: it then takes Jazzy from PyPI"
    )
if distribution and answer(sys.executable, "import rclpy") is None:
    sys.exit(
        "ROS_DISTRO is "
        + distribution
        + ", but "
        + sys.executable
        + " cannot import its rclpy. "
        "Source /opt/ros/"
        + distribution
        + "/setup.bash and give make PYTHON=/usr/bin/python3, "
        "or unset ROS_DISTRO to take ROS 2 Jazzy from PyPI"
    )

command = [sys.executable, "-m", "venv"]
if distribution:
    command.append("--system-site-packages")
python = os.path.join(folder, "bin", "python")
# Another Python's environment, a moved one, or one whose Python is gone.
if os.path.exists(folder) and answer(python, FACTS) != str(sys.version_info[:3]):
    command.append("--clear")
command.append(folder)
code = subprocess.call(command, stdout=sys.stderr)
if code:
    sys.exit(code)
sys.stdout.write("figures" if distribution else "figures,ros")

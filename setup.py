import re
import sys
from glob import glob
from pathlib import Path
from xml.etree import ElementTree

from setuptools import find_packages, setup

PACKAGE = "ddqn_planner"
# `colcon build --symlink-install` runs a link to this file, in a folder without the
# others.
ROOT = Path(__file__).resolve().parent
MANIFEST = ElementTree.parse(ROOT / "package.xml")
VERSION = MANIFEST.findtext("version")
REPOSITORY = MANIFEST.findtext("url[@type='repository']")
MAINTAINER = MANIFEST.find("maintainer")


def readme_for_pypi():
    """Return README with full addresses: PyPI shows it without the repository."""
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    text = text.replace("<this repository>", REPOSITORY)
    address = rf"\1{REPOSITORY}/%s/v{VERSION}/"
    relative = r"\]\()(?!https?://|#)"
    text = re.sub(rf"(!\[[^]]*{relative}", address % "raw", text)
    return re.sub(rf"((?<!!)\[[^]]*{relative}", address % "blob", text)


data_files = [
    ("share/ament_index/resource_index/packages", [f"resource/{PACKAGE}"]),
    (f"share/{PACKAGE}", ["package.xml"]),
    (f"share/{PACKAGE}/rviz", glob("rviz/*")),
    (f"share/{PACKAGE}/launch", glob("launch/*.launch.py")),
    # The examples look for their helpers where these lie in the repository.
    (f"share/{PACKAGE}/examples", glob("examples/*.py")),
    (f"share/{PACKAGE}/experiments", glob("experiments/*.py")),
]
# The package reads the maps and models beside its code. A workspace has copies for
# ROS's tools; a wheel has none.
if "bdist_wheel" not in sys.argv:
    data_files += [
        (f"share/{PACKAGE}/maps", glob("maps/*")),
        (f"share/{PACKAGE}/models", glob("models/*")),
    ]

setup(
    name=PACKAGE,
    version=VERSION,
    description="Plans robot paths on grid maps with a Double DQN, as ROS 2 nodes",
    long_description=readme_for_pypi(),
    long_description_content_type="text/markdown",
    license="Apache-2.0",
    maintainer=MAINTAINER.text,
    maintainer_email=MAINTAINER.get("email"),
    url=REPOSITORY,
    project_urls={
        "Documentation": f"{REPOSITORY}/tree/v{VERSION}/docs",
        "Changelog": f"{REPOSITORY}/blob/v{VERSION}/CHANGELOG.md",
        "Issues": f"{REPOSITORY}/issues",
        "Paper": "https://arxiv.org/abs/2107.11245",
    },
    keywords=[
        "path planning",
        "robotics",
        "ROS 2",
        "Nav2",
        "grid map",
        "Double DQN",
        "reinforcement learning",
        "Gymnasium",
    ],
    classifiers=[
        "Development Status :: 4 - Beta",
        "Intended Audience :: Developers",
        "Intended Audience :: Education",
        "Intended Audience :: Science/Research",
        "License :: OSI Approved :: Apache Software License",
        "Operating System :: POSIX :: Linux",
        "Programming Language :: Python :: 3",
        *(f"Programming Language :: Python :: 3.{minor}" for minor in range(10, 15)),
        "Topic :: Scientific/Engineering :: Artificial Intelligence",
        "Typing :: Typed",
    ],
    packages=find_packages(include=[PACKAGE, f"{PACKAGE}.*"]),
    # Links in the source tree, files in what is built from it.
    package_data={PACKAGE: ["py.typed", "maps/*", "models/*"]},
    data_files=data_files,
    zip_safe=False,
    python_requires=">=3.10",
    install_requires=[
        "numba>=0.58",
        "numpy>=1.26",
        "Pillow>=10.0",
        "PyYAML>=6.0",
        "safetensors>=0.4",
        "scipy>=1.11",
        "tqdm>=4.60",
    ],
    extras_require={
        "train": ["gymnasium>=1.1", "torch>=2.1"],
        # Of these, the tests alone need test_msgs, for its action.
        "ros": [
            "ros-jazzy-rclpy[fastrtps]>=7.1.5,<8",
            "ros-jazzy-common-interfaces>=5.3,<6",
            "ros-jazzy-test-msgs>=2,<3",
        ],
        "ros-kilted": [
            "ros-kilted-rclpy[fastrtps]>=9,<10",
            "ros-kilted-common-interfaces>=5.5,<6",
            "ros-kilted-test-msgs>=2.3,<3",
        ],
        "figures": ["matplotlib>=3.6"],
        "tensorboard": ["tensorboard>=2.10"],
        "experiments": ["joblib>=1.3", "matplotlib>=3.6"],
        # mcap brings zstandard, which unpacks bags of each kind.
        "bags": ["mcap>=1.1", "rosbags>=0.10"],
        "docs": ["furo", "myst-parser>=3.0", "sphinx>=7.3", "sphinx-copybutton>=0.5"],
        "bench": [
            "dijkstra3d>=1.15",
            "nano-astar>=0.1.2",
            "psutil>=5.9",
            "pyastar2d>=1.1",
            "stable-baselines3>=2.6",
            "tcod>=21",
        ],
        "test": [
            "colcon-core>=0.15",
            "colcon-package-selection",
            "colcon-ros>=0.4",
            "hypothesis>=6.80",
            "pytest>=7.4",
            "pytest-cov>=4.1",
            "pytest-xdist>=3.5",
            # With a newer one, colcon's --symlink-install makes copies.
            "setuptools<80",
            "shapely>=2.0",
        ],
        "lint": ["mypy>=1.10", "ruff>=0.9", "types-PyYAML", "types-tqdm"],
    },
    entry_points={
        "console_scripts": [
            "ddqn-planner = ddqn_planner.cli:main",
            "map_server_node = ddqn_planner.nodes:run_map_server",
            "planner_node = ddqn_planner.nodes:run_planner",
            "trainer_node = ddqn_planner.nodes:run_trainer",
        ],
    },
)

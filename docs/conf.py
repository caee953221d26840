"""The site of these pages: `make docs` writes it to docs/_build/html."""

import os
import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree

DOCS = Path(__file__).resolve().parent
sys.path.insert(0, str(DOCS.parent))

project = "ddqn_planner"
author = "ddqn_planner maintainers"
copyright = "ddqn_planner maintainers, Apache-2.0"
manifest = ElementTree.parse(DOCS.parent / "package.xml")
release = manifest.findtext("version")
repository = manifest.findtext("url[@type='repository']", "")

extensions = [
    "myst_parser",
    "sphinx_copybutton",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
]
exclude_patterns = ["_build"]
html_theme = "furo"
# Links to the sources of a page. They show nothing before the repository is public.
if ".example" not in repository:
    html_theme_options = {
        "source_edit_link": f"{repository}/edit/main/docs/{{filename}}",
        "source_view_link": f"{repository}/blob/main/docs/{{filename}}",
    }
html_title = f"ddqn_planner {release}"
html_static_path = ["_static"]
html_css_files = ["site.css"]
# Buttons that copy a block leave out the prompt and the output after it.
copybutton_prompt_text = "$ "
copybutton_exclude = ".linenos, .gp, .go"

pygments_style = "friendly"
pygments_dark_style = "native"

myst_heading_anchors = 3
myst_enable_extensions = ["colon_fence"]
nitpicky = False
napoleon_google_docstring = False
autodoc_member_order = "bysource"
autodoc_typehints = "none"
default_role = "code"


def write_command_line() -> None:
    """Write the help of each command to a file that command_line.md includes."""
    folder = DOCS / "_build" / "help"
    folder.mkdir(parents=True, exist_ok=True)
    environment = {**os.environ, "COLUMNS": "88", "PYTHONPATH": str(DOCS.parent)}
    from ddqn_planner.cli import COMMANDS

    command = [sys.executable, "-c", "from ddqn_planner.cli import main; main()"]
    for name in COMMANDS:
        help_command = [*command, name, "--help"]
        text = subprocess.run(
            help_command, env=environment, stdout=subprocess.PIPE, check=True
        ).stdout
        if not text:
            raise RuntimeError(f"{help_command} prints nothing")
        (folder / f"{name}.txt").write_bytes(text)


write_command_line()

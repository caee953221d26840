"""No node uses a private name of rclpy or of a message: those change with any
release.
"""

import ast
import importlib
from collections.abc import Iterator
from pathlib import Path

import rclpy

ROOT = Path(__file__).resolve().parents[2] / "ddqn_planner"
PUBLIC = {
    "_asdict",
    "_fields",
    "_make",
    "_replace",
    "_exit",
}  # though they look private: of tuples, and os


def is_private(name: str) -> bool:
    return name.startswith("_") and not name.startswith("__")


def trees(*folders: Path) -> Iterator[ast.AST]:
    for folder in folders:
        for path in folder.rglob("*.py"):
            yield ast.parse(path.read_text(encoding="utf-8"))


def attributes(tree: ast.AST) -> Iterator[ast.Attribute]:
    return (node for node in ast.walk(tree) if isinstance(node, ast.Attribute))


def defined(tree: ast.AST) -> Iterator[str]:
    """Yield the private names that a module's classes and functions define."""
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            yield node.name
        elif isinstance(node, ast.AnnAssign | ast.Assign):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            names = (name for target in targets for name in ast.walk(target))
            yield from (name.id for name in names if isinstance(name, ast.Name))
    for attribute in attributes(tree):
        is_ours = isinstance(attribute.value, ast.Name) and attribute.value.id in (
            "self",
            "cls",
        )
        if is_ours and isinstance(attribute.ctx, ast.Store):
            yield attribute.attr


def test_each_private_name_in_the_nodes_is_the_packages_own() -> None:
    own = {name for tree in trees(ROOT) for name in defined(tree) if is_private(name)}
    used = {
        at.attr
        for tree in trees(ROOT / "nodes")
        for at in attributes(tree)
        if is_private(at.attr)
    }
    assert used
    assert used <= own | PUBLIC


def node_classes() -> Iterator[ast.ClassDef]:
    for tree in trees(ROOT / "nodes"):
        for node in ast.walk(tree):
            if isinstance(node, ast.ClassDef) and "Node" in ast.unparse(
                ast.List(node.bases)
            ):
                yield node


def test_the_nodes_hide_no_private_name_of_rclpys_node() -> None:
    source = Path(importlib.import_module("rclpy.node").__file__ or "")
    theirs = {
        name for name in defined(ast.parse(source.read_text())) if is_private(name)
    }
    ours = {
        name for node in node_classes() for name in defined(node) if is_private(name)
    }
    assert min(len(theirs), len(ours)) > 10
    assert not ours & theirs


def test_no_private_module_of_rclpy_is_imported() -> None:
    for tree in trees(ROOT):
        for node in ast.walk(tree):
            names = (
                [alias.name for alias in node.names]
                if isinstance(node, ast.Import)
                else []
            )
            if isinstance(node, ast.ImportFrom) and node.module:
                names = [f"{node.module}.{alias.name}" for alias in node.names]
            for name in names:
                parts = name.split(".")
                is_of_rclpy = parts[0] == rclpy.__name__
                assert not is_of_rclpy or not any(
                    p.startswith("_") or p == "impl" for p in parts
                )

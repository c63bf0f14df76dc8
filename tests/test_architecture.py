"""The layout is what docs/architecture.md says: what imports what, no circle, modules of a readable size."""

import ast
import re
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
MODULES = {
    ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): path
    for path in (ROOT / "sealfit").rglob("*.py")
}
LARGEST = 450
"""Lines of a module, so that one sitting is enough to read it."""

LARGER = {"sealfit.cli", "sealfit.config", "sealfit.tables"}
"""What holds one definition after the other may be larger."""


def imported(module):
    """Return the modules of sealfit that a module imports when it is loaded."""
    found = set()
    for node in ast.parse(MODULES[module].read_text("utf-8")).body:
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("sealfit"):
            found |= {
                f"{node.module}.{a.name}" if f"{node.module}.{a.name}" in MODULES else node.module
                for a in node.names
            }
    return found - {module, "sealfit"}


def allowed():
    """Return, by folder or module, what the table of the document allows."""
    table = (ROOT / "docs" / "architecture.md").read_text("utf-8").split("|---|---|\n")[1].split("\n\n")[0]
    rows = [line.strip("|").split("|") for line in table.splitlines()]
    return {
        name: set(re.findall(r"\w+", row[1])) for row in rows for name in re.findall(r"`([\w/]+)`", row[0])
    }


@pytest.mark.parametrize("module", sorted(set(MODULES) - {"sealfit", "sealfit.__main__"}))
def test_a_module_imports_what_its_folder_may(module):
    folder = module.split(".")[1]
    others = {name.split(".")[1] for name in imported(module)} - {folder}
    assert others <= allowed()[folder]


def test_no_import_goes_in_a_circle():
    list(TopologicalSorter({module: imported(module) for module in MODULES}).static_order())


def test_modules_are_few_at_the_root_and_of_a_readable_size():
    assert len(list((ROOT / "sealfit").glob("*.py"))) <= 10
    assert len(MODULES) <= 140
    sizes = {module: len(path.read_text("utf-8").splitlines()) for module, path in MODULES.items()}
    assert {module for module, lines in sizes.items() if lines > LARGEST} <= LARGER

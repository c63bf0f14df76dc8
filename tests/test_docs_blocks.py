"""Every command and code block of the documents is parsed, and every link leads somewhere."""

import ast
import importlib
import inspect
import re
import shlex
import tomllib
from contextlib import nullcontext, suppress

import pytest
from markdown.extensions.toc import slugify
from page_helpers import DOCS, ROOT
from typer.main import get_command

import sealfit
from sealfit.cli import app
from sealfit.config import Config, parse_config

GENERATED = DOCS / "reference" / "commands.md"  # written by typer; its examples are written by hand
PAGES = sorted(
    page for part in ("*", "docs/**/*", "benchmarks/*", "sample_data/*") for page in ROOT.glob(f"{part}.md")
)
NAMES = {page: str(page.relative_to(ROOT)) for page in PAGES}
TABLES = {name: field.annotation for name, field in Config.model_fields.items()}
SUFFIXES = ("csv", "xlsx", "parquet", "py")  # of files that are called as a table of the config
COMMANDS = get_command(app).commands
TARGETS = re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text("utf-8"), re.MULTILINE)
EXTRAS = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]["optional-dependencies"]
OTHERS = ("dask", "openssl", "export", "for", "done", "head")
FOLDERS = ("configs/", "sample_data/", "benchmarks/", "tests/")  # what commands read of the repository
OUTPUT = r"verdict  |aging  |h = |campaign folder  "  # how indented blocks begin that show no command


def parts(page):
    """Return the fenced blocks of a page, each with its kind, the indented ones, commands within lines."""
    text = page.read_text("utf-8")
    fenced = re.findall(r"^```(.*)\n((?:.*\n)*?)```$", text, re.MULTILINE)
    text = re.sub(r"^```.*\n(?:.*\n)*?```$", "", text, flags=re.MULTILINE)
    indented = re.findall(r"(?<=\n\n)(?: {4}.*\n|\n(?= {4}))+", text)
    return fenced, indented, re.findall(r"`((?:sealfit|make|python|pip) [^`]+)`", text)


def commands(block):
    """Return the command lines of an indented block: those after a prompt, or else all; none of an output."""
    lines = [line.strip().removeprefix(".venv/bin/") for line in block.splitlines() if line.strip()]
    if re.match(OUTPUT, lines[0]):
        return []
    prompted = [line[2:] for line in lines if line.startswith("$ ")]
    return prompted or [re.split(r"\s{2,}", line)[0] for line in lines]


def check_command(line):
    """Fail where a command, its options or a file of it does not exist; what stands for arguments is free."""
    program, *words = shlex.split(re.sub(r"\[(--\S+).*?\]", r"\1", line), comments=True)
    assert all((ROOT / word).exists() for word in words if word.startswith(FOLDERS)), line
    if program == "sealfit" and words[0] in COMMANDS:
        # `sealfit report` within a line names the command, and need have no argument.
        with nullcontext() if words[1:] else suppress(Exception):
            COMMANDS[words[0]].make_context(words[0], words[1:])
    elif program == "sealfit":
        assert words[0] in ("STEP", "--help", "--version"), line
    elif program == "make":
        assert set(words) <= {*TARGETS}, line
    elif program == "pip":
        assert set(re.findall(r"\[(\w+)\]", line)) <= {*EXTRAS}, line
    elif program in ("python", "python3"):
        script = "" if words[0] in ("-m", "-c") else (ROOT / words[0]).read_text("utf-8")
        assert not script or all(word in script for word in words if word.startswith("--")), line
    else:
        assert program in OTHERS, line


def check_python(code):
    """Fail where code does not compile, or a name or an argument of sealfit in it does not exist."""
    for node in ast.walk(ast.parse(code)):
        if isinstance(node, ast.ImportFrom) and node.module.split(".")[0] == "sealfit":
            assert all(hasattr(importlib.import_module(node.module), one.name) for one in node.names)
        elif isinstance(node, ast.Attribute) and ast.unparse(node.value) == "sealfit":
            assert hasattr(sealfit, node.attr), node.attr
        elif isinstance(node, ast.Call) and ast.unparse(node.func).startswith("sealfit."):
            function = getattr(sealfit, ast.unparse(node.func).removeprefix("sealfit."))
            inspect.signature(function).bind(*node.args, **{one.arg: one for one in node.keywords})
        elif isinstance(node, ast.List) and node.elts and ast.unparse(node.elts[0]) == "'sealfit'":
            words = [one.value if isinstance(one, ast.Constant) else "ADDRESS" for one in node.elts]
            check_command(shlex.join(words))


@pytest.mark.parametrize("page", PAGES, ids=NAMES.get)
def test_blocks_and_commands_are_sound(page):
    fenced, indented, inline = parts(page)
    for kind, block in fenced:
        if kind == "toml":
            assert parse_config(block, NAMES[page]) != Config()
        elif kind == "python":
            check_python(block)
        else:
            assert (kind, page) == ("console", GENERATED)
    examples = re.findall(r"^Example: (.*)$", page.read_text("utf-8"), re.MULTILINE)
    for line in [*examples, *inline, *(line for block in indented for line in commands(block))]:
        for one in line.split(" && "):
            check_command(one)


@pytest.mark.parametrize("page", PAGES, ids=NAMES.get)
def test_names_within_lines_exist(page):
    text = page.read_text("utf-8")
    for code in re.findall(r"`(sealfit\.\w[^`]*)`", text):
        check_python(code)
    for table, key in re.findall(r"`(\w+)\.(\w+)(?: = [^`]*)?`", text):
        if hasattr(TABLES.get(table), "model_fields"):
            assert key in {*TABLES[table].model_fields, *SUFFIXES}, f"{table}.{key}"


def anchors(page):
    """Return the fragments that the site gives the headings of a page."""
    headings = re.findall(r"^#+ (.*)$", page.read_text("utf-8"), re.MULTILINE)
    return {slugify(re.sub(r"[`*]", "", heading), "-") for heading in headings}


@pytest.mark.parametrize("page", PAGES, ids=NAMES.get)
def test_links_and_files_exist(page):
    text = page.read_text("utf-8")
    for link in re.findall(r"\]\(([^)\s]+)\)|(https?://[^\s)>`]*)", text):
        file, _, fragment = "".join(link).partition("#")
        if "://" in file:
            assert re.match(r"https://[\w-]+(\.[\w-]+)+(/|$)", file), file
            continue
        target = page.parent / file if file else page
        assert target.exists(), file
        assert not fragment or fragment in anchors(target), "".join(link)
    for name in re.findall(r"`((?:docs|tests|sealfit|configs|sample_data|benchmarks)/[\w./-]*)`", text):
        assert (ROOT / name).exists(), name

"""The examples in docs/ run and print what they say."""

import doctest
from pathlib import Path

import pytest

DOCS = sorted((Path(__file__).resolve().parents[1] / "docs").glob("*.md"))
WITH_RESULTS = ("notebook.md",)  # run where there are results of the sample campaign: tests/notebook
PAGES = [page for page in DOCS if ">>>" in page.read_text("utf-8") and page.name not in WITH_RESULTS]


@pytest.mark.parametrize("page", PAGES, ids=[page.name for page in PAGES])
def test_examples_print_what_they_say(page):
    failed, tried = doctest.testfile(str(page), module_relative=False, encoding="utf-8")
    assert tried > 10
    assert not failed

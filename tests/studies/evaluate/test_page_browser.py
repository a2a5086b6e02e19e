"""The page of an evaluation in a real browser: headings sort the rows, and nothing is loaded."""

import pytest
from browser import CHROMIUM, Browser
from html_pages import PROVENANCE

from pcbench.report.article import Article, ArticleSection, DataTable, TableCell
from pcbench.report.html import Origin, article_page

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium: apt-get install chromium")


def test_headings_sort_the_rows_without_a_title(tmp_path):
    values = {"b": "1,200", "a": "-3.5", "c": "–", "d": "20"}
    rows = [["scene", "error"], *([TableCell(name, "", "page.html"), value] for name, value in values.items())]
    table = DataTable("Errors", [*rows, ["over all", ""], ["mean", "7"], ["rank", "1"]], sortable=True)
    article = Article("Evaluation", "Title", ["Answer."], [], [], [ArticleSection("Table", [table])])
    path = tmp_path / "report.html"
    path.write_text(article_page(article, Origin(PROVENANCE), tmp_path))
    first = "[...document.querySelectorAll('.results tbody th[scope=row]')].map((cell) => cell.textContent)"
    with Browser() as browser:
        browser.open(path)
        assert browser.problems == []
        assert browser.run(first) == [*"bacd", "mean", "rank"]
        orders = []
        for column in (1, 1, 0, 0):
            browser.run(f"document.querySelectorAll('.results thead button')[{column}].click()")
            orders.append("".join(browser.run(first)[:4]))
        assert orders == ["adbc", "bdac", "abcd", "dcba"]
        assert browser.run(first)[4:] == ["mean", "rank"]
        assert browser.run("document.querySelector('tbody a').getAttribute('href')") == "./page.html"
        assert browser.run("document.querySelector('[aria-sort]').getAttribute('aria-sort')") == "descending"

"""Pages of studies in a real browser: their pictures load, and nothing else; narrow, dark and printed."""

from functools import partial

import pytest
from benches import row
from benches import study as study_of_rows
from browser import CHROMIUM, Browser
from html_pages import PROVENANCE
from optional import import_or_skip
from stress_studies import study as stress_study

from pcbench.report import to_json
from pcbench.report.plot import draw_if_possible
from pcbench.studies.bench.charts import CHARTS
from pcbench.studies.bench.page import article as bench_article
from pcbench.studies.bench.results import KIND as BENCH
from pcbench.studies.frame.publish import draw_here, write_report
from pcbench.studies.stress.charts import draw_charts
from pcbench.studies.stress.page import article as stress_article
from pcbench.studies.stress.study import KIND as STRESS

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium: apt-get install chromium")

NAME = "</td><img src=x onerror=document.title='broken'><script>document.title='broken'</script>"


@pytest.fixture(scope="module")
def browser():
    import_or_skip("matplotlib")
    with Browser() as opened:
        yield opened


def write_stress(folder):
    drawn = draw_here(lambda: draw_charts(stress_study(), folder))
    article = stress_article(stress_study(), drawn.relative_to(folder))
    assert drawn.problem is write_report(folder, STRESS, lambda: article, PROVENANCE) is None
    return len(drawn.files)


def write_bench(folder):
    measured = partial(row, points=10, threshold=0.1)
    rows = [measured(NAME, 1.0, 0.5), measured("b", 2.0, 0.9), row("c", 0.1, None, "failed", message=NAME)]
    study = study_of_rows(rows, provenance=PROVENANCE)
    (folder / BENCH.document).write_text(to_json(BENCH.values(study)))
    drawn = draw_if_possible(folder, CHARTS)
    article = bench_article(study, drawn.relative_to(folder))
    assert drawn.problem is write_report(folder, BENCH, lambda: article, PROVENANCE) is None
    return 1  # no accuracy in these rows


@pytest.fixture(scope="module", params=[pytest.param(write_stress, marks=pytest.mark.long), write_bench])
def page(request, tmp_path_factory):
    """Path of a page and the number of its pictures."""
    import_or_skip("matplotlib")
    folder = tmp_path_factory.mktemp("study")
    return folder / "report.html", request.param(folder)


def test_pictures_load_and_nothing_else(browser, page):
    path, count = page
    browser.open(path)
    assert browser.problems == []
    assert browser.requests[0] == path.as_uri()
    assert all(address.startswith("data:image/png") for address in browser.requests[1:])
    widths = browser.run("[...document.images].map((image) => image.complete && image.naturalWidth)")
    assert len(widths) == count and all(width > 300 for width in widths)
    assert "broken" not in browser.run("document.title").replace("'broken'", "")
    assert browser.run("document.scripts.length") == 0


@pytest.mark.parametrize("dark", [False, True])
def test_narrow_screens_scroll_tables_and_pictures_alone(browser, page, dark):
    browser.open(page[0], width=390, height=800, dark=dark)
    assert browser.run("document.documentElement.scrollWidth") <= 390
    regions = browser.run(
        "[...document.querySelectorAll('.scroll')].map((e) => [e.tabIndex, e.getAttribute('aria-label').length])"
    )
    assert regions and all(tab == 0 and label > 5 for tab, label in regions)
    ground = browser.run("getComputedStyle(document.body).backgroundColor")
    assert ground == ("rgb(22, 24, 28)" if dark else "rgb(255, 255, 255)")


def test_it_is_printed(browser, page, tmp_path):
    browser.open(page[0])
    browser.print_to_pdf(tmp_path / "page.pdf")
    assert (tmp_path / "page.pdf").read_bytes().startswith(b"%PDF")
    assert (tmp_path / "page.pdf").stat().st_size > 20_000

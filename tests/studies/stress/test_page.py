"""The article of the stress study, as Markdown."""

import re

from stress_studies import study

from pcbench.report.article import markdown
from pcbench.studies.stress.page import article
from pcbench.studies.stress.results import SilentFailure
from pcbench.studies.stress.subject import SILENT
from pcbench.studies.stress.words import answer, warnings


def page(*arguments):
    return markdown(article(*arguments))


def test_the_answer_comes_first_and_all_sentences_follow():
    text = page(study())
    lines = text.splitlines()
    assert lines[0] == "# Where registration, metrics and verdicts break"
    first = list(answer(study()))
    assert lines[2 : 2 + len(first)] == [f"- {sentence}" for sentence in first]
    for sentence in warnings(study()):
        assert f"- {sentence}" in lines


def test_pictures_are_shown_once_and_only_those_that_were_drawn():
    names = ["outcomes_registration.png", "severity_verdicts_warp.png", "severity_registration_start.png", "recall.png"]
    text = page(study(), [f"figures/{name}" for name in names])
    assert sorted(re.findall(r"\(\./figures/(.*?)\)", text)) == sorted(names)
    assert "![Success against severity (start)](./figures/severity_registration_start.png)" in text
    assert "figures/" not in page(study())


def test_the_worst_silent_failures_are_listed_with_their_pictures():
    cell = next(c for c in study().registrations if c.outcome == SILENT)
    made = study(worst=(SilentFailure(cell, "worst_1.npz"),))
    assert "1. icp: rotation of the start 90 deg; city, seed 2" in page(made)
    assert "(./figures/worst_1.png)" not in page(made)
    assert "(./figures/worst_1.png)" in page(made, ["figures/worst_1.png"])


def test_tables_are_complete_markdown():
    tables = [line for line in page(study()).splitlines() if line.startswith("|")]
    widths = {line.count("|") for line in tables}
    assert min(widths) >= 3
    assert len(tables) > 20


def test_subjects_without_cells_have_no_section():
    ours = tuple(cell for cell in study().registrations if cell.method == "icp")
    text = page(study(registrations=ours, metrics=(), verdicts=(), missing=()))
    assert "## Registration" in text
    assert "## Metrics" not in text
    assert "## Verdicts" not in text
    assert "## What not to trust" not in text

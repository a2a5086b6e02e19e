"""The parts that all pages share: the base template alone, without a comparison or a study."""

import re

from html_pages import HOSTILE, PROVENANCE, Page

from pcbench.report.html.template import InputRow, Opening, Origin, render

OPENING = Opening("A kind", "A title", "A subtitle", ["First.", "Second."], ["Doubtful."], ["Remarkable."])


def test_a_page_without_a_script_forbids_scripts():
    text = render("base.html", OPENING, Origin(PROVENANCE))
    policy = next(value for name, value in Page(text).attributes if value and "default-src" in value)
    assert policy == "default-src 'none'; style-src 'unsafe-inline'; img-src data:"
    assert "<script" not in text
    with_script = render("base.html", OPENING, Origin(PROVENANCE), script="1 < 2")
    assert "<script>\n1 < 2\n</script>" in with_script and "script-src 'sha256-" in with_script


def test_opening_and_origin_are_on_the_page_in_this_order():
    origin = Origin(PROVENANCE, "pcbench again", [InputRow("reference", "ref.ply", "ab" * 32, "UTM zone 17N, in m")])
    words = "".join(Page(render("base.html", OPENING, origin)).words)
    expected = ["A kind", "A title", "A subtitle", *OPENING.answer, "What not to trust", "Doubtful.", "Remarkable."]
    expected += ["1.2, commit abc", PROVENANCE["command"], "pcbench again", "ref.ply", "ab" * 32]
    places = [words.rindex(text) for text in expected]
    assert places == sorted(places)


def test_hostile_texts_stay_text():
    opening = Opening(HOSTILE, HOSTILE, HOSTILE + "\u202e", [HOSTILE] * 2, [HOSTILE + "\n\u202e"], [HOSTILE])
    origin = Origin(dict.fromkeys(PROVENANCE, HOSTILE), HOSTILE, [InputRow(*(HOSTILE,) * 4)])
    text = render("base.html", opening, origin)
    plain = Page(render("base.html", OPENING, Origin(PROVENANCE, "-", [InputRow(*("-",) * 4)])))
    assert Page(text).tags == plain.tags and Page(text).unbalanced == plain.unbalanced == []
    assert "\u202e" not in text and not re.search("49", text)

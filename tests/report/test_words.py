"""Numbers in sentences: singular for one, and no ratio of one."""

import numpy as np
import pytest
from wording import check_text

from pcbench import compare
from pcbench.measure.wording import pluralize, ratio_in_words
from pcbench.report.plot.panels import _bar_label
from pcbench.report.words import title


@pytest.mark.parametrize(
    ("count", "words"), [(0, "0 points"), (1, "1 point"), (2, "2 points"), (12_000, "12,000 points")]
)
def test_nouns_agree_with_their_numbers(count, words):
    assert pluralize(count, "point") == words


@pytest.mark.parametrize(
    ("ratio", "words"), [(0.5, "0.5 times as many"), (0.999, "as many"), (1.04, "as many"), (11.2, "11 times as many")]
)
def test_ratios_in_words(ratio, words):
    assert ratio_in_words(ratio, "many") == words


@pytest.mark.parametrize(
    ("length", "unit", "words"),
    [
        (1.0, "m", "1 m"),
        (0.5, "ft", "0.5 ft"),
        (1.0, "units of the file", "1 unit"),
        (20.0, "units of the file", "20 units"),
    ],
)
def test_labels_of_scale_bars(length, unit, words):
    assert _bar_label(length, unit) == words


def test_single_points_are_counted_in_the_singular():
    comparison = compare(np.zeros((1, 3)), np.ones((1, 3)), register="none")
    check_text(title(comparison))

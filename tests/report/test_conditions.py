"""Conditions on the numbers of a document: their grammar, the names, and missing numbers."""

import pytest
import shapes
from wording import check_error, check_text

from pcbench import Settings, compare
from pcbench.comparison.rehearsal import rehearse
from pcbench.report import document
from pcbench.report.conditions import Condition, NamedValues, check_names, failures, number_of
from pcbench.report.document import OMITTED_KEYS, candidate_values

VALUES = {
    "points": 7,
    "converged": True,
    "verdict": "none",
    "wave": None,
    "changes": [],
    "parts": [{"name": "a b", "net": [1.5, 1.0, 2.0]}, {"name": "7", "net": [2.5, 2.0, 3.0]}],
    "noise": {"value": 0.02, "low": 0.01, "high": 0.03},
    "matrix": [[1.0, 2.0], [3.0, 4.0]],
    "metrics": {
        "d2_rms": {"candidate_to_reference": 0.31, "reference_to_candidate": None, "floor": {"symmetric_max": 0.1}},
        "fscore": [{"threshold": 0.1, "recall": 0.5}, {"threshold": 1.0, "recall": 0.9}],
        "f1@0.02": 0.25,
        "percentiles": {"p95": 4.0},
    },
}


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("points", 7.0),
        ("converged", 1.0),
        ("metrics.d2_rms.candidate_to_reference", 0.31),
        ("d2_rms.c2r", 0.31),
        ("d2_rms.r2c", None),
        ("d2_rms.floor.max", 0.1),
        ("fscore@0.1.recall", 0.5),
        ("fscore@1.recall", 0.9),
        ("fscore@1e-1.recall", 0.5),
        ("fscore[1].recall", 0.9),
        ("f1@0.02", 0.25),
        ("percentiles.p95", 4.0),
        ("parts[0].net[1]", 1.0),
        ("parts[a b].net[0]", 1.5),
        ("parts[7].net[0]", 2.5),  # a name comes before an index
        ("parts[6].net[0]", None),  # lists differ in length
        ("matrix[1][0]", 3.0),
        ("noise", 0.02),
        ("noise.low", 0.01),
        ("wave.length", None),
        ("changes[0].volume", None),
    ],
)
def test_names_are_keys_of_the_document(name, expected):
    assert number_of(VALUES, name, OMITTED_KEYS) == expected


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("d2_rmse.c2r", "d2_rms.c2r"),  # near names
        ("d2_rms.c2rr", "d2_rms.c2r"),
        ("recall", "fscore@0.1.recall"),  # the last key alone
        ("fscore@0.2.recall", "fscore@0.1.recall"),
        ("d2_rms", "d2_rms.c2r, d2_rms.r2c, d2_rms.floor"),
        ("zzz", "points"),
        ("points.x", "points"),
        ("verdict", "a text"),
        ("matrix", "matrix[0]"),
        ("parts[b].net[0]", "parts[0].net[0]"),
        ("parts@3.net", "parts[0].net[0]"),
        ("__class__", "there is no '__class__'"),
    ],
)
def test_an_unknown_name_is_refused_with_the_near_ones(name, words):
    with check_error() as error:
        number_of(VALUES, name, OMITTED_KEYS)
    assert words in str(error.value)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("points > 6", True),
        ("points >= 7", True),
        ("points < 7", False),
        ("points<=7", True),
        ("points == 7.0", True),
        ("points != +7", False),
        ("  points > -.5e1  ", True),
        ("fscore@0.1.recall < 60%", True),
        ("fscore@0.1.recall == 50 %", True),
        ("points > 9 or points < 3 or points == 7", True),
        ("points > 9 and points < 3 or points == 7", True),  # "and" binds more tightly
        ("points == 7 or points > 9 and points < 3", True),
        ("d2_rms.r2c > 0", None),
        ("d2_rms.r2c > 0 or points == 7", True),
        ("d2_rms.r2c > 0 and points == 8", False),
        ("d2_rms.r2c > 0 and points == 7", None),
    ],
)
def test_a_condition_holds_or_is_unknown(text, expected):
    condition = Condition.parse(text)
    numbers = {name: number_of(VALUES, name, OMITTED_KEYS) for name in condition.names}
    assert condition.holds(numbers) is expected
    assert repr(condition) == repr(text.strip())


@pytest.mark.parametrize(
    "text",
    [
        "",
        " ",
        "d2_rms.c2r",
        "d2_rms.c2r >",
        "> 0.2",
        "points = 7",
        "points => 7",
        "points > 0,2",
        "points > 1e400",
        "points > nan",
        "points > inf",
        "points > 0x10",
        "points > ٣",
        "pöints > 3",
        "points > 3and points < 2",
        "points > 3 and",
        "points > 3 AND points < 2",
        "points > 3 points < 2",
        "(points > 3)",
        "points > (3)",
        "0.1 < points < 0.2",
        "points[0 > 3",
        "a..b > 3",
        "points > 3; import os",
        "__import__('os').system('true') > 3",
        "points > 3\0",
        "x" * 2000 + " > 3",
        "(" * 900,
    ],
)
def test_another_text_is_refused(text):
    with check_error():
        Condition.parse(text)


def test_a_long_condition_is_parsed():
    text = " and ".join(["points > 1"] * 60)
    assert len(Condition.parse(text).alternatives[0]) == 60


def test_failures_name_the_subjects_and_their_numbers():
    subjects = [
        NamedValues("a", VALUES),
        NamedValues("b", {**VALUES, "points": 1}),
        NamedValues("c", {**VALUES, "points": None}),
    ]
    conditions = [Condition.parse(text) for text in ("points > 6.5", "points >= 0 and d2_rms.c2r > 31%", "points > 9")]
    lines = failures(conditions, subjects, OMITTED_KEYS)
    check_text("\n".join(lines), masked=False)
    assert ["a: points = 7" in line for line in lines] == [True, False, False]
    assert failures(conditions[2:], subjects[:2]) == []


def test_digits_do_not_hide_why_a_condition_holds():
    (line,) = failures([Condition.parse("x > 0.2")], [NamedValues("", {"x": 0.2 + 1e-12})])
    assert "0.200000000001" in line


@pytest.fixture(scope="module")
def clouds():
    return shapes.city(400, seed=1)[0], shapes.city(300, noise=0.05, seed=2)[0]


def test_a_rehearsal_has_the_names_of_a_comparison(clouds):
    """All numbers of a real document, and those of settings that add some, are accepted before it is computed."""

    def numbers(node, path=""):
        if isinstance(node, dict):
            for key, value in node.items():
                yield from numbers(value, f"{path}.{key}" if path else key)
        elif isinstance(node, list):
            for k, value in enumerate(node):
                yield from numbers(value, f"{path}[{k}]")
        elif node is None or isinstance(node, int | float):
            yield path

    settings = Settings(presets=("tnt", "open3d"), maps=("m3c2",), thresholds=(0.5,))
    (subject,) = candidate_values(document(compare(*clouds, settings)))
    names = [name for name in numbers(subject.values) if not name.startswith(("steps", "path"))]
    assert len(names) > 200
    example = rehearse(settings)
    check_names([Condition.parse(f"{name} > 0") for name in names], example, OMITTED_KEYS)
    check_names([Condition.parse("fscore@0.5.fscore > 0 and presets.tnt.fscore@0.5.recall > 0")], example, OMITTED_KEYS)


@pytest.mark.parametrize(
    ("settings", "text", "is_known"),
    [
        (Settings(), "fscore@0.3.fscore > 0", True),  # the default thresholds are those of the reference
        (Settings(thresholds=(0.5,)), "fscore@0.3.fscore > 0", False),
        (Settings(), "presets.tnt.fscore[0].recall > 0", False),
        (Settings(maps=("poisson",)), "deviation.maps.poisson_distance.rms > 0", True),
        (Settings(), "deviation.maps.poisson_distance.rms > 0", False),
        (Settings(tolerance=0.01), "d2_mse.sample.c2r.points > 0", True),
        (Settings(), "changes[3].volume > 0", True),
        (Settings(), "check_points.aligned.nva.rmse_v > 0", True),
        (Settings(), "reference.spacing_median > 0", True),
        (Settings(), "registration.overlap < 0.5", True),
        (Settings(), "overlap < 0.5", False),
    ],
)
def test_a_rehearsal_knows_what_settings_add(settings, text, is_known):
    conditions, example = [Condition.parse(text)], rehearse(settings)
    if is_known:
        check_names(conditions, example, OMITTED_KEYS)
    else:
        with check_error():
            check_names(conditions, example, OMITTED_KEYS)

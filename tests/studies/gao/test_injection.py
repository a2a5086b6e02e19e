"""Deformations of known size: they are found and attributed to the deformed cloud, or to none."""

import numpy as np
import pytest
from gao_studies import scene, study

from pcbench import Cloud, write_cloud
from pcbench.report.article import markdown
from pcbench.scenes.synthetic import city
from pcbench.studies.gao.injection import attribute, inject_deformations
from pcbench.studies.gao.page import article
from pcbench.studies.gao.plan import MVS
from pcbench.studies.gao.results import InjectedDeformation


@pytest.mark.parametrize(
    ("sizes", "limits", "expected"),
    [
        ({}, {"a": 0.1, "b": 0.1}, None),
        ({"a": 0.3}, {"a": 0.1, "b": 0.1, "c": 0.1}, "a"),  # the others would show it
        ({"a": 0.3}, {"a": 0.1, "b": 0.5, "c": None}, None),  # no other would show it
        ({"a": 0.3, "b": 0.3}, {"a": 0.1, "b": 0.1, "c": 0.5}, MVS),
        ({"a": 0.3, "b": 0.3}, {"a": 0.1, "b": 0.1, "c": 0.1}, MVS),
        ({"a": 0.3, "b": 0.3}, dict.fromkeys("abcd", 0.1), None),
    ],
)
def test_attribution_compares_clouds_that_would_show_a_deformation(sizes, limits, expected):
    assert attribute(sizes, limits) == expected


@pytest.fixture(scope="module")
def found(tmp_path_factory):
    folder, rng = tmp_path_factory.mktemp("injection"), np.random.default_rng(0)
    for name, count in ((MVS, 30_000), ("sparse", 8_000), ("dense", 15_000)):
        points = city(0).sample(count, rng)[0]
        write_cloud(folder / f"{name}.ply", Cloud(points + rng.normal(0, 0.03, points.shape), unit="m"))
    files = {name: folder / f"{name}.ply" for name in ("sparse", "dense")}
    first = inject_deformations(folder / f"{MVS}.ply", files, "none", folder, 0)
    assert inject_deformations(folder / f"{MVS}.ply", files, "none", folder, 0) == first  # from the saved results
    return first


@pytest.mark.long
def test_a_deformation_is_attributed_to_the_deformed_cloud(found):
    assert {each.cloud for each in found} == {"sparse", "dense", MVS}
    assert len(found) == 9
    assert all(each.attributed == each.cloud for each in found)
    for each in found:  # the displacement is vertical, and partly affine
        assert all(0.1 * each.rms < size < each.rms for size in each.sizes.values())


@pytest.mark.long
def test_the_page_lists_what_is_found_and_attributed(found):
    wrong = InjectedDeformation(MVS, 0.5, {"sparse": "none", "dense": "non-affine"}, {"dense": 0.4}, "dense")
    text, plain = (markdown(article(study(made), None)) for made in (scene(injected=(*found, wrong)), scene()))
    assert text.count("| dense | ") > plain.count("| dense | ")

"""`report.html` without a browser: its points, its words, hostile names, and that it asks for nothing."""

import base64
import json
import re
import zlib
from dataclasses import replace
from html import unescape

import numpy as np
import pytest
import shapes
from camera_rigs import ring
from html_pages import HOSTILE, PROVENANCE, Page

from pcbench import Cloud, Settings, compare, write_cloud
from pcbench.deformation import LocalChanges
from pcbench.measure.deviation import DeviationMap
from pcbench.report import folder as report_folder
from pcbench.report.html import layers as html_layers
from pcbench.report.html import page
from pcbench.report.html.metrics_table import columns_of, main_rows
from pcbench.report.html.packing import UNKNOWN_CODE, CodeGrid, levels, morton_order, scalar_codes
from pcbench.report.html.places import worst_places
from pcbench.report.inputs import InputFile, Inputs
from pcbench.report.viewing import ViewingCameras
from pcbench.report.words import number


@pytest.fixture(scope="module")
def comparison():
    """Compare two noisy clouds far from the origin, one of which is incomplete, with M3C2."""
    points = shapes.terrain(3000, seed=1)[0] + [500_000, 5_000_000, 100]
    rng = np.random.default_rng(2)
    a, b = (points[::k] + rng.normal(0, 0.02, points[::k].shape) for k in (2, 3))
    clouds = {"a": Cloud(a), "b": Cloud(b[b[:, 0] < b[:, 0].mean() + 5])}
    return compare(Cloud(points, unit="m"), clouds, Settings(register="none", maps=("m3c2",)))


def unpack(head, text):
    """Return positions and scalars of a layer, by a decoder that shares no code with the package."""
    data, n = zlib.decompress(base64.b64decode(text)), head["shown"]
    planes = [
        np.frombuffer(data[k * n : (k + 1) * n], np.uint8).astype(np.int64) for k in range(len(data) // max(n, 1))
    ]
    folded = [planes[2 * axis] + 256 * planes[2 * axis + 1] for axis in range(3)]
    codes = np.stack([np.cumsum(np.where(f % 2, -(f + 1) // 2, f // 2)) % 65536 for f in folded], axis=1)
    scalars = [
        np.where(codes == UNKNOWN_CODE, np.nan, np.append(s["levels"], [np.nan] * 256)[codes])
        for s, codes in zip(head["scalars"], planes[6:], strict=True)
    ]
    return np.array(head["low"]) + codes * np.array(head["step"]), scalars


def test_points_and_scalars_are_kept_to_the_quantisation_step(comparison):
    for layer in html_layers.layers(comparison):
        head = layer.head
        if "M3C2" in head["name"]:
            continue
        map_ = comparison[head["name"]].deviation if head["name"] else comparison["a"].completeness
        points, scalars = unpack(head, layer.data)
        assert np.abs(points - map_.points[layer.rows]).max() <= 0.51 * max(head["step"])
        assert max(head["step"]) < 1e-3  # 40 m in 65,536 steps
        for described, found in zip(head["scalars"], scalars, strict=True):
            owner = comparison[described["of"]].completeness if described["of"] else map_
            expected = owner.scalars[described["key"]][layer.rows]
            inside = np.abs(expected) <= described["high"]
            assert np.abs(found - expected)[inside].max() <= described["high"] / 80
            assert (np.abs(found - expected) <= described["high"] / 80 + 0.1 * np.abs(expected)).all()


def test_each_cloud_is_a_layer(comparison):
    heads = [layer.head for layer in html_layers.layers(comparison)]
    assert [head["name"] for head in heads] == ["a", "b", "a, M3C2", "b, M3C2", ""]
    assert [scalar["key"] for scalar in heads[0]["scalars"]] == ["distance", "plane_distance"]
    assert [scalar["of"] for scalar in heads[-1]["scalars"]] == ["a", "b"]
    assert [head["total"] for head in heads[:2]] == [len(c.deviation.points) for c in comparison]
    assert all(head["shown"] == head["total"] and head["outside"] == 0 for head in heads)


def test_unknown_scalars_have_their_own_code():
    table = levels(np.array([0.5, 7.0]), 1.0, signed=False)
    assert len(table) == 255 and table[0] == 0 and table[-1] == 7 and (np.diff(table) > 0).all()
    signed = levels(np.array([-3.0, 2.0]), 1.0, signed=True)
    assert len(signed) == 255 and (signed == -signed[::-1]).all()
    assert scalar_codes(np.array([np.nan, 0.0, 7.0]), table).tolist() == [UNKNOWN_CODE, 0, 254]


def test_morton_order_follows_the_interleaved_bits():
    codes = np.random.default_rng(0).integers(0, 65536, (200, 3)).astype(np.uint16)
    keys = [
        int("".join(f"{z >> k & 1}{y >> k & 1}{x >> k & 1}" for k in range(15, -1, -1)), 2)
        for x, y, z in codes.tolist()
    ]
    assert morton_order(codes).tolist() == sorted(range(200), key=lambda row: keys[row])


def test_large_clouds_keep_all_points_beyond_the_limit(comparison, monkeypatch):
    monkeypatch.setattr(html_layers, "MAX_BYTES", 10_000)
    found = html_layers.layers(comparison)
    # Few points are far apart, so that their differences compress less than those of a large cloud.
    assert sum(len(base64.b64decode(layer.data)) for layer in found) < 20_000
    layer = found[0]
    assert 0 < layer.head["shown"] < layer.head["total"]
    assert layer.head["beyond_shown"] == layer.head["beyond"] > 0
    far = np.flatnonzero(comparison["a"].deviation.scalars["distance"] > layer.head["scalars"][0]["high"])
    assert np.isin(far, layer.rows).all()
    text = page(comparison, PROVENANCE)
    assert (
        f"a: {layer.head['shown']:,} of {layer.head['total']:,} points, with all {layer.head['beyond']} beyond" in text
    )


def test_a_distant_outlier_does_not_make_the_grid_coarse(comparison):
    map_ = comparison["a"].deviation
    points = map_.points.copy()
    points[7] += 1e6
    found = html_layers.layers(with_deviation(comparison, DeviationMap(points, map_.rows, map_.scalars)))
    assert found[0].head["outside"] == 1
    assert max(found[0].head["step"]) < 1e-2
    assert 7 not in found[0].rows


def with_deviation(comparison, map_):
    first, *others = comparison.candidates
    return replace(comparison, candidates=(replace(first, deviation=map_), *others))


def test_the_page_says_what_the_other_outputs_say(comparison):
    text = page(comparison, PROVENANCE)
    words = " ".join("".join(Page(text).words).split())
    for sentence in ("b is", "candidate to reference, accuracy", "Worst places", PROVENANCE["command"], "a machine"):
        assert sentence in words
    mean = comparison["b"].metrics.mean_distance.completeness.value
    assert f"{mean:.4g}" in words
    assert '<td class="best">' in text  # the complete cloud is the better one
    assert all(f'id="{name}"' in text for name in ("canvas", "scalar", "legend-low", "clip-high-2", "place-0"))


def test_only_significant_differences_mark_a_best_value(comparison):
    """The incomplete cloud is as accurate as the other one, and farther from the reference's points."""
    rows = {row.label: row for row in main_rows(comparison) if not row.level}
    marks = [[cell.is_best for cell in pair] for pair in rows["mean distance"].cells]
    low, high = next(d.interval for d in comparison.differences if d.metric == "mean_distance/candidate_to_reference")
    assert low < 0 < high
    assert marks == [[False, True], [False, False]]
    low, high = comparison["a"].metrics.mean_distance.completeness.interval
    assert rows["mean distance"].cells[0][1].interval == (f"{low:.3g}", f"{high:.3g}")
    low, high = comparison["a"].metrics.d2_mse.accuracy.interval
    assert rows["RMS off the surface (D2)"].cells[0][0].interval == (f"{low**0.5:.3g}", f"{high**0.5:.3g}")


def test_worst_places_are_apart_and_sorted(comparison):
    places = [place for place in worst_places(comparison) if place.candidate == "b" and place.of == "b"]
    sizes = [float(place.size.split()[0]) for place in places]
    assert len(places) == 3 and sizes == sorted(sizes, reverse=True)
    assert sizes[0] == pytest.approx(comparison["b"].metrics.hausdorff.completeness.largest, rel=5e-3)
    assert np.allclose(places[0].at, comparison["b"].metrics.hausdorff.completeness.worst_point)
    apart = [np.linalg.norm(np.subtract(p.at, q.at)) for k, p in enumerate(places) for q in places[:k]]
    assert min(apart) > places[0].radius


def test_hostile_names_stay_text(comparison):
    first, second = comparison.candidates
    bad = replace(
        first, name=HOSTILE, deformation=replace(first.deformation, local=LocalChanges(1, 1, 0.05, 1.0, (0, 0, 0)))
    )
    inputs = Inputs(
        InputFile(f"/{HOSTILE}\n.ply", "0" * 64, (HOSTILE,)), {c.name: InputFile(c.name, "1") for c in (bad, second)}
    )
    hostile = replace(comparison, candidates=(bad, second), inputs=inputs)
    parsed = Page(page(hostile, {**PROVENANCE, "command": HOSTILE}))
    plain = Page(page(replace(comparison, inputs=inputs_of(comparison)), PROVENANCE))
    assert "img" not in parsed.tags and set(parsed.tags) == set(plain.tags)
    assert parsed.tags.count("script") == plain.tags.count("script")
    assert not any(name.startswith("on") for name, _ in parsed.attributes)
    assert parsed.view["layers"][0]["name"] == HOSTILE
    raw = page(hostile, PROVENANCE)
    assert "49" not in re.findall(r"\{\{.*?\}\}|49\]\]", raw) and "\u2028" not in raw.split("<script")[1]


def inputs_of(comparison):
    return Inputs(
        InputFile("ref.ply", "0", ("a warning",)), {c.name: InputFile(f"{c.name}.ply", "1") for c in comparison}
    )


def test_it_asks_for_nothing(comparison):
    text = page(comparison, PROVENANCE)
    parsed = Page(text)
    assert not {name for name, _ in parsed.attributes} & {"src", "href", "srcset", "action", "data"}
    assert not {"link", "img", "iframe", "object", "base"} & set(parsed.tags)
    assert re.findall(r"https?:|url\(|@import|import\(|fetch\(|XMLHttpRequest", text) == []
    assert parsed.unbalanced == []
    policy = next(value for name, value in parsed.attributes if value and "default-src" in value)
    assert policy.startswith("default-src 'none'; script-src 'sha256-") and "unsafe-eval" not in policy


def test_the_same_comparison_gives_the_same_bytes(comparison):
    assert page(comparison, PROVENANCE) == page(comparison, PROVENANCE)


def test_unknown_values_single_points_and_empty_maps(comparison):
    map_ = comparison["a"].deviation
    unknown = DeviationMap(
        map_.points, map_.rows, {**map_.scalars, "plane_distance": np.full(len(map_.points), np.nan)}
    )
    layer = html_layers.layers(with_deviation(comparison, unknown))[0]
    assert np.isnan(unpack(layer.head, layer.data)[1][1]).all()
    one = DeviationMap(map_.points[:1], map_.rows[:1], {name: values[:1] for name, values in map_.scalars.items()})
    none = DeviationMap(map_.points[:0], map_.rows[:0], {name: values[:0] for name, values in map_.scalars.items()})
    for changed, count in ((one, 1), (none, 0)):
        heads = Page(page(with_deviation(comparison, changed), PROVENANCE)).view["layers"]
        assert sum(head["shown"] for head in heads if head["name"] == "a") == count
    points = compare(np.zeros((1, 3)), np.ones((1, 3)), Settings(register="none"))
    assert [head["shown"] for head in Page(page(points, PROVENANCE)).view["layers"]] == [1, 1]
    same = compare(np.zeros((1, 3)), np.zeros((1, 3)), Settings(register="none"))
    assert "<svg" not in page(same, PROVENANCE)


def test_sixty_candidates_have_a_row_each_and_fit_the_budget(comparison):
    many = [replace(comparison.candidates[k % 2], name=f"candidate {k}") for k in range(60)]
    text = page(replace(comparison, candidates=tuple(many), differences=()), PROVENANCE)
    assert len(text) < 6e6
    assert unescape(text).count('<th scope="row">candidate 59</th>') >= 1
    assert "and 53 more" in text


def test_five_candidates_keep_their_floors_and_the_main_columns_come_first(comparison):
    many = tuple(replace(comparison.candidates[k % 2], name=f"candidate {k}") for k in range(5))
    changed = replace(comparison, candidates=many, differences=())
    columns = columns_of(main_rows(changed))
    labels = [column.line.label.split(" at ")[0] for column in columns]
    assert labels[:4] == ["RMS off the surface (D2)", "mean distance", "F-score", "deformation"]
    assert labels[-3:] == ["points measured", "registration RMSE", "overlap"]
    assert [column.has_directions for column in columns[:4]] == [True, True, False, False]
    floor = changed["candidate 1"].metrics.mean_distance.accuracy.floor
    assert columns[1].floors[1][0] == number(floor)
    text = page(changed, PROVENANCE)
    assert f"floor {number(floor)}" in text and "Floor: the sampling floor" in " ".join(Page(text).words)
    assert Page(text).unbalanced == Page(page(comparison, PROVENANCE)).unbalanced


def test_small_shares_are_not_rounded_to_three_decimals(comparison):
    points = comparison["a"].completeness.points
    few = compare(points, {"few": points[:2]}, Settings(register="none"))
    recalls = [score.recall.value for score in few["few"].metrics.fscores]
    assert 0 < recalls[0] < 0.001
    assert number(recalls[0]) in Page(page(few, PROVENANCE)).words


def test_a_page_that_fails_does_not_cost_the_report(comparison, monkeypatch, tmp_path):
    def fail(*_):
        raise ValueError("no page")

    monkeypatch.setattr(report_folder, "page", fail)
    with pytest.warns(UserWarning, match=r"report\.html was not written: ValueError: no page"):
        comparison.save(tmp_path / "report", figures=False)
    assert (tmp_path / "report" / "comparison.json").is_file()
    assert not (tmp_path / "report" / "report.html").exists()


def test_compare_writes_it_and_replaces_it(run, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    points = shapes.terrain(500, seed=1)[0]
    write_cloud("ref.ply", Cloud(points))
    write_cloud("a.ply", Cloud(points + 0.01))
    for _ in range(2):
        code, out, _ = run("compare", "ref.ply", "a.ply", "--register", "none", "--out", "report", "--no-figures")
        assert code == 0 and "report.html (a page to read or mail)" in " ".join(out.split())
    assert "report.html" in json.loads((tmp_path / "report/manifest.json").read_text())["files"]
    text = (tmp_path / "report/report.html").read_text(encoding="utf-8")
    assert "pcbench compare --settings settings.json" in text and re.search(r"<code>[0-9a-f]{64}</code>", text)


def test_grids_cover_flat_clouds():
    points = np.array([[1.0, 5, 0], [2.0, 5, 0]])
    grid = CodeGrid.of(points)
    assert np.allclose(grid.low + grid.codes(points) * grid.step, points)


def test_the_view_has_up_and_some_cameras(comparison):
    plain = Page(page(comparison, PROVENANCE)).view
    assert plain["up"] is None
    assert plain["cameras"] is None
    cameras = ViewingCameras.of(ring(1200))
    view = Page(page(replace(comparison, cameras=cameras), PROVENANCE)).view
    assert view["up"] == [0, 0, 1]
    centers, directions = (np.reshape(view["cameras"][name], (-1, 3)) for name in ("centers", "directions"))
    assert len(centers) == len(directions) == 500
    np.testing.assert_allclose(centers[[0, -1]], cameras.centers[[0, -1]], rtol=1e-8)
    np.testing.assert_allclose(directions[[0, -1]], cameras.directions[[0, -1]], rtol=1e-8, atol=1e-12)
    unknown = ViewingCameras(cameras.centers[:2], cameras.directions[:2], None)
    view = Page(page(replace(comparison, cameras=unknown), PROVENANCE)).view
    assert view["up"] is None
    assert len(view["cameras"]["centers"]) == 6

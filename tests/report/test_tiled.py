"""A comparison in tiles in all outputs: how it was computed, what is missing, and maps that are samples."""

import json
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import shapes
import tiled_fake
from wording import check_error, check_text

import pcbench
from pcbench import Cloud, Settings, write_cloud
from pcbench.comparison.plan import CloudsOnDisk
from pcbench.comparison.request import Request
from pcbench.errors import InputError
from pcbench.io.pieces import CloudFile, CloudOnDisk
from pcbench.measure.tiled.settings import TilingSettings
from pcbench.report import document, markdown, to_json
from pcbench.report.folder import report_folder, write_report
from pcbench.report.html import page
from pcbench.report.html.charts import charts
from pcbench.report.html.layers import layers
from pcbench.report.html.places import worst_places
from pcbench.report.html.tiles import tile_maps
from pcbench.report.notes import remarks, warnings
from pcbench.report.plotters.candidates import CandidateMaps
from pcbench.report.read import read_report
from pcbench.report.words import memory_text

LEFT_OUT = [("tiles/a.laz", 1_234_567, "truncated: got 10 of\n20 points"), ("tiles/b.laz", None, "no LAS file")]
CENSORED = {"candidate_to_reference": 0.1234, "reference_to_candidate": 0.004}


@pytest.fixture(scope="module")
def full():
    rng = np.random.default_rng(0)
    reference = Cloud(shapes.city(9000, noise=0.01, seed=1)[0], unit="m")
    points = shapes.city(6000, seed=2)[0]
    points = np.concatenate([points + rng.normal(0, 0.02, points.shape), [[25.0, 25.0, 30.0]]])  # one outlier above
    return pcbench.compare(reference, {"a": Cloud(points)}, Settings(register="none"))


@pytest.fixture(scope="module")
def tiled(full):
    return tiled_fake.as_tiled(full, TilingSettings(2000, max_distance=5.0), 2, LEFT_OUT, CENSORED)


def test_warnings_name_files_left_out_and_capped_distances(tiled):
    check_text("\n".join(warnings(tiled)), masked=False)
    one = replace(tiled.tiling, left_out=tiled.tiling.left_out[:1])
    check_text("\n".join(warnings(replace(tiled, tiling=one))), masked=False)
    many = replace(tiled.tiling, left_out=tiled.tiling.left_out * 4)
    check_text(warnings(replace(tiled, tiling=many))[0], masked=False)


def test_distances_that_reach_no_limit_give_no_warning(tiled):
    (candidate,) = tiled.candidates
    exact = replace(candidate, censored=dict.fromkeys(CENSORED, 0.0))
    assert not any("--max-distance" in text for text in warnings(replace(tiled, candidates=(exact,))))


def test_remarks_say_how_it_was_computed(tiled, full):
    check_text("\n".join(remarks(tiled)), masked=False)
    check_text("\n".join(remarks(replace(tiled, has_map_files=True))), masked=False)
    tiling = replace(tiled.tiling, sampled_points=None, max_distance=None, tiles=1, tile_points=1)
    check_text("\n".join(remarks(replace(tiled, tiling=tiling))), masked=False)
    assert list(remarks(full)) == []


def test_table_and_page_have_the_same_notes(tiled):
    table, html = markdown(tiled), page(tiled, document(tiled)["provenance"])
    for text in (*warnings(tiled), *remarks(tiled)):
        line = " ".join(text.split())
        assert line in " ".join(table.split())
        assert line.replace("'", "&#39;").replace(">", "&gt;") in " ".join(html.split())


def test_the_json_has_all_files_and_shares(tiled):
    values = json.loads(to_json(document(tiled)))
    assert values["tiling"]["left_out"] == [
        {"path": path, "points": points, "reason": reason} for path, points, reason in LEFT_OUT
    ]
    assert values["tiling"]["max_distance"] == 5
    assert values["tiling"]["map_files"] is False
    (candidate,) = values["candidates"]
    assert candidate["censored"] == CENSORED
    assert candidate["map_samples"]["candidate_to_reference"] == {"points": 3138, "even": 3001, "sampled_from": 6001}


def test_statistics_are_those_of_all_points(tiled, full):
    sampled, exact = (json.loads(to_json(document(found)))["candidates"][0] for found in (tiled, full))
    del exact["metrics"]["presets"]["mpeg"]
    assert sampled["metrics"] == exact["metrics"]
    assert sampled["deviation"] == exact["deviation"]
    assert sampled["points_in_region"] == 6001


def test_the_worst_place_is_found_although_the_sample_lacks_it(tiled, full):
    (candidate,) = tiled.candidates
    map_ = candidate.deviation
    lacking = map_.rows != 6000
    scalars = {name: values[lacking] for name, values in map_.scalars.items()}
    deviation = replace(map_, points=map_.points[lacking], rows=map_.rows[lacking], scalars=scalars)
    worst = worst_places(replace(tiled, candidates=(replace(candidate, deviation=deviation),)))[0]
    assert replace(worst, size="") == replace(worst_places(full)[0], size="")
    assert worst.at == (25.0, 25.0, 30.0)


def test_distances_at_the_limit_are_called_lower_bounds(full):
    limited = tiled_fake.as_tiled(full, TilingSettings(max_distance=0.5), 2, censored=CENSORED)
    places = worst_places(limited)
    assert places[0].size.startswith("≥ ")
    assert not any("≥" in place.size for place in places[1:3])
    assert not any("≥" in place.size for place in worst_places(full))


def test_the_page_counts_all_points_and_says_that_it_shows_a_sample(tiled):
    heads = [layer.head for layer in layers(tiled)]
    assert [(head["total"], head["shown"], head["is_sample"]) for head in heads] == [
        (6001, 3138, True),
        (9000, 4710, True),
    ]
    assert tile_maps(tiled).is_sample
    html = page(tiled, document(tiled)["provenance"])
    assert "a: 3,138 of 6,001 points, a sample with the largest deviations; reference: 4,710 of 9,000" in html
    assert "of an even sample of the points of a candidate" in html
    assert "sampled points</th>" in html


def test_added_large_deviations_do_not_change_statistics_of_the_page(tiled):
    (candidate,) = tiled.candidates

    def even(map_):
        scalars = {name: map_.even_values(name) for name in map_.scalars}
        return replace(map_, points=map_.points[map_.is_even], rows=map_.rows[map_.is_even], scalars=scalars)

    maps = {"deviation": even(candidate.deviation), "completeness": even(candidate.completeness)}
    without = replace(tiled, candidates=(replace(candidate, **maps),))
    assert len(maps["deviation"].points) < len(candidate.deviation.points)
    ours, theirs = tile_maps(tiled), tile_maps(without)
    assert (ours.tiles, ours.scale, ours.sparse) == (theirs.tiles, theirs.scale, theirs.sparse)
    assert [chart.series for chart in charts(tiled)] == [chart.series for chart in charts(without)]
    for ours, theirs in zip(layers(tiled), layers(without), strict=True):
        assert [scalar["high"] for scalar in ours.head["scalars"]] == [
            scalar["high"] for scalar in theirs.head["scalars"]
        ]


def test_the_reference_is_shown_by_points_that_all_candidates_share():
    points = shapes.city(3000, seed=1)[0]
    rng = np.random.default_rng(0)
    clouds = {
        name: Cloud(points[:count] + rng.normal(0, noise, (count, 3)))
        for name, count, noise in (("a", 2000, 0.02), ("b", 1500, 0.1))
    }
    full = pcbench.compare(Cloud(points), clouds, Settings(register="none"))
    found = tiled_fake.as_tiled(full, TilingSettings(), 3)
    a, b = (candidate.completeness for candidate in found)
    assert not np.array_equal(a.rows, b.rows)
    layer = layers(found)[-1]
    assert (layer.head["shown"], layer.head["total"]) == (1000, 3000)
    assert [scalar["of"] for scalar in layer.head["scalars"]] == ["a", "b"]
    check_text(list(remarks(found))[1], masked=False)


def test_the_page_of_a_comparison_in_memory_has_no_sample(full):
    html = page(full, document(full)["provenance"])
    assert "of all points of a candidate" in html
    assert "sampled" not in html.partition("<script")[0]


def test_saved_samples_are_read_back_with_their_totals(tiled, tmp_path):
    with report_folder(tmp_path / "report") as folder:
        write_report(folder, tiled)
    report = read_report(tmp_path / "report")
    distances = tiled["a"].deviation.even_values("distance")
    even, even_back = (
        np.percentile(map_.even_values("distance"), 95) for map_ in (tiled["a"].deviation, tiled["a"].completeness)
    )
    assert report.reference_path is None
    assert report.candidates[0].path is None
    assert report.candidates[0].samples == {
        "candidate_to_reference": (3001, 6001),
        "reference_to_candidate": (4500, 9000),
    }
    for maps in (CandidateMaps.of_report(report, None), CandidateMaps.of_comparison(tiled, None)):
        assert maps.of("a", "distance").sampled_from == 6001
        assert maps.of("a", "completeness").sampled_from == 9000
        assert len(maps.of("a", "distance").points) == 3138
        assert maps.ranges("distance")["a"].high == pytest.approx(even, rel=1e-6)  # 32 bits
        assert maps.ranges("completeness")["a"].high < 1.05 * even_back
    assert np.sort(report.candidates[0].even_values("distance")) == pytest.approx(np.sort(distances), rel=1e-6)


def test_reports_of_earlier_versions_have_no_samples(full, tmp_path):
    with report_folder(tmp_path / "report") as folder:
        write_report(folder, full)
        values = json.loads((folder / "comparison.json").read_text())
        del values["tiling"], values["candidates"][0]["map_samples"]
        (folder / "comparison.json").write_text(json.dumps(values))
    assert read_report(tmp_path / "report").candidates[0].samples == {}


def test_python_compares_paths_in_tiles(tmp_path, monkeypatch):
    tiled_fake.install(monkeypatch)
    points = shapes.city(1000, seed=1)[0]
    for name in ("ref", "a"):
        write_cloud(tmp_path / f"{name}.ply", Cloud(points))
    steps = []
    found = pcbench.compare(
        tmp_path / "ref.ply",
        tmp_path / "a.ply",
        tiling=pcbench.TilingSettings(500, workers=2),
        workspace=tmp_path / "work",
        on_step=steps.append,
    )
    assert found.tiling.tile_points == 500
    assert found.inputs.tiling == TilingSettings(500, workers=2)
    assert "sorting the reference" in steps
    assert not (tmp_path / "work").exists()
    with check_error(InputError):
        pcbench.compare(points, points, tiling=pcbench.TilingSettings())


@pytest.mark.parametrize(
    ("counts", "peak_mb"),
    [
        ((10_000, 10_000), 127),
        ((30_000, 30_000), 181),
        ((100_000, 100_000), 191),
        ((300_000, 300_000), 252),
        ((1_000_000, 1_000_000), 473),
        ((190_000, 1_000_000), 345),
        ((1_000_000, 1_000_000, 1_000_000, 1_000_000), 658),
    ],
)
def test_the_estimate_of_memory_is_near_measured_peaks(counts, peak_mb):
    # Peaks by `benchmarks/memory.py`.
    reference, *candidates = (
        CloudOnDisk(Path("a.npy"), (CloudFile(Path("a.npy"), count, nbytes_in_memory=24 * count),), ())
        for count in counts
    )
    clouds = CloudsOnDisk(reference, dict(enumerate(candidates)))
    assert clouds.memory == pytest.approx(1e6 * peak_mb, rel=0.1)


def test_the_key_of_a_workspace_follows_files_settings_and_tiles(tmp_path):
    write_cloud(tmp_path / "a.ply", Cloud(shapes.city(100, seed=1)[0]))
    (tmp_path / "matrix.txt").write_text("1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n")
    settings, tiling = Settings(register=f"matrix:{tmp_path / 'matrix.txt'}"), TilingSettings(workers=1)

    def key(settings=settings, tiling=tiling):
        path = tmp_path / "a.ply"
        request = Request.of(path, path, settings)
        return CloudsOnDisk.open(request, tiling).key(request.settings, tiling)

    keys = [
        key(),
        key(settings=Settings()),
        key(tiling=TilingSettings(workers=1, tile_points=500)),
        key(tiling=TilingSettings(workers=1, memory=200_000_000)),
    ]
    for name, change in (("matrix.txt", (b"1 0 0 0", b"1 0 0 5")), ("a.ply", None)):  # with the same size and time
        before = (tmp_path / name).stat()
        data = bytearray((tmp_path / name).read_bytes())
        if change is None:
            data[-1] ^= 1
        else:
            data = data.replace(*change)
        (tmp_path / name).write_bytes(data)
        os.utime(tmp_path / name, ns=(before.st_atime_ns, before.st_mtime_ns))
        keys.append(key())
    assert len(set(keys)) == len(keys)
    os.utime(tmp_path / "a.ply", ns=(1, 1))  # another time, with the same content
    for same in (TilingSettings(workers=2), TilingSettings(workers=1, cluster="tcp://host:8786")):  # the same tiles
        assert key(tiling=same) == keys[-1]


def test_attributes_need_memory_too():
    def cloud(nbytes):
        return CloudOnDisk(Path("a.laz"), (CloudFile(Path("a.laz"), 1000, nbytes_in_memory=nbytes),), ())

    bare, rich = (CloudsOnDisk(cloud(nbytes), {"a": cloud(nbytes)}) for nbytes in (24_000, 60_000))
    assert rich.memory - bare.memory == 72_000


@pytest.mark.parametrize(("size", "text"), [(4 << 30, "4 GiB"), (50_000_000, "47.7 MiB"), (1 << 50, "1,048,576 GiB")])
def test_amounts_of_memory(size, text):
    assert memory_text(size) == text

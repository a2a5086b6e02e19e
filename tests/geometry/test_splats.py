"""Splat models: attributes, filters by opacity and size, and refusals."""

import numpy as np
import pytest
import splat_models
from wording import check_error

import pcbench
from pcbench import Cloud, read_cloud, write_cloud
from pcbench.geometry.splats import splat_model


@pytest.mark.parametrize(("dimensions", "degree"), [(3, 3), (3, 0), (2, 3), (3, 1)])
def test_models_are_recognised_by_their_attributes(tmp_path, dimensions, degree):
    write_cloud(tmp_path / "a.ply", splat_models.make_gaussians(5, dimensions, degree))
    model = splat_model(read_cloud(tmp_path / "a.ply"))
    assert (model.dimensions, model.sh_degree) == (dimensions, degree)
    np.testing.assert_allclose(model.opacities, [0.1, 0.3, 0.5, 0.7, 0.9], rtol=1e-6)
    np.testing.assert_allclose(model.largest_axes, 0.01 * dimensions * np.arange(1, 6), rtol=1e-6)


def test_opacities_from_0_to_1_are_not_logits():
    cloud = splat_models.make_gaussians()
    with_opacities = Cloud(cloud.points, attributes={**cloud.attributes, "opacity": np.linspace(0, 1, 5)})
    np.testing.assert_array_equal(splat_model(with_opacities).opacities, np.linspace(0, 1, 5))


def test_clouds_without_splat_attributes_are_not_models(tmp_path):
    assert splat_model(Cloud(np.zeros((2, 3)), attributes={"opacity": np.zeros(2)})) is None


def test_reading_filters_by_opacity_and_axis(tmp_path):
    file = tmp_path / "a.ply"
    cloud = splat_models.make_gaussians()
    write_cloud(file, cloud)
    np.testing.assert_array_equal(read_cloud(file, min_opacity=0.49).points, cloud.points[2:])
    np.testing.assert_array_equal(read_cloud(file, max_axis=0.061).points, cloud.points[:2])
    np.testing.assert_array_equal(read_cloud(file, min_opacity=0.2, max_axis=0.1).points, cloud.points[1:3])
    assert read_cloud(file, min_opacity=0.2, max_axis=0.1).attributes.keys() == cloud.attributes.keys()
    assert len(read_cloud(file, min_opacity=0)) == 5


def test_invalid_limits_are_refused(tmp_path):
    splats, cloud = tmp_path / "a.ply", tmp_path / "b.ply"
    write_cloud(splats, splat_models.make_gaussians())
    write_cloud(cloud, np.zeros((4, 3)))
    for path, options in (
        (splats, {"min_opacity": 1.5}),
        (splats, {"max_axis": 0}),
        (
            splats,
            {"max_axis": 0.001},
        ),
        (cloud, {"min_opacity": 0.5}),
    ):
        with check_error():
            read_cloud(path, **options)


def test_a_comparison_filters_low_opacity_and_large_splats(tmp_path):
    rng = np.random.default_rng(0)
    plane = np.column_stack([rng.uniform(-1, 1, (900, 2)), np.zeros(900)])
    floaters = rng.uniform(-1, 1, (300, 3))
    opacities, axes = np.full(1200, 0.9), np.full((1200, 3), 0.01)
    opacities[900:1050], axes[1050:] = 0.05, 2.0
    splats = splat_models.model(np.concatenate([plane, floaters]), opacities, axes)
    write_cloud(tmp_path / "splats.ply", splats)
    limits = {"register": "none", "min_opacity": 0.5, "max_axis": 0.1}
    for candidate in (tmp_path / "splats.ply", splats):
        comparison = pcbench.compare(plane, candidate, **limits)
        assert next(iter(comparison)).points == 900
        assert next(iter(comparison)).metrics.hausdorff.symmetric_max == 0
    comparison = pcbench.compare(plane, {"the reference": splats}, **limits)
    assert [(c.name, c.points) for c in comparison] == [("the reference", 900)]
    assert comparison.reference.points == 900
    with check_error():
        pcbench.compare(plane, plane, **limits)
    with check_error():
        pcbench.compare(plane, splats, register="none", min_opacity=1.0)

"""Models as PLY files: the layout byte by byte, and round trips."""

import struct
from dataclasses import fields

import numpy as np
import pytest
import splat_models
from optional import import_or_skip
from wording import check_error, check_text

from pcbench import Cloud
from pcbench.io import read_cloud, write_cloud

torch = import_or_skip("torch")

from reconstructors.splat.model import Gaussians, LocalFrame  # noqa: E402
from reconstructors.splat.ply import read_model, write_model  # noqa: E402


def random_gaussians(rng, count=7, degree=3):
    shapes = [(count, 3), (count, 4), (count, 3), (count,), (count, (degree + 1) ** 2, 3)]
    return Gaussians(*(torch.from_numpy(rng.normal(size=shape).astype(np.float32)) for shape in shapes))


def parts(model):
    return {f.name: getattr(model, f.name).numpy() for f in fields(model)}


def test_the_layout_is_that_of_kerbl_et_al(tmp_path):
    """Written by hand: 62 floats per Gaussian, harmonics channel after channel."""
    sh = torch.arange(48.0).reshape(1, 16, 3)  # of coefficient k and channel c: 3 k + c
    model = Gaussians(
        torch.tensor([[1.0, 2.0, 3.0]]),
        torch.tensor([[0.5, 0.1, 0.2, 0.3]]),
        torch.tensor([[-1.0, -2.0, -3.0]]),
        torch.tensor([0.25]),
        sh,
    )
    write_model(tmp_path / "model.ply", model, LocalFrame(np.array([10.0, 20.0, 30.0]), 2.0))
    header, body = (tmp_path / "model.ply").read_bytes().split(b"end_header\n")
    names = ["x", "y", "z", "nx", "ny", "nz", *(f"f_dc_{k}" for k in range(3)), *(f"f_rest_{k}" for k in range(45))]
    names += ["opacity", *(f"scale_{k}" for k in range(3)), *(f"rot_{k}" for k in range(4))]
    lines = [
        "ply",
        "format binary_little_endian 1.0",
        "element vertex 1",
        *(f"property float {name}" for name in names),
    ]
    assert header.decode().splitlines() == lines
    rest = [3 * k + c for c in range(3) for k in range(1, 16)]
    log_scales = [np.log(2.0) + log for log in (-1, -2, -3)]
    expected = [12, 24, 36, 0, 0, 0, 0, 1, 2, *rest, 0.25, *log_scales, 0.5, 0.1, 0.2, 0.3]
    assert body == struct.pack("<62f", *expected)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_round_trip(tmp_path, degree):
    model, frame = (
        random_gaussians(np.random.default_rng(3), degree=degree),
        LocalFrame(np.array([3.0, -2.0, 1.0]), 4.0),
    )
    write_model(tmp_path / "model.ply", model, frame)
    loaded_model, loaded_frame = read_model(tmp_path / "model.ply")
    assert loaded_frame.unit == 1 and not loaded_frame.origin.any()
    expected = parts(model)
    expected["means"] = frame.to_world(expected["means"]).astype(np.float32)
    expected["log_scales"] = (expected["log_scales"].astype(np.float64) + np.log(4.0)).astype(np.float32)
    for name, values in parts(loaded_model).items():
        assert np.array_equal(values, expected[name]), name
    write_model(tmp_path / "again.ply", loaded_model, loaded_frame)
    assert (tmp_path / "again.ply").read_bytes() == (tmp_path / "model.ply").read_bytes()


def test_projected_coordinates_keep_their_precision(tmp_path):
    """The spacing of float32 numbers at UTM coordinates is half a metre."""
    model, frame = (
        random_gaussians(np.random.default_rng(4), 200),
        LocalFrame(np.array([448_262.5, 5_411_932.25, 117.0]), 80.0),
    )
    write_model(tmp_path / "model.ply", model, frame)
    header = (tmp_path / "model.ply").read_bytes().split(b"end_header")[0].decode()
    assert "coordinates about 4482" in header and "double" not in header
    world_means = frame.to_world(model.means.numpy())
    assert np.abs(read_cloud(tmp_path / "model.ply").points - world_means).max() < 1e-4
    loaded_model, loaded_frame = read_model(tmp_path / "model.ply")
    assert np.abs(loaded_frame.to_world(loaded_model.means.numpy()) - world_means).max() < 1e-4


def test_discs_become_flat_gaussians(tmp_path):
    write_cloud(tmp_path / "discs.ply", splat_models.make_gaussians(5, dimensions=2))
    model, _ = read_model(tmp_path / "discs.ply")
    assert model.scales.shape == (5, 3)
    assert torch.equal(model.scales.argmin(dim=1), torch.full((5,), 2))
    assert (model.scales[:, 2] < 1e-3 * model.scales[:, :2].amin(dim=1)).all()


def test_models_of_other_programs_are_read(tmp_path):
    cloud = splat_models.make_gaussians(6)
    write_cloud(tmp_path / "model.ply", cloud)
    model, frame = read_model(tmp_path / "model.ply")
    assert np.allclose(frame.to_world(model.means.numpy()), cloud.points)
    assert np.allclose(model.opacities.numpy(), np.linspace(0.1, 0.9, 6), atol=1e-6)
    assert np.allclose(model.scales.numpy(), 0.01 * np.outer(np.arange(1, 7), [1, 2, 3]), rtol=1e-5)
    assert model.degree == 3 and np.allclose(model.sh[:, 0].numpy(), 0.5)


def test_splats_with_nan_are_dropped(tmp_path):
    cloud = splat_models.make_gaussians(4)
    scales = cloud.attributes["scale_1"].copy()
    scales[2] = np.nan
    write_cloud(tmp_path / "model.ply", Cloud(cloud.points, attributes=cloud.attributes | {"scale_1": scales}))
    notes = []
    model, _ = read_model(tmp_path / "model.ply", notes.append)
    assert len(model) == 3 and len(notes) == 1 and "1 of 4 splats" in check_text(notes[0])


@pytest.mark.parametrize("missing", ["opacity", "rot_3", "f_dc_1", "scale_1"])
def test_files_without_a_model_are_refused(tmp_path, missing):
    cloud = splat_models.make_gaussians(4)
    attributes = {name: values for name, values in cloud.attributes.items() if name != missing}
    write_cloud(tmp_path / "model.ply", Cloud(cloud.points, attributes=attributes))
    with check_error():
        read_model(tmp_path / "model.ply")


@pytest.mark.parametrize("degree", [0.5, 4])
def test_harmonics_of_an_unknown_degree_are_refused(tmp_path, degree):
    cloud = splat_models.make_gaussians(4, degree=3)
    attributes = {name: values for name, values in cloud.attributes.items() if not name.startswith("f_rest_")}
    count = {0.5: 5, 4: 72}[degree]
    attributes |= {f"f_rest_{k}": np.zeros(4, np.float32) for k in range(count)}
    write_cloud(tmp_path / "model.ply", Cloud(cloud.points, attributes=attributes))
    with check_error():
        read_model(tmp_path / "model.ply")

"""Evaluation against a reference: failures of a cloud are saved for later runs, temporary failures are not."""

import errno

import numpy as np
import pytest

from pcbench import Cloud, write_cloud
from pcbench.errors import InputError, MissingExtra, RegistrationError
from pcbench.scenes.synthetic import city
from pcbench.studies.gao import evaluation
from pcbench.studies.gao.results import TRUTH


@pytest.fixture
def clouds(tmp_path):
    rng = np.random.default_rng(0)
    for name, count in (("reference", 6000), ("candidate", 3000)):
        points, _ = city(0).sample(count, rng)
        write_cloud(tmp_path / f"{name}.ply", Cloud(points, unit="m"))
    return tmp_path


def evaluate(folder):
    clouds = {"candidate": folder / "candidate.ply"}
    return evaluation.evaluate_against(folder / "reference.ply", TRUTH, clouds, "none", folder, 0)


def fail_once(monkeypatch, error):
    """Make `run` fail once."""
    compute, errors = evaluation.run, [error]

    def run(*arguments):
        if errors:
            raise errors.pop()
        return compute(*arguments)

    monkeypatch.setattr(evaluation, "run", run)


@pytest.mark.parametrize(
    "error", [MissingExtra("open3d", "open3d"), OSError(errno.ENOSPC, "No space left on device"), MemoryError()]
)
def test_temporary_failure_is_raised_and_retried(clouds, monkeypatch, error):
    fail_once(monkeypatch, error)
    with pytest.raises(type(error)):
        evaluate(clouds)
    result = evaluate(clouds).clouds["candidate"]
    assert (result.failure, result.points) == ("", 3000)
    assert result.measures.d1_back_mse == result.r2c_mse > 0
    assert result.measures.chamfer == pytest.approx(result.measures.d1_mse + result.r2c_mse, rel=1e-12)  # one addition


@pytest.mark.parametrize("error", [InputError("too few points"), RegistrationError("no overlap")])
def test_failure_of_a_cloud_is_saved(clouds, monkeypatch, error):
    calls = []

    def run(*_):
        calls.append(1)
        raise error

    monkeypatch.setattr(evaluation, "run", run)
    first = evaluate(clouds)
    assert first.clouds["candidate"].failure == str(error)
    assert (first.folder, first.counts) == (None, None)
    call_count = len(calls)
    assert evaluate(clouds) == first
    assert len(calls) == call_count

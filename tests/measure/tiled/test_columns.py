"""Columns of points on disk."""

import numpy as np
import pytest

from pcbench.measure.tiled.columns import column_file, load_column, map_column, save_column


@pytest.mark.parametrize(
    "values",
    [np.arange(15.0).reshape(5, 3), np.arange(7, dtype=np.uint8), np.array([1, -1], np.int32), np.zeros((0, 3))],
    ids=["points", "classes", "rows", "empty"],
)
def test_a_mapped_column_is_the_stored_one(tmp_path, values):
    save_column(tmp_path, 0, "values", values)
    mapped = map_column(column_file(tmp_path, 0, "values"))
    for found in (mapped, load_column(tmp_path, 0, "values")):
        assert (found.dtype, found.shape) == (values.dtype, values.shape)
        np.testing.assert_array_equal(found, values)
    assert not mapped.flags.writeable


@pytest.mark.parametrize("length", [0, 5, 60, 130])
def test_a_truncated_column_is_not_mapped(tmp_path, length):
    save_column(tmp_path, 0, "values", np.arange(15.0))
    file = column_file(tmp_path, 0, "values")
    file.write_bytes(file.read_bytes()[:length])
    with pytest.raises(ValueError):
        map_column(file)

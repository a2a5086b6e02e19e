"""Arrays in MATLAB files equal those of scipy; damaged files and other values are refused."""

import struct

import numpy as np
import pytest
from scipy.io import loadmat, savemat
from wording import check_error

from pcbench.errors import InputError
from pcbench.io import matlab
from pcbench.io.matlab import read_matlab_arrays

ARRAYS = {
    "volume": np.random.default_rng(0).random((3, 4, 5)),
    "counts": np.arange(6, dtype=np.int16).reshape(2, 3),
    "scalar": np.array(7.0),
    "mask_with_a_long_name": np.ones((1, 9), bool),
    "empty": np.zeros((0, 3)),
    "wide": np.array([[2**40, -1]]),
}
OTHERS = {"text": "words", "cells": np.array([1, "a"], object), "structure": {"x": 1}, "complex": np.array([1j])}


@pytest.mark.parametrize("compressed", [False, True])
def test_arrays_equal_those_of_scipy(tmp_path, compressed):
    path = tmp_path / "a.mat"
    savemat(path, OTHERS | ARRAYS, do_compression=compressed)
    expected = loadmat(path)
    for name, values in zip(ARRAYS, read_matlab_arrays(path, *ARRAYS), strict=True):
        assert values.shape == expected[name].shape
        assert np.array_equal(values, expected[name])
    for name in (*OTHERS, "absent"):
        with check_error():
            read_matlab_arrays(path, name)


def test_other_byte_order(tmp_path):
    def element(kind, data):
        return struct.pack(">II", kind, len(data)) + data + bytes(-len(data) % 8)

    matrix = (
        element(6, struct.pack(">II", 6, 0))
        + element(5, struct.pack(">ii", 1, 2))
        + struct.pack(">HH4s", 1, 1, b"P")  # a short element: its size and its type, then up to four bytes
        + element(9, struct.pack(">dd", 1.5, -2))
    )
    path = tmp_path / "a.mat"
    path.write_bytes(b"MATLAB 5.0 MAT-file".ljust(124) + struct.pack(">H", 0x0100) + b"MI" + element(14, matrix))
    assert read_matlab_arrays(path, "P")[0].tolist() == [[1.5, -2]]
    assert loadmat(path)["P"].tolist() == [[1.5, -2]]


def test_other_files_are_refused(tmp_path):
    path = tmp_path / "a.mat"
    for content in (
        b"",
        b"nothing of the kind" * 20,
        bytes(124) + b"\x00\x02IM",  # version 7.3
        bytes(124) + b"\x00\x03IM",
        bytes(124) + b"\x00\x01IM" + bytes(3),
    ):
        path.write_bytes(content)
        with check_error():
            read_matlab_arrays(path, "P")


def test_variables_that_unpack_to_too_much_are_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(matlab, "_MAX_UNPACKED_BYTES", 1500)  # of one variable and a half
    path = tmp_path / "a.mat"
    savemat(path, {"a": np.zeros(100), "b": np.zeros(100), "P": np.zeros(2)}, do_compression=True)
    with check_error():
        read_matlab_arrays(path, "P")


@pytest.mark.parametrize("compressed", [False, True])
def test_damaged_files_are_refused(tmp_path, compressed):
    path = tmp_path / "a.mat"
    savemat(path, {"P": np.arange(12.0)}, do_compression=compressed)
    content, rng = path.read_bytes(), np.random.default_rng(0)
    for size in range(128, len(content)):
        path.write_bytes(content[:size])
        with pytest.raises(InputError):
            read_matlab_arrays(path, "P")
    for _ in range(200):
        damaged = bytearray(content)
        for place in rng.integers(128, len(content), 3):
            damaged[place] = rng.integers(256)
        path.write_bytes(damaged)
        try:
            read_matlab_arrays(path, "P")
        except InputError as error:
            assert str(error).startswith(str(path))

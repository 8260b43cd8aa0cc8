"""MATLAB, HDF5 and MDF files, written by the packages that write them, become recordings; damaged ones are refused."""

from __future__ import annotations

from pathlib import Path

import asammdf
import h5py
import numpy as np
import pytest
from scipy.io import savemat

from autotune.errors import InputError
from autotune.files import SignalNames, read_recordings

T = 0.5 * np.arange(400)
U = np.repeat(np.random.default_rng(3).choice([45.0, 55.0], 20), 20)
Y = 60.0 + 0.01 * np.cumsum(U - 50.0)
#: Type of the first array's numbers in a file of MATLAB's version 5 without compression.
TYPE_OF_NUMBERS = 176


def arrays(path: Path) -> None:
    savemat(path, {"t": T, "u": U[:, None], "y": Y, "Ts": 0.5, "note": "a remark"})


def structure(path: Path) -> None:
    savemat(path, {"run": {"time": T, "valve": U, "temperature": Y}}, do_compression=True)


def simulink(path: Path) -> None:
    signals = [{"values": U[:, None], "label": "input"}, {"values": Y[:, None], "label": "output"}]
    savemat(path, {"logs": {"time": T[:, None], "signals": signals}})


def newer_matlab(path: Path) -> None:
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, values in (("t", T), ("u", U), ("y", Y)):
            file[name] = values[None, :]


def datasets(path: Path) -> None:
    with h5py.File(path, "w") as file:
        for name, values in (("time", T), ("input", U), ("output", Y)):
            file[f"rig/{name}"] = values
        file["rig/output"].attrs["unit"] = "degC"
        file["about"] = "a remark"


def channels(path: Path) -> None:
    file = asammdf.MDF()
    file.append(
        [
            asammdf.Signal(samples=U, timestamps=T, name="input", unit="%"),
            asammdf.Signal(samples=Y, timestamps=T, name="output", unit="degC"),
        ]
    )
    file.save(path)


FILES = {
    "arrays.mat": arrays, "structure.mat": structure, "simulink.mat": simulink, "newer.mat": newer_matlab,
    "datasets.h5": datasets, "channels.mf4": channels,
}  # fmt: skip


@pytest.mark.parametrize("name", FILES)
def test_columns_are_found_by_their_names_and_their_numbers_are_the_files(name: str, tmp_path: Path) -> None:
    FILES[name](tmp_path / name)
    (recording,) = read_recordings(tmp_path / name).recordings
    for read, written in ((recording.t, T), (recording.u, U), (recording.y, Y)):
        np.testing.assert_array_equal(read, written)


@pytest.mark.parametrize("name", ["datasets.h5", "channels.mf4"])
def test_units_come_along(name: str, tmp_path: Path) -> None:
    FILES[name](tmp_path / name)
    assert read_recordings(tmp_path / name).recordings[0].metadata["units"]["y"] == "degC"


def test_channels_of_two_rates_have_rows_where_both_were_sampled(tmp_path: Path) -> None:
    file = asammdf.MDF()
    file.append([asammdf.Signal(samples=U[::2], timestamps=T[::2], name="input")])
    file.append([asammdf.Signal(samples=Y, timestamps=T, name="output")])
    file.save(tmp_path / "two.mf4")
    (recording,) = read_recordings(tmp_path / "two.mf4").recordings
    np.testing.assert_array_equal(recording.t, T[::2])
    np.testing.assert_array_equal(recording.y, Y[::2])


def test_a_matrix_is_one_column_for_each_of_its_columns(tmp_path: Path) -> None:
    savemat(tmp_path / "matrix.mat", {"log": np.column_stack([T, U, Y])})
    names = SignalNames(t="log_1", u="log_2", y="log_3")
    (recording,) = read_recordings(tmp_path / "matrix.mat", names).recordings
    np.testing.assert_array_equal(recording.y, Y)


def test_a_file_that_ends_its_readers_process_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "damaged.mat"
    arrays(path)
    content = bytearray(path.read_bytes())
    content[TYPE_OF_NUMBERS] = 0  # the package reads a null pointer there, and its process ends
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"damaged\.mat: cannot be read"):
        read_recordings(path)


@pytest.mark.parametrize("name", FILES)
def test_half_a_file_is_refused_in_one_line(name: str, tmp_path: Path) -> None:
    path = tmp_path / name
    FILES[name](path)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 3])
    with pytest.raises(InputError) as refused:
        read_recordings(path)
    assert "\n" not in str(refused.value)


def test_a_file_without_two_arrays_of_one_length_says_what_it_holds(tmp_path: Path) -> None:
    savemat(tmp_path / "single.mat", {"y": Y, "gain": 3.0})
    with pytest.raises(InputError, match="no two columns of numbers have one length"):
        read_recordings(tmp_path / "single.mat")

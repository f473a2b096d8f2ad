"""Pickles from elsewhere: what is read comes out equal, everything else is refused by name and never run."""

from __future__ import annotations

import io
import os
import pickle
import sys
import types
from collections import Counter, OrderedDict, defaultdict
from pathlib import Path

import numpy as np
import pytest
from imitations import Ch, Select
from scipy import sparse

from hood.assets.pickles.records import load_pickle

CONTENT = {
    "fortran": np.asfortranarray(np.arange(12.0).reshape(3, 4)),
    "empty": np.zeros((0, 3), dtype=np.int32),
    "big endian": np.arange(3).astype(">i4"),
    "text": np.array(["ab", "c"]),
    "flags": np.array([True, False]),
    "number": np.float32(1.5),
    "plain": [1, 2.0, "x", b"yy", None, True, (1, (2,)), {3, 4}, OrderedDict(a=1)],
    "counted": Counter("aab"),
    "default": defaultdict(dict, {1: 2}),
}


@pytest.mark.parametrize("protocol", range(pickle.HIGHEST_PROTOCOL + 1))
def test_arrays_and_containers_come_out_equal(protocol: int, tmp_path: Path) -> None:
    path = tmp_path / "a.pkl"
    path.write_bytes(pickle.dumps(CONTENT, protocol))
    found = load_pickle(path)
    for key in ("fortran", "empty", "big endian", "text", "flags", "number"):
        np.testing.assert_array_equal(found[key], CONTENT[key])
        assert np.asarray(found[key]).dtype == np.asarray(CONTENT[key]).dtype.newbyteorder("=")
    assert found["fortran"].flags.f_contiguous
    assert found["plain"] == CONTENT["plain"]
    assert found["counted"] == {"a": 2, "b": 1}
    assert found["default"] == {1: 2}


@pytest.mark.parametrize("protocol", [0, 2, 4])
@pytest.mark.parametrize("make", [sparse.csc_matrix, sparse.csr_matrix, sparse.coo_matrix, sparse.csr_array])
def test_sparse_matrices(make: type, protocol: int, tmp_path: Path) -> None:
    dense = np.array([[0, 1.5, 0], [2, 0, 0]])
    (tmp_path / "s.pkl").write_bytes(pickle.dumps({"a": [make(dense)]}, protocol))
    np.testing.assert_array_equal(load_pickle(tmp_path / "s.pkl")["a"][0].toarray(), dense)


def test_sparse_indices_outside_the_matrix_are_refused(tmp_path: Path) -> None:
    matrix = sparse.csc_matrix(np.eye(3))
    matrix.indices[1] = 10**6
    (tmp_path / "s.pkl").write_bytes(pickle.dumps(matrix))
    with pytest.raises(ValueError, match="not a readable pickle"):
        load_pickle(tmp_path / "s.pkl")


def test_shared_and_nested_objects(tmp_path: Path) -> None:
    array = np.arange(3)
    ragged = np.empty(2, dtype=object)
    ragged[0], ragged[1] = array, [array]
    cyclic: list = [array]
    cyclic.append(cyclic)
    (tmp_path / "n.pkl").write_bytes(pickle.dumps({"a": array, "b": (array, {"c": array}), "ragged": ragged, "cyclic": cyclic}))
    found = load_pickle(tmp_path / "n.pkl")
    assert found["a"] is found["b"][0] is found["b"][1]["c"] is found["ragged"][1][0]
    assert found["cyclic"][1] is found["cyclic"]


@pytest.mark.parametrize("protocol", [0, 2, 4])
def test_chumpy_arrays_become_numpy_arrays(protocol: int, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    x = np.arange(24.0).reshape(2, 3, 4)
    chosen = Select(Ch(x), np.array([0, 5, 23, 7]), (2, 2))
    content = {"v_template": Ch(x), "shapedirs": chosen, "J_regressor": sparse.csc_matrix(np.eye(2))}
    with monkeypatch.context() as patch:  # the package exists while the file is written
        patch.setitem(sys.modules, "chumpy", types.ModuleType("chumpy"))
        for kind, name in ((Ch, "chumpy.ch"), (Select, "chumpy.reordering")):
            module = types.ModuleType(name)
            setattr(module, kind.__name__, kind)
            patch.setitem(sys.modules, name, module)
            patch.setattr(kind, "__module__", name)
        (tmp_path / "smpl.pkl").write_bytes(pickle.dumps(content, protocol))
    found = load_pickle(tmp_path / "smpl.pkl")
    assert type(found["v_template"]) is np.ndarray
    np.testing.assert_array_equal(found["v_template"], x)
    np.testing.assert_array_equal(found["shapedirs"], [[0, 5], [23, 7]])


class Call:
    """Pickles as a call of ``function``."""

    def __init__(self, function: object, *arguments: object) -> None:
        self.call = function, arguments

    def __reduce__(self) -> tuple:
        return self.call


@pytest.mark.parametrize(
    "function, arguments, name",
    [
        (os.system, ("touch {marker}",), f"{os.system.__module__}.system"),
        (eval, ("open('{marker}', 'w')",), "builtins.eval"),
        (getattr, (object, "__class__"), "builtins.getattr"),
        (io.open, ("{marker}", "w"), f"{io.open.__module__}.open"),
        (np.load, ("{marker}",), "numpy.load"),
        (bytearray, (10**12,), "builtins.bytearray"),
        (bytes, (10**12,), "builtins.bytes"),
        (types.SimpleNamespace, (), "types.SimpleNamespace"),
    ],
)
@pytest.mark.parametrize("protocol", [0, 2, 4])
def test_calls_are_refused_by_name_and_not_made(
    function: object, arguments: tuple, name: str, protocol: int, tmp_path: Path
) -> None:
    marker = tmp_path / "ran"
    given = [a.format(marker=marker) if isinstance(a, str) else a for a in arguments]
    (tmp_path / "evil.pkl").write_bytes(pickle.dumps([1, {"a": Call(function, *given)}], protocol))
    with pytest.raises(ValueError, match=r"evil\.pkl: ") as error:
        load_pickle(tmp_path / "evil.pkl")
    assert name in str(error.value)
    assert "\n" not in str(error.value)
    assert not marker.exists()


def test_functions_of_the_reader_cannot_be_changed(tmp_path: Path) -> None:
    """BUILD on the stand-in of ``_codecs.encode`` would set attributes of a function that later files use."""
    (tmp_path / "b.pkl").write_bytes(b"\x80\x02c_codecs\nencode\n}U\x08_call\x00\x00\x00K\x01sb.")
    with pytest.raises(ValueError, match="sets the state of a function"):
        load_pickle(tmp_path / "b.pkl")


@pytest.mark.parametrize("cut", [0, 1, 10, 200, -1])
def test_broken_files_are_one_sentence(cut: int, tmp_path: Path) -> None:
    (tmp_path / "c.pkl").write_bytes(pickle.dumps(CONTENT)[:cut])
    with pytest.raises(ValueError, match=r"c\.pkl: not a readable pickle") as error:
        load_pickle(tmp_path / "c.pkl")
    assert "\n" not in str(error.value)


def test_an_array_must_have_as_much_content_as_its_shape(tmp_path: Path) -> None:
    stream = pickle.dumps(np.arange(4.0), 2).replace(b"K\x01K\x04\x85", b"K\x01J\xff\xff\xff\x7f\x85")
    (tmp_path / "d.pkl").write_bytes(stream)
    with pytest.raises(ValueError, match="2147483647 float64 values with 32 bytes"):
        load_pickle(tmp_path / "d.pkl")


def test_the_size_limit_and_missing_files(tmp_path: Path) -> None:
    (tmp_path / "large.pkl").write_bytes(pickle.dumps(np.zeros(1000)))
    with pytest.raises(ValueError, match="the limit is 1000"):
        load_pickle(tmp_path / "large.pkl", size_limit=1000)
    with pytest.raises(FileNotFoundError):
        load_pickle(tmp_path / "none.pkl")


def test_bytes_are_read_before_room_is_made_for_them(tmp_path: Path) -> None:
    """Also of the kind that can be written into, for which Python's own reader makes room first."""
    sound = pickle.dumps({"bytes": bytearray(b"abc" * 100)}, protocol=5)
    (tmp_path / "sound.pkl").write_bytes(sound)
    assert load_pickle(tmp_path / "sound.pkl") == {"bytes": bytearray(b"abc" * 100)}
    announced = pickle.PROTO + b"\x05" + pickle.BYTEARRAY8 + (1 << 45).to_bytes(8, "little") + b"."
    (tmp_path / "huge.pkl").write_bytes(announced)
    with pytest.raises(ValueError, match=r"huge\.pkl: not a readable pickle \(it announces 35184372088832 more bytes"):
        load_pickle(tmp_path / "huge.pkl")

"""Arrays come out of a pickle, and nothing in it is run."""

import copyreg
import os
import pickle
import struct

import numpy as np
import pytest

from persist_cli.errors import CheckpointError
from persist_cli.weights.unpickling import read_pickled_arrays


class Calls:
    """Pickles as a call of ``function``."""

    def __init__(self, function, *arguments):
        self.call = (function, arguments)

    def __reduce__(self):
        return self.call


class Persistent(pickle.Pickler):
    def persistent_id(self, item):
        return "an id" if item == "persistent" else None


def text(value: str) -> bytes:
    return b"\x8c" + bytes([len(value)]) + value.encode()


def stack_global(module: str, name: str, *operations: bytes) -> bytes:
    return b"\x80\x04" + text(module) + text(name) + b"\x93" + b"".join(operations) + b"."


def refused(path, data: bytes) -> str:
    path.write_bytes(data)
    with pytest.raises(CheckpointError) as caught:
        read_pickled_arrays(path)
    message = str(caught.value)
    assert str(path) in message
    assert "\n" not in message
    return message


@pytest.mark.parametrize("protocol", [3, 4])
@pytest.mark.parametrize("kind", ["<f4", ">f8", "<i2", "|u1", "|b1"])
def test_arrays_come_back_under_their_paths_whatever_their_type_and_order(tmp_path, protocol, kind):
    rows = (np.arange(12) % 2).reshape(3, 4).astype(kind)
    tree = {"a": {"rows": rows, "columns": np.asfortranarray(rows)}, "empty": np.zeros((0, 2), kind)}
    (tmp_path / "tree").write_bytes(pickle.dumps(tree, protocol=protocol))
    read = read_pickled_arrays(tmp_path / "tree")
    assert list(read) == ["a.rows", "a.columns", "empty"]
    for name, array in (("a.rows", rows), ("a.columns", rows), ("empty", tree["empty"])):
        np.testing.assert_array_equal(read[name], array)
        assert read[name].dtype == array.dtype


@pytest.mark.parametrize("protocol", [0, 1, 2, 3, 4, 5])
def test_a_pickle_that_runs_a_command_is_refused_and_runs_nothing(tmp_path, protocol):
    command = Calls(os.system, f"touch {tmp_path}/ran")
    tree = {"a": np.zeros(2), "b": {"c": command}}
    refused(tmp_path / "p", pickle.dumps(tree, protocol=protocol))
    refused(tmp_path / "p", pickle.dumps(command, protocol=protocol))
    refused(tmp_path / "p", pickle.dumps({"a": Calls(np.zeros, command)}, protocol=protocol))  # called while arguments
    assert not (tmp_path / "ran").exists()


@pytest.mark.parametrize("function", [eval, exec, getattr, __import__, open, np.load, np.frombuffer, print])
def test_any_function_is_refused_even_those_of_numpy(tmp_path, function):
    assert "it asks for" in refused(tmp_path / "p", pickle.dumps({"a": Calls(function, "x")}, protocol=4))


@pytest.mark.parametrize(
    ("module", "name"),
    [
        ("os", "system"), ("numpy", "ndarray.tofile"), ("numpy", "core.os.system"), ("numpy", "memmap"),
        ("numpy.core.multiarray", "scalar"), ("numpy.core.multiarray", "_reconstruct.__globals__"), ("", ""),
    ],
)  # fmt: skip
def test_any_name_on_the_stack_is_refused_even_a_dotted_one(tmp_path, module, name):
    assert f"it asks for {module}.{name}" in refused(tmp_path / "p", stack_global(module, name))


def test_persistent_ids_are_refused(tmp_path):
    with (tmp_path / "ids").open("wb") as file:
        Persistent(file, 4).dump({"a": "persistent"})
    assert "a persistent object" in refused(tmp_path / "p", (tmp_path / "ids").read_bytes())


def test_a_name_of_the_extension_registry_is_refused(tmp_path):
    copyreg.add_extension("os", "system", 0x7E)
    try:
        refused(tmp_path / "p", b"\x80\x02\x82\x7e" + b"X\x01\x00\x00\x00x\x85R.")
    finally:
        copyreg.remove_extension("os", "system", 0x7E)


@pytest.mark.parametrize("name", ["ndarray", "dtype"])
def test_the_stand_ins_for_numpy_take_no_attributes_and_make_no_instances(tmp_path, name):
    state = text("shape") + text("x")
    refused(tmp_path / "p", stack_global("numpy", name, b"}", state, b"sb"))  # a state
    refused(tmp_path / "p", stack_global("numpy", name, b"N}", state, b"s\x86b"))  # a state of slots
    refused(tmp_path / "p", stack_global("numpy", name, b")\x81"))  # an instance


@pytest.mark.parametrize(
    "array",
    [np.array([object], dtype=object), np.array(["text"]), np.zeros(2, "f4,i4"), np.array(["2026"], "M8[Y]"),
     np.ma.zeros(2)],
)  # fmt: skip
def test_arrays_of_anything_but_plain_numbers_are_refused(tmp_path, array):
    refused(tmp_path / "p", pickle.dumps({"a": array}, protocol=4))


def test_a_shape_that_its_bytes_do_not_fill_is_refused(tmp_path):
    data = pickle.dumps({"a": np.zeros(7, np.float32)}, protocol=4)
    assert "bytes are no array" in refused(tmp_path / "p", data.replace(b"K\x07\x85", b"K\x08\x85"))


def test_trees_without_end_are_refused(tmp_path):
    within: dict = {}
    within["again"] = within
    assert "no tree of arrays" in refused(tmp_path / "p", pickle.dumps(within))
    shared: dict = {"a": np.zeros(1)}
    for _ in range(12):
        shared = {str(number): shared for number in range(10)}
    assert "more than" in refused(tmp_path / "p", pickle.dumps(shared, protocol=4))


@pytest.mark.parametrize("tree", [[], {}, "text", {"a": 1}, {1: np.zeros(1)}, {"a": [np.zeros(1)]}])
def test_anything_but_a_tree_of_arrays_is_refused(tmp_path, tree):
    refused(tmp_path / "p", pickle.dumps(tree, protocol=4))


def test_a_pickle_cut_off_anywhere_is_refused(tmp_path):
    data = pickle.dumps({"a": np.zeros(3), "b": np.ones(2)}, protocol=4)
    for length in range(len(data)):
        refused(tmp_path / "p", data[:length])
    refused(tmp_path / "p", b"\x80\x04\x8e" + struct.pack("<Q", 1 << 62) + b".")  # a string of 2^62 bytes

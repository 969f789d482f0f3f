"""Weights are read from an ONNX file, and a damaged one is refused."""

import numpy as np
import pytest

from persist_cli.errors import CheckpointError
from persist_cli.weights.onnx import linear_weights, read_onnx_weights


def varint(number: int) -> bytes:
    parts = []
    while number > 0x7F:
        parts.append(number & 0x7F | 0x80)
        number >>= 7
    return bytes([*parts, number])


def field(number: int, value: int | bytes | str) -> bytes:
    if isinstance(value, int):
        return varint(number << 3) + varint(value)
    data = value.encode() if isinstance(value, str) else value
    return varint(number << 3 | 2) + varint(len(data)) + data


def tensor(name: str, array: np.ndarray, packed: bool = False) -> bytes:
    dims = field(1, b"".join(map(varint, array.shape))) if packed else b"".join(field(1, side) for side in array.shape)
    kind = 1 if array.dtype == np.float32 else 7
    return field(5, dims + field(2, kind) + field(8, name) + field(9, array.tobytes()))


def node(kind: str, inputs: tuple[str, ...], output: str) -> bytes:
    return field(1, b"".join(field(1, name) for name in inputs) + field(2, output) + field(4, kind))


def model() -> tuple[bytes, np.ndarray]:
    """A linear layer with 300 inputs and two outputs, its bias first in the sum; and parts that are ignored."""
    matrix = np.arange(600, dtype=np.float32).reshape(300, 2)
    parts = [
        field(2, "graph"),
        node("MatMul", ("x", "unnamed"), "product"),
        node("Add", ("layer.bias", "product"), "y"),
        node("Add", ("layer.bias", "x"), "z"),
        tensor("unnamed", matrix, packed=True),
        tensor("layer.bias", np.array([1, 2], np.float32)),
        tensor("counts", np.arange(3)),
    ]
    version, fixed = field(1, 8), varint(9 << 3 | 5) + bytes(4) + varint(10 << 3 | 1) + bytes(8)
    return version + fixed + field(7, b"".join(parts)), matrix


def test_the_matrix_of_a_linear_layer_is_found_through_its_bias(tmp_path):
    data, matrix = model()
    (tmp_path / "model.onnx").write_bytes(data)
    weights = read_onnx_weights(tmp_path / "model.onnx")
    assert set(weights.arrays) == {"unnamed", "layer.bias"}
    assert [node.kind for node in weights.nodes] == ["MatMul", "Add", "Add"]
    linear = linear_weights(weights)
    assert list(linear) == ["layer.bias"]
    np.testing.assert_array_equal(linear["layer.bias"], matrix.T)


def test_an_onnx_file_cut_off_anywhere_is_refused_in_one_line(tmp_path):
    data, _ = model()
    path = tmp_path / "model.onnx"
    for length in [*range(30), *range(30, len(data), 97)]:
        path.write_bytes(data[:length])
        with pytest.raises(CheckpointError) as caught:
            read_onnx_weights(path)
        assert str(path) in str(caught.value)
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize("data", [b"", b"\xff" * 40, b"\x0f", field(7, tensor("a", np.ones(2, np.float32))[:-1])])
def test_a_file_that_is_no_onnx_file_is_refused(tmp_path, data):
    (tmp_path / "model.onnx").write_bytes(data)
    with pytest.raises(CheckpointError, match="not a whole ONNX file"):
        read_onnx_weights(tmp_path / "model.onnx")

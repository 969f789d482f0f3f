"""The weights in an ONNX file: its initialisers, and which matrix product each bias follows.

An ONNX file is one protobuf message. Only the few fields with weights are read here, by this module: the ``onnx``
package would bring a compiled library and its own protobuf for one file whose SHA-256 is known.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from persist_cli.errors import CheckpointError

VARINT, FIXED64, BYTES, FIXED32 = 0, 1, 2, 5  # protobuf's wire types
GRAPH: Final = 7  # field of ModelProto
NODE, INITIALIZER = 1, 5  # of GraphProto
NODE_INPUT, NODE_OUTPUT, NODE_KIND = 1, 2, 4  # of NodeProto
DIMS, DATA_TYPE, TENSOR_NAME, RAW_DATA = 1, 2, 8, 9  # of TensorProto
FLOAT32: Final = 1  # a DATA_TYPE


@dataclass(frozen=True)
class Node:
    """An operation: its kind, and the names of its inputs and outputs."""

    kind: str
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]


@dataclass(frozen=True)
class OnnxWeights:
    """The weights of an ONNX file.

    Args:
        arrays: float32 initialisers by name.
        nodes: all operations in their order.
    """

    arrays: dict[str, np.ndarray]
    nodes: tuple[Node, ...]


def read_onnx_weights(path: Path) -> OnnxWeights:
    """The float32 initialisers and the operations of an ONNX file.

    Raises:
        CheckpointError: one line when the file is truncated or is no ONNX file.
    """
    data = memoryview(path.read_bytes())
    try:
        graphs = [value for field, value in _fields(data) if field == GRAPH and isinstance(value, memoryview)]
        if len(graphs) != 1:
            raise ValueError("no graph in it")
        parts = [(field, part) for field, part in _fields(graphs[0]) if isinstance(part, memoryview)]
        nodes = tuple(_node(part) for field, part in parts if field == NODE)
        return OnnxWeights(dict(_arrays([part for field, part in parts if field == INITIALIZER])), nodes)
    except (ValueError, IndexError) as error:
        raise CheckpointError(f"{path}: not a whole ONNX file ({error})") from error


def linear_weights(weights: OnnxWeights) -> dict[str, np.ndarray]:
    """The matrix of each linear layer, out × in, by the name of its bias: the operand of the product in front of it."""
    matrices = {
        node.outputs[0]: weights.arrays[node.inputs[1]].T
        for node in weights.nodes
        if node.kind == "MatMul" and node.inputs[1] in weights.arrays
    }
    sums = [node for node in weights.nodes if node.kind == "Add" and len(node.inputs) == 2]
    pairs = [pair for node in sums for pair in (node.inputs, node.inputs[::-1])]
    return {bias: matrices[product] for bias, product in pairs if bias in weights.arrays and product in matrices}


def _arrays(tensors: list[memoryview]) -> Iterator[tuple[str, np.ndarray]]:
    for tensor in tensors:
        dims, kind, name, raw = [], 0, "", memoryview(b"")
        for field, value in _fields(tensor):
            if isinstance(value, int):
                dims += [value] if field == DIMS else []
                kind = value if field == DATA_TYPE else kind
            elif field == DIMS:
                dims += _packed_integers(value)
            elif field == TENSOR_NAME:
                name = str(value, "utf-8")
            elif field == RAW_DATA:
                raw = value
        if kind != FLOAT32:
            continue
        if len(raw) != 4 * math.prod(dims):
            raise ValueError(f"{name} has {len(raw)} bytes for shape {dims}")
        yield name, np.frombuffer(raw, "<f4").reshape(dims)


def _node(data: memoryview) -> Node:
    texts: dict[int, list[str]] = {NODE_INPUT: [], NODE_OUTPUT: [], NODE_KIND: []}
    for field, value in _fields(data):
        if field in texts and isinstance(value, memoryview):
            texts[field].append(str(value, "utf-8"))
    return Node("".join(texts[NODE_KIND]), tuple(texts[NODE_INPUT]), tuple(texts[NODE_OUTPUT]))


def _fields(data: memoryview) -> Iterator[tuple[int, int | memoryview]]:
    """Number and value of each field of a message; numbers of fixed width are passed over as bytes."""
    at = 0
    while at < len(data):
        key, at = _varint(data, at)
        if key & 7 == VARINT:
            value, at = _varint(data, at)
            yield key >> 3, value
            continue
        if key & 7 == BYTES:
            length, at = _varint(data, at)
        elif key & 7 in (FIXED32, FIXED64):
            length = 4 if key & 7 == FIXED32 else 8
        else:
            raise ValueError(f"wire type {key & 7}")
        if at + length > len(data):
            raise ValueError(f"it ends {at + length - len(data)} bytes too early")
        yield key >> 3, data[at : at + length]
        at += length


def _varint(data: memoryview, at: int) -> tuple[int, int]:
    value = 0
    for shift in range(0, 64, 7):
        value |= (data[at] & 0x7F) << shift
        at += 1
        if data[at - 1] < 0x80:
            return value, at
    raise ValueError("a number of more than 64 bits")


def _packed_integers(data: memoryview) -> list[int]:
    values, at = [], 0
    while at < len(data):
        value, at = _varint(data, at)
        values.append(value)
    return values

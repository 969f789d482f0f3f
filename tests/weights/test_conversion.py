"""Original files become tensors that compute what the originals compute."""

import pickle
import zipfile

import numpy as np
import pytest
import torch

from persist_cli.errors import CheckpointError
from persist_cli.io.files import read_tensors
from persist_cli.io.hub import cached_weight
from persist_cli.weights.conversion import CONVERSIONS
from tests.support.small_weights import alex_tree


def converted(name, tree, folder):
    (folder / "tree").write_bytes(pickle.dumps(tree, protocol=4))
    return CONVERSIONS[name](folder / "tree")


def i3d_tree() -> dict:
    """A tree as that of I3D, every kernel 1×2×3 in time, height and width, one channel in, two out."""
    numbers = np.random.default_rng(0)
    units = [f"Unit_{i}" for i in range(56)] + ["Mixed_3b/Branch_0"]
    kernels = {unit: {"kernel": numbers.standard_normal((1, 2, 3, 1, 2)).astype(np.float32)} for unit in units}
    parameters = {unit: {"Conv_0": kernels[unit], "BatchNorm_0": {"bias": np.ones(2)}} for unit in units}
    last = {"kernel": np.ones((1, 1, 1, 2, 4)), "bias": np.ones(4)}
    statistics = {unit: {"BatchNorm_0": {"mean": np.ones(2), "var": np.ones(2)}} for unit in units}
    return {"params": parameters | {"Logits/Conv3d_0c_1x1": {"Conv_0": last}}, "batch_stats": statistics}


def test_lpips_convolutions_keep_their_order_and_compute_what_the_kernels_compute(tmp_path):
    tree = alex_tree()
    tensors = converted("lpips-alex", tree, tmp_path)
    assert sorted(tensors) == sorted(
        [f"conv{i}.{kind}" for i in range(5) for kind in ("weight", "bias")] + [f"head{i}.weight" for i in range(5)]
    )
    for i in range(5):
        layer = tree["AlexNet_0"][f"Conv_{i}"]
        patch = np.random.default_rng(i).standard_normal(layer["kernel"].shape[:3]).astype(np.float32)
        expected = np.einsum("hwi,hwio->o", patch, layer["kernel"]) + layer["bias"]
        image = torch.from_numpy(patch).permute(2, 0, 1)[None]
        computed = torch.nn.functional.conv2d(image, tensors[f"conv{i}.weight"], tensors[f"conv{i}.bias"]).flatten()
        torch.testing.assert_close(computed, torch.from_numpy(expected), atol=1e-4, rtol=1e-4)
        head = tree[f"NetLinLayer_{i}"]["Conv_0"]["kernel"]
        np.testing.assert_array_equal(tensors[f"head{i}.weight"].numpy()[0, :, 0, 0], head[0, 0, :, 0])


def test_i3d_kernels_become_weights_in_torch_order_and_other_arrays_keep_their_names(tmp_path):
    tree = i3d_tree()
    tensors = converted("i3d-kinetics-400", tree, tmp_path)
    assert len(tensors) == 58 + 1 + 57 * 3
    kernel = tree["params"]["Mixed_3b/Branch_0"]["Conv_0"]["kernel"]
    weight = tensors["params.Mixed_3b/Branch_0.Conv_0.weight"]
    video = torch.randn(1, 1, 1, 2, 3)
    expected = np.einsum("thwi,thwio->o", video[0].permute(1, 2, 3, 0).numpy(), kernel)
    computed = torch.nn.functional.conv3d(video, weight).flatten()
    torch.testing.assert_close(computed, torch.from_numpy(expected), atol=1e-5, rtol=1e-5)
    assert tensors["batch_stats.Unit_3.BatchNorm_0.var"].dtype == torch.float32


@pytest.mark.parametrize(
    ("name", "tree", "path"),
    [
        ("lpips-alex", alex_tree(), ("AlexNet_0", "Conv_2", "bias")),
        ("lpips-alex", alex_tree(), ("NetLinLayer_4", "Conv_0", "kernel")),
        ("i3d-kinetics-400", i3d_tree(), ("batch_stats", "Unit_5", "BatchNorm_0", "var")),
        ("i3d-kinetics-400", i3d_tree(), ("params", "Logits/Conv3d_0c_1x1", "Conv_0", "bias")),
        ("i3d-kinetics-400", i3d_tree(), ("params", "Unit_5", "Conv_0", "kernel")),
    ],
)
def test_a_tree_that_lacks_an_array_is_refused_with_its_name(tmp_path, name, tree, path):
    branch = tree
    for name_of_branch in path[:-1]:
        branch = branch[name_of_branch]
    del branch[path[-1]]
    with pytest.raises(CheckpointError, match=r"tree: not the expected weights: \d+ (missing|unknown) \(.*Unit_5|Conv"):
        converted(name, tree, tmp_path)


def test_a_tree_with_fewer_convolutions_than_its_network_has_is_refused(tmp_path):
    tree = i3d_tree()
    for branch in tree.values():
        del branch["Unit_5"]
    with pytest.raises(CheckpointError, match="56 convolutions with a batch norm, I3D has 57"):
        converted("i3d-kinetics-400", tree, tmp_path)


def test_a_tree_of_another_network_is_refused(tmp_path):
    tree = alex_tree()
    tree["AlexNet_0"]["Conv_1"]["kernel"] = np.zeros((2, 1, 64, 5), np.float32)
    with pytest.raises(CheckpointError, match=r"convolution 1 has \(out, in\) \(5, 64\), not \(192, 64\)"):
        converted("lpips-alex", tree, tmp_path)
    with pytest.raises(CheckpointError, match=r"26 missing .*, 10 unknown"):
        converted("lpips-vgg", alex_tree(), tmp_path)


def test_a_torch_file_of_anything_but_weights_is_refused(tmp_path):
    class Command:
        def __reduce__(self):
            return print, ("ran",)

    torch.save({"a": torch.ones(2), "b": Command()}, tmp_path / "hostile.pth")
    torch.save([torch.ones(2)], tmp_path / "list.pth")
    (tmp_path / "short.pth").write_bytes((tmp_path / "hostile.pth").read_bytes()[:300])
    with zipfile.ZipFile(tmp_path / "zip.pth", "w") as file:
        file.writestr("data", "no torch file")
    for name, cause in {"hostile": "refused", "list": "no", "short": "refused", "zip": "refused"}.items():
        with pytest.raises(CheckpointError, match=cause) as caught:
            CONVERSIONS["efficientnet-lite0"](tmp_path / f"{name}.pth")
        assert "\n" not in str(caught.value)


@pytest.mark.skipif(cached_weight("dinov2-s-derived") is None, reason="persist weights fetch dinov2-s-derived")
def test_the_derived_dinov2_computes_what_onnx_runtime_computes():
    from transformers import Dinov2Model

    folder = cached_weight("dinov2-s-derived")
    model, report = Dinov2Model.from_pretrained(folder, output_loading_info=True)
    assert not any(report.values())
    assert sum(tensor.numel() for tensor in read_tensors(folder / "model.safetensors")[0].values()) == 22_056_192
    wave = np.sin(np.arange(3 * 224 * 224) * 0.01).astype(np.float32).reshape(1, 3, 224, 224)
    with torch.no_grad():
        out = model.eval()(torch.from_numpy(wave), output_hidden_states=True)
    # onnxruntime 1.31.1 on the original file: channels 0, 100, 383 of tokens 0, 1, 128, 256
    block_8 = [
        [-0.15638, -0.11687, 0.08301], [-0.15, 0.25181, -0.07808], [-0.09446, 0.25392, -0.10584],
        [-0.11004, 0.28666, -0.22213],
    ]  # fmt: skip
    last = [
        [1.05675, 2.18272, 1.89141], [1.46478, 2.5024, 1.68795], [1.40545, 2.27789, 1.51374],
        [1.49324, 2.43707, 1.11347],
    ]  # fmt: skip
    for states, values in ((out.hidden_states[8], block_8), (out.last_hidden_state, last)):
        computed = states[0, [0, 1, 128, 256]][:, [0, 100, 383]]
        torch.testing.assert_close(computed, torch.tensor(values), atol=5e-5, rtol=0)

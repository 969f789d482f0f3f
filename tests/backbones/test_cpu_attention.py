"""Attention in training on processors: other kernels, the same losses and gradients up to rounding."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import pytest
import torch
from torch.nn.functional import scaled_dot_product_attention
from torch.profiler import ProfilerActivity, profile

from persist_backbones.cogvideox.cogvideox import CogVideoX
from persist_cli.api import cpu_attention
from persist_cli.api.stages import MemorySavings
from tests.support.micro_model import micro, random_clips, random_tokens, shaken, trained

FUSED = "aten::_scaled_dot_product_flash_attention_for_cpu"


def model() -> CogVideoX:
    backbone = micro()
    shaken(backbone)
    return backbone


def loss(backbone: CogVideoX, precision: torch.dtype) -> torch.Tensor:
    clips = random_clips(2)
    clips = dataclasses.replace(clips, latents=backbone.encode(clips))  # in float32, which some processors need
    with torch.autocast("cpu", dtype=torch.bfloat16, enabled=precision == torch.bfloat16):
        return backbone(clips, "1")["loss"]


def uses_fused(run: Callable[[], object]) -> bool:
    with profile(activities=[ProfilerActivity.CPU]) as recorded:
        run()
    return any(event.key == FUSED for event in recorded.key_averages())


def test_a_training_step_in_bfloat16_attends_by_products() -> None:
    assert not uses_fused(lambda: loss(model(), torch.bfloat16))


def test_float32_and_steps_without_gradients_keep_the_fused_kernel() -> None:
    assert uses_fused(lambda: loss(model(), torch.float32))
    with torch.no_grad():
        assert uses_fused(lambda: loss(model(), torch.bfloat16))


def test_blocks_that_are_computed_again_keep_the_fused_kernel() -> None:
    backbone = model()
    backbone.apply_memory_savings("1", MemorySavings(gradient_checkpointing=True))
    assert uses_fused(lambda: loss(backbone, torch.bfloat16).backward())


def test_more_weights_than_fit_keep_the_fused_kernel(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cpu_attention, "MOST_WEIGHTS", 1)
    assert uses_fused(lambda: loss(model(), torch.bfloat16))


def test_attention_to_many_tokens_keeps_the_fused_kernel_beside_that_of_the_video(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(cpu_attention, "MOST_WEIGHTS", 2 * 3 * 4 * 4)
    video, memory = (torch.randn(2, 3, count, 8, dtype=torch.bfloat16, requires_grad=True) for count in (4, 5))
    with cpu_attention.products_for_training(video):
        assert not uses_fused(lambda: scaled_dot_product_attention(video, video, video))
        assert uses_fused(lambda: scaled_dot_product_attention(video, memory, memory))


def test_losses_and_gradients_are_those_of_the_fused_kernel_up_to_rounding(monkeypatch: pytest.MonkeyPatch) -> None:
    by_products, fused = model(), model()
    values = [loss(by_products, torch.bfloat16)]
    monkeypatch.setattr(cpu_attention, "MOST_WEIGHTS", 1)
    values.append(loss(fused, torch.bfloat16))
    for value in values:
        value.backward()
    torch.testing.assert_close(values[0], values[1], rtol=0.01, atol=0.0)
    one, two = (
        torch.cat([part.grad.flatten() for part in it.parameters() if part.grad is not None])
        for it in (by_products, fused)
    )
    assert float((one - two).norm()) < 0.02 * float(two.norm())


def test_keys_that_a_mask_hides_are_not_attended_to() -> None:
    torch.manual_seed(0)
    query, key, value = (torch.randn(2, 3, count, 8) for count in (4, 6, 6))
    mask = torch.rand(2, 1, 1, 6) < 0.6
    wanted = scaled_dot_product_attention(query, key, value, attn_mask=mask)
    torch.testing.assert_close(cpu_attention.attend(query, key, value, mask).float(), wanted, rtol=0.05, atol=0.02)


@pytest.mark.parametrize("form", ["cross", "projected"])
def test_an_adapter_that_attends_to_memory_trains_in_bfloat16(form: str) -> None:
    backbone, clips = trained(form), random_clips(2, random_tokens(2, 6))
    clips = dataclasses.replace(clips, latents=backbone.encode(clips))
    with torch.autocast("cpu", dtype=torch.bfloat16):
        backbone(clips, "2")["loss"].backward()
    gradients = [part.grad for part in backbone.trained_parameters("2").values()]
    assert all(gradient is not None and gradient.isfinite().all() for gradient in gradients)

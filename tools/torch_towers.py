"""The towers of the embedded encoder in torch, for training."""

from __future__ import annotations

from typing import cast

import torch
from torch import Tensor, nn
from torch.nn import functional

from su3d_bench.perception.embedded.lexicon import DIM, N_ROWS, PADDING

WORD_DIM = 64
TEXT_DIM = 128
HAS_FAST_BFLOAT16 = torch.backends.cpu.get_cpu_capability() == "AVX512"  # others emulate it, ten times as slowly


def _convolution(n_in: int, n_out: int, stride: int = 1, size: int = 3) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(n_in, n_out, size, stride, size // 2, bias=False), nn.BatchNorm2d(n_out), nn.ReLU(inplace=True)
    )


class Residual(nn.Module):
    """x + f(x), where f narrows to ``n_inner`` channels for its 3 x 3 convolution."""

    def __init__(self, n: int, n_inner: int) -> None:
        super().__init__()
        self.branch = nn.Sequential(
            _convolution(n, n_inner, size=1),
            _convolution(n_inner, n_inner),
            nn.Conv2d(n_inner, n, 1, bias=False),
            nn.BatchNorm2d(n),
        )

    def forward(self, x: Tensor) -> Tensor:
        return functional.relu(x + self.branch(x))


class ImageTower(nn.Module):
    """Pixels (N, 64, 64, 3) uint8 and log sizes (N, 2) to features (N, 128) of length 1.

    The crop's size is added as two constant planes, because resizing to 64 x 64 hides it. The middle of the last
    feature map is also pooled separately: it shows the object, and the rest its context.
    """

    def __init__(self) -> None:
        super().__init__()
        self.body = nn.Sequential(
            _convolution(5, 48, 4, size=7),
            _convolution(48, 96, 2),
            Residual(96, 48),
            Residual(96, 48),
            _convolution(96, 160, 2),
            Residual(160, 80),
            Residual(160, 80),
        )
        self.head = nn.Sequential(nn.Linear(3 * 160 + 2, 192), nn.ReLU(inplace=True), nn.Linear(192, DIM), _centred())

    def forward(self, pixels: Tensor, log_size: Tensor) -> Tensor:
        image = pixels.permute(0, 3, 1, 2).float() / 64.0 - 2.0
        planes = log_size[:, :, None, None] + torch.zeros_like(image[:, :2])
        stacked = torch.cat([image, planes], dim=1).contiguous(memory_format=torch.channels_last)
        with torch.autocast("cpu", torch.bfloat16, enabled=self.training and HAS_FAST_BFLOAT16):
            x = self.body(stacked)
        x = x.float()
        pooled = torch.cat([x.mean((2, 3)), x.amax((2, 3)), x[:, :, 1:3, 1:3].mean((2, 3)), log_size], dim=1)
        return _unit(self.head(pooled))


class TextTower(nn.Module):
    """Table rows (N, 16, 10) int64 to features (N, 128) of length 1; convolutions capture the word order."""

    def __init__(self) -> None:
        super().__init__()
        self.table = nn.Parameter(torch.randn(N_ROWS, WORD_DIM) * 0.5)
        self.first = nn.Conv1d(WORD_DIM, TEXT_DIM, 3, padding=1)
        self.second = nn.Conv1d(TEXT_DIM, TEXT_DIM, 3, padding=1)
        self.third = nn.Conv1d(TEXT_DIM, TEXT_DIM, 3, padding=1)
        self.head = nn.Sequential(
            nn.Linear(2 * TEXT_DIM, TEXT_DIM), nn.ReLU(inplace=True), nn.Linear(TEXT_DIM, DIM), _centred()
        )

    def forward(self, ids: Tensor) -> Tensor:
        rows = functional.embedding(ids, self.table) * (ids != PADDING).unsqueeze(-1).float()
        n_grams = (ids[:, :, 2:] != PADDING).float().sum(2).clamp(min=1.0).unsqueeze(-1)
        words = rows[:, :, :2].sum(2) + rows[:, :, 2:].sum(2) / n_grams
        is_word = (ids.amax(2) != PADDING).float().unsqueeze(1)
        with torch.autocast("cpu", torch.bfloat16, enabled=self.training and HAS_FAST_BFLOAT16):
            x = functional.relu(self.first(words.transpose(1, 2))) * is_word
            x = (x + functional.relu(self.second(x))) * is_word
            x = (x + functional.relu(self.third(x))) * is_word
        x = x.float()
        mean = x.sum(2) / is_word.sum(2).clamp(min=1.0)
        return _unit(self.head(torch.cat([mean, x.amax(2)], dim=1)))


def _centred() -> nn.Module:
    # Without it both towers spend the first part of training at one point of the sphere.
    return nn.BatchNorm1d(DIM, affine=False)


def _unit(x: Tensor) -> Tensor:
    return cast(Tensor, x / x.norm(dim=1, keepdim=True).clamp(min=1e-6))

"""Answers of imagecorruptions 1.1.2 for given random numbers, kept in tests/corruptions/imagecorruptions.npz.

Run it in an environment of its own, because the package needs old versions:

    pip install imagecorruptions==1.1.2 "numpy<2" "scipy<1.12" "scikit-image<0.22" "setuptools<70"
    python benchmarks/originals/imagecorruptions_answers.py tests/corruptions/imagecorruptions.npz

The file holds the ``image``, the draws ``normal`` and ``uniform`` (2 of them, used in turn), and for each corruption
its answers (5, H, W, 3) for severities 1 to 5. Counts of photons are quantiles of the Poisson distribution at
``uniform``, so that they depend on the expected counts.
"""

from __future__ import annotations

import itertools
import sys
from pathlib import Path
from typing import Any

import numpy as np

NAMES = (
    "gaussian_noise", "shot_noise", "impulse_noise", "defocus_blur", "zoom_blur", "brightness", "contrast",
    "elastic_transform", "pixelate", "jpeg_compression",
)  # fmt: skip
SHAPE = (36, 48, 3)


def made_image(rng: np.random.Generator) -> np.ndarray[Any, np.dtype[np.uint8]]:
    """A smooth picture with blocks of one colour, a gradient, black, white and a little noise."""
    v, u = np.mgrid[: SHAPE[0], : SHAPE[1]]
    image = np.stack([4 * u, 5 * v, 128 + 100 * np.sin(u / 5) * np.cos(v / 7)], axis=-1)
    image += rng.integers(0, 8, SHAPE)
    image[5:16, 8:20], image[20:30, 25:38] = (200, 40, 90), (30, 160, 60)
    image[24:34, 4:12], image[4:12, 34:45] = 0, 255
    return np.clip(image, 0, 255).astype(np.uint8)


def main(to: Path) -> None:
    from imagecorruptions import corrupt
    from scipy.stats import poisson

    rng = np.random.default_rng(20190330)
    image = made_image(rng)
    normal = rng.standard_normal(SHAPE).astype(np.float32).astype(np.float64)
    uniform = (rng.integers(0, 2**16, (2, *SHAPE)) + 0.5) / 2**16
    order = itertools.cycle(uniform)

    class Draws:
        """The draws of ``numpy.random`` in the package and in scikit-image."""

        def normal(self, loc: float = 0.0, scale: float = 1.0, size: Any = None) -> Any:
            assert size == SHAPE
            return loc + scale * normal

        def poisson(self, lam: Any) -> Any:
            return poisson.ppf(uniform[0], lam).astype(np.int64)

        def uniform(self, low: float, high: float, size: Any) -> Any:
            return low + (high - low) * next(order)[..., 0]

        def random(self, size: Any) -> Any:
            assert size == SHAPE
            return next(order)

    draws = Draws()
    for name in ("normal", "poisson", "uniform"):
        setattr(np.random, name, getattr(draws, name))
    np.random.default_rng = lambda *_: draws
    answers = {name: np.stack([corrupt(image, severity, name) for severity in range(1, 6)]) for name in NAMES}
    kept = {"image": image, "normal": normal.astype(np.float32), "uniform": np.floor(uniform * 2**16).astype(np.uint16)}
    np.savez_compressed(to, **kept, **answers)


if __name__ == "__main__":
    main(Path(sys.argv[1]))

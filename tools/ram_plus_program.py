"""Export RAM++ as an ONNX file with its authors' code: a program that runs in a separate environment.

    PYTHON ram_plus_program.py CHECKOUT WEIGHTS FOLDER --opset 17

``export_onnx.py`` starts it in an environment with torch, transformers 4 and onnx; it imports nothing of this
nothing. FOLDER contains ``images.npz`` (``images``, float32, N x 3 x 384 x 384). It gets ``ram_plus.onnx``,
``ram_tag_list.txt``, ``versions.json`` and ``answers.npz``: ``logit`` (N, T) and ``tag`` (N, T), whether the
authors' ``generate_tag`` names it, and ``threshold`` (T,). The last line on stderr states the error.

Only the files of recognize-anything (read at 7cb804a) needed by RAM++ with a Swin encoder are run. Imports that
the trained network does not use are replaced: timm's initialisation and drop path, SciPy's resizing
of position tables, the plain ViT, and BERT's tokenizer, of which only the number of words is used.
"""

from __future__ import annotations

import argparse
import importlib
import json
import sys
import types
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

IMAGE_PX = 384
VIT = "swin_l"
BERT_WORDS = 30_522 + 2  # bert-base-uncased, and the two added by init_tokenizer of ram/models/utils.py
# Computed by the network from its window size; the authors' loader drops them too.
RECOMPUTED_BUFFERS = ("relative_position_index", "attn_mask")


def build_network(checkout: Path) -> Any:
    """The authors' network as built by their package, in evaluation mode, with random weights."""
    for name in ("modeling_utils", "modeling_outputs", "models.bert.configuration_bert"):
        importlib.import_module(f"transformers.{name}")  # checks installed packages: before stand-ins are added
    _replace_unused_imports(checkout)
    module: Any = importlib.import_module("ram.models.ram_plus")
    module.init_tokenizer = lambda *_: range(BERT_WORDS)
    return module.ram_plus(pretrained="", image_size=IMAGE_PX, vit=VIT).eval()


def _replace_unused_imports(checkout: Path) -> None:
    import torch

    class DropPath(torch.nn.Module):
        """Drops paths while training; does nothing here."""

        def __init__(self, *_: object) -> None:
            super().__init__()

        def forward(self, values: Any) -> Any:
            return values

    layers: dict[str, Any] = {"DropPath": DropPath, "to_2tuple": _pair, "trunc_normal_": torch.nn.init.trunc_normal_}
    _module("ram", folder=checkout / "ram")  # without the imports of its __init__
    _module("ram.models", folder=checkout / "ram" / "models")
    _module("ram.models.vit", interpolate_pos_embed=None, VisionTransformer=None)
    _module("timm")
    _module("timm.models")
    _module("timm.models.layers", None, **layers)
    _module("timm.models.hub", download_cached_file=None)
    _module("scipy", interpolate=None)


def _module(name: str, folder: Path | None = None, **content: Any) -> None:
    module = types.ModuleType(name)
    module.__path__ = [] if folder is None else [str(folder)]
    vars(module).update(content)
    sys.modules[name] = module


def _pair(value: Any) -> tuple[Any, ...]:
    return tuple(value) if isinstance(value, Iterable) else (value, value)


def read_tensors(path: Path) -> Mapping[str, Any]:
    """The tensors of the published file, read as plain data."""
    import torch

    content = torch.load(path, map_location="cpu", weights_only=True)
    tensors = content.get("model", content) if isinstance(content, dict) else None
    if not isinstance(tensors, dict) or not all(isinstance(value, torch.Tensor) for value in tensors.values()):
        raise ValueError(f"{path.name} is not a table of named tensors")
    return tensors


def fill(model: Any, tensors: Mapping[str, Any]) -> None:
    """Load the weights into ``model`` under the names of the authors' loader; ``ValueError`` if they do not fit."""
    kept = {
        name.replace("vision_multi", "tagging_head"): tensor
        for name, tensor in tensors.items()
        if not any(part in name for part in RECOMPUTED_BUFFERS)
    }
    try:
        missing = model.load_state_dict(kept, strict=False).missing_keys
    except RuntimeError as error:
        raise ValueError(f"does not fit RAM++ ({' '.join(str(error).split())})") from error
    missing = [name for name in missing if not any(part in name for part in RECOMPUTED_BUFFERS)]
    if missing:
        raise ValueError(f"lacks {len(missing)} tensors, such as {missing[0][:80]}")


def own_answers(model: Any, images: Any) -> tuple[np.ndarray[Any, Any], np.ndarray[Any, Any]]:
    """The last layer's output (N, T) in the authors' ``generate_tag`` for ``images``, and the tags (N, T) it returns.

    Raises ``ValueError`` if these tags are not those whose probability is above their threshold.
    """
    import torch

    seen: list[Any] = []
    hook = model.fc.register_forward_hook(lambda _module, _inputs, output: seen.append(output))
    logits, tags = [], []
    try:
        for image in images:
            seen.clear()
            with torch.inference_mode():
                named = model.generate_tag(image[None])[0][0]
            logit = seen[0].reshape(-1)
            above = (torch.sigmoid(logit) > model.class_threshold).numpy()
            if named != " | ".join(np.asarray(model.tag_list)[above]):
                raise ValueError("generate_tag returns tags other than those above their thresholds: another version")
            logits.append(logit.numpy())
            tags.append(above)
    finally:
        hook.remove()
    return np.stack(logits), np.stack(tags)


def module_to_export(model: Any) -> Any:
    """``image`` (1, 3, 384, 384) to ``tag`` (1, T), 1 if the tag applies, and ``logit`` (1, T), by ``model``.

    Each class has D descriptions, whose features are weighted by similarity to the image; this product is
    computed class by class, so that the table of features is stored only once in the file.
    """
    import torch

    class Tagging(torch.nn.Module):
        features: torch.Tensor
        threshold: torch.Tensor

        def __init__(self) -> None:
            super().__init__()
            self.model = model
            n_classes, width = len(model.class_threshold), model.label_embed.shape[-1]
            self.register_buffer("features", model.label_embed.detach().view(n_classes, -1, width))
            self.register_buffer("threshold", model.class_threshold.detach().clone())

        def forward(self, image: Any) -> tuple[Any, Any]:
            seen = self.model.image_proj(self.model.visual_encoder(image))
            whole = seen[0, 0] / seen[0, 0].norm()
            likeness = torch.matmul(self.features, self.model.reweight_scale.exp() * whole)
            weights = torch.softmax(likeness, dim=1)
            labels = torch.matmul(weights[:, None], self.features)[:, 0]
            found = self.model.tagging_head(
                encoder_embeds=torch.relu(self.model.wordvec_proj(labels))[None],
                encoder_hidden_states=seen,
                encoder_attention_mask=torch.ones(seen.shape[:2], dtype=torch.long),
                return_dict=False,
                mode="tagging",
            )[0]
            logit = self.model.fc(found)[..., 0]
            return (torch.sigmoid(logit) > self.threshold).to(logit.dtype), logit

    return Tagging().eval()


def export(model: Any, image: Any, path: Path, opset: int) -> None:
    """Write ``model`` to ``path``; ``image`` (1, 3, 384, 384) is the tracing input."""
    import torch

    with torch.no_grad():
        torch.onnx.export(
            module_to_export(model),
            (image,),
            str(path),
            input_names=["image"],
            output_names=["tag", "logit"],
            opset_version=opset,
            do_constant_folding=True,
            dynamo=False,
        )


def main() -> None:
    parser = argparse.ArgumentParser(description="Export RAM++ as an ONNX file with its authors' code.")
    for name in ("checkout", "weights", "folder"):
        parser.add_argument(name, type=Path)
    parser.add_argument("--opset", type=int, required=True)
    asked = parser.parse_args()
    export_all(asked.checkout, asked.weights, asked.folder, asked.opset)


def export_all(checkout: Path, weights: Path, folder: Path, opset: int) -> None:
    """Write all outputs of the program into ``folder``."""
    import onnx
    import torch
    import transformers

    model = build_network(checkout)
    fill(model, read_tensors(weights))
    with np.load(folder / "images.npz", allow_pickle=False) as archive:
        images = torch.from_numpy(archive["images"])
    logit, tag = own_answers(model, images)
    np.savez(folder / "answers.npz", logit=logit, tag=tag, threshold=model.class_threshold.numpy())
    export(model, images[:1], folder / "ram_plus.onnx", opset)
    tags = "".join(f"{tag}\n" for tag in model.tag_list)
    (folder / "ram_tag_list.txt").write_text(tags, encoding="utf-8")
    versions = {module.__name__: str(module.__version__) for module in (torch, transformers, onnx, np)}
    (folder / "versions.json").write_text(json.dumps({"python": sys.version.split()[0], **versions}))


if __name__ == "__main__":
    main()

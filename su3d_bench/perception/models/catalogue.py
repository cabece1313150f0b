"""Every model by its short name: the files that it comes in, from where, under which licence.

Sizes are those of the published weights, in MB of 10^6 bytes; digests stand here only where the publisher or the file's
own address states them. A requirement such as ``tokenizer.json | vocab.json + merges.txt`` names alternatives, the
preferred one first.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Literal

from su3d_bench.core.errors import ConfigError, suggest

Kind = Literal["encoder", "segmenter", "detector", "tagger"]
FormName = Literal["transformers", "open_clip", "original", "onnx"]

HUB = "https://huggingface.co"
ONNX_MANIFEST = "manifest.json"
_HUB_WEIGHTS = "model.safetensors | pytorch_model.bin"
_CLIP_FILES = (_HUB_WEIGHTS, "config.json", "preprocessor_config.json", "tokenizer.json | vocab.json + merges.txt")
_OPEN_CLIP_FILES = ("open_clip_model.safetensors | open_clip_pytorch_model.bin",)  # open_clip brings its own words


@dataclass(frozen=True)
class ModelForm:
    """One set of files in which a model comes; the first of ``files`` is the weights.

    ``repository`` is its name on the Hugging Face hub, ``source`` where a person fetches it; ``architecture`` what
    open_clip calls the model; ``sha256`` by file name; ``is_read`` false: named here to be recognised, not loaded.
    """

    form: FormName
    files: tuple[str, ...]
    source: str
    size_mb: int
    repository: str | None = None
    architecture: str | None = None
    sha256: Mapping[str, str] = field(default_factory=dict, hash=False)
    is_read: bool = True


@dataclass(frozen=True)
class ModelEntry:
    """One model: ``n_parameters_million`` rules the memory that it takes; ``forms`` in the order they are tried.

    ``known_as``: architecture and training in open_clip's words, which protocols and run records use for encoders.
    ``trained_on``: the data of its training, as its publisher names them.
    """

    name: str
    kind: Kind
    summary: str
    licence: str
    n_parameters_million: int
    forms: tuple[ModelForm, ...]
    remark: str = ""
    known_as: str = ""
    trained_on: str = ""

    def memory_mb(self, bytes_a_weight: int) -> int:
        """What the weights alone take on the device, in MB; activations come on top."""
        return self.n_parameters_million * bytes_a_weight

    @property
    def fetched(self) -> ModelForm:
        """The form that ``su3d-bench models fetch`` brings: a publisher's one file where it is read, else the hub's."""
        originals = [form for form in self.forms if form.form == "original" and form.is_read]
        return originals[0] if originals else self.forms[0]

    def form(self, name: FormName) -> ModelForm:
        """The form called ``name``; raises ``ConfigError`` where the model does not come in it."""
        for form in self.forms:
            if form.form == name:
                return form
        known = ", ".join(form.form for form in self.forms)
        raise ConfigError(f"model '{self.name}': does not come in the form '{name}'; known: {known}")


def _hub(repository: str, size_mb: int, files: tuple[str, ...] = _CLIP_FILES) -> ModelForm:
    return ModelForm("transformers", files, f"{HUB}/{repository}", size_mb, repository)


def _open_clip(architecture: str, repository: str, size_mb: int, sha256: Mapping[str, str] | None = None) -> ModelForm:
    source = f"{HUB}/{repository}"
    return ModelForm("open_clip", _OPEN_CLIP_FILES, source, size_mb, repository, architecture, sha256 or {})


def _original(
    file: str, source: str, size_mb: int, sha256: str, repository: str | None = None, is_read: bool = True
) -> ModelForm:
    digests = MappingProxyType({file: sha256})
    return ModelForm("original", (file,), source, size_mb, repository, sha256=digests, is_read=is_read)


def _exported(name: str, size_mb: int) -> ModelForm:
    return ModelForm("onnx", (ONNX_MANIFEST,), f"python tools/export_onnx.py {name} --out DIR", size_mb)


# On what each was trained, with where that was read.
_WIT = "400 million image-text pairs of the internet, not published"  # section 2.2 of CLIP's paper, arXiv 2103.00020
_WEBLI = "English image-text pairs of WebLI, not published"  # the models' cards on the hub
_SA_1B = "SA-1B"  # facebookresearch/segment-anything at dca509fe, README.md: 11 million images, 1.1 billion masks
_TORCHSCRIPT = "OpenAI's own .pt file is a TorchScript archive, which holds code and is not loaded"
_SAM_SOURCE = "https://dl.fbaipublicfiles.com/segment_anything"
_SAM_FILES = (_HUB_WEIGHTS, "config.json", "preprocessor_config.json")
_DINO_FILES = (*_SAM_FILES, "tokenizer.json | vocab.txt")


def _openai_clip(
    name: str, summary: str, n_million: int, size_mb: int, repository: str, architecture: str, timm: str
) -> ModelEntry:
    forms = (
        _hub(f"openai/{repository}", size_mb),
        _open_clip(f"{architecture}-quickgelu", f"timm/{timm}.openai", size_mb),
        _exported(name, size_mb + 1),
    )
    known_as = f"{architecture}/openai"
    return ModelEntry(name, "encoder", summary, "MIT", n_million, forms, _TORCHSCRIPT, known_as, _WIT)


def _siglip(name: str, summary: str, n_million: int, size_mb: int, repository: str, architecture: str) -> ModelEntry:
    hub = _hub(f"google/{repository}", size_mb, (*_CLIP_FILES[:3], "tokenizer.json"))
    forms = (hub, _exported(name, size_mb + 1))
    known_as = f"{architecture}/webli"
    return ModelEntry(name, "encoder", summary, "Apache-2.0", n_million, forms, known_as=known_as, trained_on=_WEBLI)


def _sam(
    letter: str, use: str, n_million: int, sizes_mb: tuple[int, int, int], repository: str, file: str, sha256: str
) -> ModelEntry:
    """``sizes_mb``: as on the hub, as published first, as exported."""
    name, (hub_mb, original_mb, exported_mb) = f"sam-vit-{letter}", sizes_mb
    forms = (
        _hub(f"facebook/{repository}", hub_mb, _SAM_FILES),
        _original(file, f"{_SAM_SOURCE}/{file}", original_mb, sha256),
        _exported(name, exported_mb),
    )
    summary = f"Segment Anything, ViT-{letter.upper()}{use}"
    return ModelEntry(name, "segmenter", summary, "Apache-2.0", n_million, forms, trained_on=_SA_1B)


_ENTRIES = (
    ModelEntry(
        "clip-vit-h-14",
        "encoder",
        "CLIP ViT-H-14 laion2b_s32b_b79k, 1024-d, 224 px: OpenSU3D's, ConceptGraphs', ConceptFusion's",
        "MIT",
        986,
        (
            _hub("laion/CLIP-ViT-H-14-laion2B-s32B-b79K", 3944),
            _open_clip(
                "ViT-H-14",
                "laion/CLIP-ViT-H-14-laion2B-s32B-b79K",
                3944,
                # the hub's pointer of the file
                {"open_clip_pytorch_model.bin": "9a78ef8e8c73fd0df621682e7a8e8eb36c6916cb3c16b291a082ecd52ab79cc4"},
            ),
            _exported("clip-vit-h-14", 3948),
        ),
        known_as="ViT-H-14/laion2b_s32b_b79k",
        trained_on="LAION-2B, English",  # mlfoundations/open_clip at 89fb801f, docs/PRETRAINED.md
    ),
    _openai_clip(
        "clip-vit-l-14",
        "CLIP ViT-L/14 of OpenAI, 768-d, 224 px",
        428,
        1711,
        "clip-vit-large-patch14",
        "ViT-L-14",
        "vit_large_patch14_clip_224",
    ),
    _openai_clip(
        "clip-vit-l-14-336",
        "CLIP ViT-L/14@336px of OpenAI, 768-d, 336 px: OpenMask3D's",
        428,
        1712,
        "clip-vit-large-patch14-336",
        "ViT-L-14-336",
        "vit_large_patch14_clip_336",
    ),
    _openai_clip(
        "clip-vit-b-32",
        "CLIP ViT-B/32 of OpenAI, 512-d, 224 px",
        151,
        605,
        "clip-vit-base-patch32",
        "ViT-B-32",
        "vit_base_patch32_clip_224",
    ),
    _siglip(
        "siglip-base-224", "SigLIP ViT-B/16, 768-d, 224 px", 203, 813, "siglip-base-patch16-224", "ViT-B-16-SigLIP"
    ),
    _siglip(
        "siglip-so400m-384",
        "SigLIP SoViT-400m/14, 1152-d, 384 px",
        878,
        3512,
        "siglip-so400m-patch14-384",
        "ViT-SO400M-14-SigLIP-384",
    ),
    _sam(
        "h",
        ": masks of the paper and of all baselines",
        641,
        (2564, 2565, 2570),
        "sam-vit-huge",
        "sam_vit_h_4b8939.pth",
        "a7bf3b02f3ebf1267aba913ff637d9a2d5c33d3173bb679e46d9f338c26f262e",
    ),
    _sam(
        "l",
        "",
        312,
        (1250, 1250, 1256),
        "sam-vit-large",
        "sam_vit_l_0b3195.pth",
        "3adcc4315b642a4d2101128f611684e8734c41232a17c648ed1693702a49a622",
    ),
    _sam(
        "b",
        "",
        94,
        (375, 375, 380),
        "sam-vit-base",
        "sam_vit_b_01ec64.pth",
        "ec2df62732614e57411cdcf32a23ffdf28910380d03139ee0f4fcbe91eb8c912",
    ),
    ModelEntry(
        "grounding-dino",
        "detector",
        "GroundingDINO swint_ogc: boxes from tags",
        "Apache-2.0",
        172,
        (
            _hub("IDEA-Research/grounding-dino-tiny", 689, _DINO_FILES),
            _original(
                "groundingdino_swint_ogc.pth",
                f"{HUB}/ShilongLiu/GroundingDINO/resolve/main/groundingdino_swint_ogc.pth",
                694,
                "3b3ca2563c77c69f651d7bd133e97139c186df06231157a64c507099c52bc799",
                "ShilongLiu/GroundingDINO",
                is_read=False,
            ),
        ),
        "the original .pth is not loaded; the hub's form holds the same weights",
        trained_on="Objects365, GoldG, Cap4M",  # IDEA-Research/GroundingDINO at 856dde20, README.md
    ),
    ModelEntry(
        "ram-plus",
        "tagger",
        "RAM++ ram_plus_swin_large_14m: tags of an image",
        "Apache-2.0",
        330,  # of the network that runs; the published file holds more than it
        (
            _original(
                "ram_plus_swin_large_14m.pth",
                f"{HUB}/xinyu1205/recognize-anything-plus-model/resolve/main/ram_plus_swin_large_14m.pth",
                3010,
                "497c178836ba66698ca226c7895317e6e800034be986452dbd2593298d50e87d",
                "xinyu1205/recognize-anything-plus-model",
            ),
            # The manifest is none of the files: the script of recognize-anything's pull request 204 writes none.
            ModelForm(
                "onnx",
                ("ram_plus.onnx", "ram_tag_list.txt"),
                "python tools/export_onnx.py ram-plus --checkout DIR --python PYTHON --out DIR",
                1370,
            ),
        ),
        # xinyu1205/recognize-anything at 7cb804a8, README.md
        trained_on="COCO, Visual Genome, SBU, CC3M, CC12M",
    ),
)
MODELS: Mapping[str, ModelEntry] = MappingProxyType({entry.name: entry for entry in _ENTRIES})
# What a profile loads unasked; profiles that are not named load no model of this table.
PROFILE_MODELS: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {"paper": ("clip-vit-h-14", "sam-vit-h", "grounding-dino", "ram-plus")}
)
# What the papers' experiments need beside it: OpenMask3D's set-up encodes with this.
PAPERS_ENCODERS = ("clip-vit-l-14-336",)


def model_entry(name: str, kind: Kind | None = None) -> ModelEntry:
    """The model called ``name``, of ``kind`` where one is asked for; raises ``ConfigError`` for any other name."""
    known = [entry.name for entry in _ENTRIES if kind is None or entry.kind == kind]
    if name not in known:
        what = kind or "model"
        raise ConfigError(f"unknown {what} '{name}'{suggest(name, known)}")
    return MODELS[name]


def encoder_known_as(name: str | None) -> ModelEntry | None:
    """The encoder that protocols and run records call ``name``."""
    return next((entry for entry in _ENTRIES if name and entry.known_as == name and entry.kind == "encoder"), None)

"""Published checkpoints: reading the containers they come in, and the map between their names and ours.

The only place where a pickle is opened, and only with torch's restricted unpickler: tensors and plain containers. Of
the objects that training frameworks leave in their files a short list is replaced by an inert stand-in; anything else
is refused.

`RULES` is the complete map, as text: each row says how a published tensor is called here. `{i}` stands for a number.
"""

from __future__ import annotations

import math
import re
import zipfile
from collections import OrderedDict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import torch
from torch import Tensor

from mudg.base import checkpoint, failures
from mudg.base.errors import InputError
from mudg.base.plain_pickle import PERSISTENT, Maker, Name, PickledObject, read_pickle

# torchscript --------------------------------------------------------------------------------------
# ``torch.jit.load`` would take in code. The archive is a zip, its ``data.pkl`` a pickle that names classes of the
# program and places in ``data/``: the interpreter of ``base/plain_pickle.py`` makes plain objects of them.


def _pairs(text: str) -> list[tuple[str, str]]:
    """Both words of each entry of a list with commas."""
    return [(one, other) for one, other in map(str.split, text.split(", "))]


_STORAGES: Final = {
    f"torch.{name}Storage": getattr(torch, dtype)
    for name, dtype in _pairs(
        "Float float32, Half float16, BFloat16 bfloat16, Double float64, Long int64, Int int32, Short int16, "
        "Char int8, Byte uint8, Bool bool"
    )
}
_BUILDERS: Final = "torch.jit._pickle."
_DEEPEST: Final = 64


class _Names(dict[str, Maker | None]):
    """Names that an archive may mention: classes of its program, storages, and what puts tensors and lists together."""

    def __init__(self) -> None:
        super().__init__(dict.fromkeys((PERSISTENT, *_STORAGES)))
        self |= {"torch._utils._rebuild_tensor_v2": _tensor, "collections.OrderedDict": dict}
        self |= {f"{_BUILDERS}build_{kind}list": lambda items: items for kind in ("int", "double", "bool", "tensor")}
        self[f"{_BUILDERS}restore_type_tag"] = lambda value, _kind: value

    def __contains__(self, name: object) -> bool:
        return super().__contains__(name) or str(name).startswith("__torch__.")

    def __missing__(self, _of_the_program: str) -> None:
        return None


def _tensor(storage: Any, offset: Any, size: Any, stride: Any, *_more: Any) -> PickledObject:
    """A tensor as the archive describes it; its numbers are read later."""
    if not isinstance(storage, PickledObject) or storage.name != PERSISTENT:
        raise ValueError("a tensor without a storage")
    return PickledObject("tensor", (storage, offset, tuple(size), tuple(stride)))


def is_torchscript(path: Path) -> bool:
    """Whether a file is a TorchScript archive."""
    if not path.is_file() or not zipfile.is_zipfile(path):
        return False
    with zipfile.ZipFile(path) as archive:
        names = archive.namelist()
    return any(name.endswith("/constants.pkl") for name in names) and any("/code/" in name for name in names)


def read_torchscript(path: Path) -> dict[str, Tensor]:
    """All tensors of an archive by the attributes that lead to them, such as ``mixed_3b.branch_0.conv3d.weight``.
    InputError: the archive is malformed, or names what no network needs."""
    try:
        with zipfile.ZipFile(path) as archive:
            (index,) = (name for name in archive.namelist() if name.endswith("/data.pkl") and name.count("/") == 1)
            content = read_pickle(archive.read(index), f"{path}: {index}", _Names())
            folder = index.removesuffix("data.pkl") + "data/"
            return {name: _read(archive, folder, found, f"{path}: {name}") for name, found in _leaves(content, "", 0)}
    except (zipfile.BadZipFile, KeyError, ValueError, NotImplementedError) as error:
        what, got = "not a readable TorchScript archive", f"{type(error).__name__}: {error}"[:200]
        raise InputError(what, where=str(path), got=got, remedy="fetch the file again and compare its size") from error


def _leaves(value: Any, name: str, depth: int) -> Iterator[tuple[str, PickledObject]]:
    """Tensors below an object, with their names."""
    if depth > _DEEPEST:
        raise ValueError("objects lie too deep")
    if isinstance(value, PickledObject) and value.name == "tensor":
        yield name, value
        return
    inner = value.state if isinstance(value, PickledObject) else value
    items = inner.items() if isinstance(inner, Mapping) else enumerate(inner) if isinstance(inner, list | tuple) else ()
    for key, entry in items:
        yield from _leaves(entry, f"{name}.{key}" if name else str(key), depth + 1)


def _read(archive: zipfile.ZipFile, folder: str, value: PickledObject, where: str) -> Tensor:
    storage, offset, size, stride = value.arguments
    ((mark, kind, key, _place, count),) = storage.arguments
    known = mark == "storage" and isinstance(kind, Name) and kind.text in _STORAGES
    if not (known and isinstance(key, str) and key.isalnum()):
        raise InputError("a tensor has an unknown storage", where=where, got=repr(storage.arguments)[:120])
    dtype = _STORAGES[kind.text]
    whole = [offset, count, *size, *stride]
    if not all(isinstance(number, int) and number >= 0 for number in whole) or len(size) != len(stride):
        raise InputError("a tensor has an impossible shape", where=where, got=f"{size}, strides {stride}")
    reach = offset + sum((n - 1) * s for n, s in zip(size, stride, strict=True)) + 1 if math.prod(size) else 0
    content = archive.read(folder + key)
    if len(content) != count * dtype.itemsize or reach > count:
        got = f"{len(content)} bytes"
        raise InputError("a tensor does not fit its storage", where=where, expected=f"{count} values", got=got)
    flat = torch.frombuffer(bytearray(content), dtype=dtype) if count else torch.zeros(0, dtype=dtype)
    return flat.as_strided(size, stride, offset).clone()


# names --------------------------------------------------------------------------------------------

_UNET = "model.diffusion_model."
_VAE = "first_stage_model."
_TEXT = "cond_stage_model.model."
_IMAGE = "embedder.model."
_IMAGE_TOKENS = "image_proj_model."


def _at(published: str, clean: str, leaves: Iterable[tuple[str, str]]) -> list[tuple[str, str]]:
    return [(published + a, clean + b) for a, b in leaves]


_RES = _pairs(
    "in_layers.0 norm1, in_layers.2 conv1, emb_layers.1 embed, out_layers.0 norm2, out_layers.3 conv2, "
    "skip_connection skip, temopral_conv.conv1.0 temporal.0.norm, temopral_conv.conv1.2 temporal.0.conv, "
    "temopral_conv.conv2.0 temporal.1.norm, temopral_conv.conv2.3 temporal.1.conv, "
    "temopral_conv.conv3.0 temporal.2.norm, temopral_conv.conv3.3 temporal.2.conv, "
    "temopral_conv.conv4.0 temporal.3.norm, temopral_conv.conv4.3 temporal.3.conv"
)
_ATTENTION = _pairs("to_q query, to_k key, to_v value, to_out.0 out, to_k_ip image_key, to_v_ip image_value")
_TRANSFORMER = (
    *_pairs("norm norm, proj_in enter, proj_out out"),
    *_at("transformer_blocks.0.norm", "block.norm", _pairs("1 1, 2 2, 3 3")),
    *_at("transformer_blocks.0.attn1.", "block.attention1.", _ATTENTION),
    *_at("transformer_blocks.0.attn2.", "block.attention2.", _ATTENTION),
    *_at("transformer_blocks.0.ff.net.", "block.feed.", _pairs("0.proj enter, 2 out")),
)
_VAE_BLOCK = _pairs("norm1 norm1, conv1 conv1, norm2 norm2, conv2 conv2, nin_shortcut skip")
_ENDS = _pairs("conv_in enter, norm_out norm, conv_out leave")
_VAE_MIDDLE = (
    *_at("block_1.", "block1.", _VAE_BLOCK),
    *_at("block_2.", "block2.", _VAE_BLOCK),
    *_at("attn_1.", "attention.", _pairs("norm norm, q query, k key, v value, proj_out out")),
)
_TOWER_BLOCK = _pairs(
    "ln_1.weight norm1.weight, ln_1.bias norm1.bias, ln_2.weight norm2.weight, ln_2.bias norm2.bias, "
    "attn.in_proj_weight query_key_value.weight, attn.in_proj_bias query_key_value.bias, "
    "attn.out_proj.weight out.weight, attn.out_proj.bias out.bias, mlp.c_fc.weight feed_in.weight, "
    "mlp.c_fc.bias feed_in.bias, mlp.c_proj.weight feed_out.weight, mlp.c_proj.bias feed_out.bias"
)


_QUERIES = _pairs("norm1 norm_image, norm2 norm_queries, to_q query, to_kv key_value, to_out out")
_UNET_ENDS = _pairs(
    "time_embed.0 time.0, time_embed.2 time.2, class_embed.0 label.0, class_embed.2 label.2, fps_embedding.0 fps.0, "
    "fps_embedding.2 fps.2, input_blocks.0.0 down.0.conv, input_blocks.{i}.0.op down.{i}.conv, out.0 norm, "
    "output_blocks.{i}.3.conv up.{i}.grow, output_blocks.{i}.1.conv up.{i}.grow, out.2 leave"
)
_VAE_ENDS = _pairs(
    "quant_conv to_moments, post_quant_conv from_latent, encoder.down.{i}.downsample.conv encoder.down.{i}.scale, "
    "decoder.up.{i}.upsample.conv decoder.up.{i}.scale"
)


def _block(published: str, clean: str) -> list[tuple[str, str]]:
    """A residual block and its transformers."""
    parts = (("0.", "res.", _RES), ("1.", "spatial.", _TRANSFORMER), ("2.", "temporal.", _TRANSFORMER))
    return [row for a, b, leaves in parts for row in _at(published + a, clean + b, leaves)]


def _parameters(*groups: Iterable[tuple[str, str]]) -> list[tuple[str, str]]:
    """Each row for its weight and for its bias."""
    return [(f"{a}.{kind}", f"{b}.{kind}") for rows in groups for a, b in rows for kind in ("weight", "bias")]


RULES: tuple[tuple[str, str], ...] = (
    # denoising network
    *_parameters(
        _at(_UNET, "net.", _UNET_ENDS),
        _at(f"{_UNET}init_attn.0.", "net.first.", _TRANSFORMER),
        _block(f"{_UNET}input_blocks.{{i}}.", "net.down.{i}."),
        _at(f"{_UNET}middle_block.0.", "net.middle.res1.", _RES),
        _at(f"{_UNET}middle_block.1.", "net.middle.spatial.", _TRANSFORMER),
        _at(f"{_UNET}middle_block.2.", "net.middle.temporal.", _TRANSFORMER),
        _at(f"{_UNET}middle_block.3.", "net.middle.res2.", _RES),
        _block(f"{_UNET}output_blocks.{{i}}.", "net.up.{i}."),
    ),
    # autoencoder
    *_parameters(
        _at(_VAE, "codec.", _VAE_ENDS),
        *(_at(f"{_VAE}{side}.", f"codec.{side}.", _ENDS) for side in ("encoder", "decoder")),
        *(_at(f"{_VAE}{side}.mid.", f"codec.{side}.middle.", _VAE_MIDDLE) for side in ("encoder", "decoder")),
        _at(f"{_VAE}encoder.down.{{i}}.block.{{j}}.", "codec.encoder.down.{i}.blocks.{j}.", _VAE_BLOCK),
        _at(f"{_VAE}decoder.up.{{i}}.block.{{j}}.", "codec.decoder.up.{i}.blocks.{j}.", _VAE_BLOCK),
    ),
    # towers
    *_at(_TEXT, "text.", _pairs("token_embedding.weight tokens.weight, positional_embedding places")),
    *_at(f"{_TEXT}transformer.resblocks.{{i}}.", "text.blocks.{i}.", _TOWER_BLOCK),
    *_at(f"{_IMAGE}visual.", "image.", _pairs("class_embedding whole, positional_embedding places")),
    (f"{_IMAGE}visual.conv1.weight", "image.patches.weight"),
    *_parameters([(f"{_TEXT}ln_final", "text.norm"), (f"{_IMAGE}visual.ln_pre", "image.norm")]),
    *_at(f"{_IMAGE}visual.transformer.resblocks.{{i}}.", "image.blocks.{i}.", _TOWER_BLOCK),
    # image tokens
    (f"{_IMAGE_TOKENS}latents", "image_tokens.queries"),
    *_parameters(
        _at(_IMAGE_TOKENS, "image_tokens.", _pairs("proj_in enter, proj_out leave, norm_out norm")),
        _at(f"{_IMAGE_TOKENS}layers.{{i}}.0.", "image_tokens.layers.{i}.attention.", _QUERIES),
        _at(f"{_IMAGE_TOKENS}layers.{{i}}.1.", "image_tokens.layers.{i}.feed.", _pairs("0 0, 1 1, 3 3")),
    ),
    # the dynamic rescale table: the one buffer whose values decide
    ("scale_arr", "scale"),
)
"""(published name, our name). Read from the top; the first row that fits holds."""

UNUSED: frozenset[str] = frozenset(
    (
        *(
            "betas alphas_cumprod alphas_cumprod_prev sqrt_alphas_cumprod sqrt_one_minus_alphas_cumprod "
            "log_one_minus_alphas_cumprod sqrt_recip_alphas_cumprod sqrt_recipm1_alphas_cumprod posterior_variance "
            "posterior_log_variance_clipped posterior_mean_coef1 posterior_mean_coef2"
        ).split(),
        *(f"{tower}{name}" for tower in (_TEXT, _IMAGE) for name in ("text_projection", "logit_scale", "attn_mask")),
        *(f"{_IMAGE}{name}" for name in ("positional_embedding", "token_embedding.weight", "visual.proj")),
        *(f"{_IMAGE}{norm}.{kind}" for norm in ("ln_final", "visual.ln_post") for kind in ("weight", "bias")),
    )
)
"""Published names that may be there and are not read: what follows from the schedule, unused parts of the towers."""


_TO_PUBLISHED = [
    (re.compile(re.sub(r"\\{([ij])\\}", r"(?P<\1>\\d+)", re.escape(clean))), published) for published, clean in RULES
]
"""Our names as patterns, with groups for the numbers."""


def published_names(clean: Iterable[str]) -> dict[str, str]:
    """Our names -> published names; InputError: a name that the map does not know. All names of a model are needed: the
    number of what enlarges depends on whether its stage has transformers."""
    names = list(clean)
    known = set(names)
    result = {}
    for name in names:
        for pattern, published in _TO_PUBLISHED:
            found = pattern.fullmatch(name)
            if found is None:
                continue
            if ".{i}.3.conv." in published and f"net.up.{found['i']}.spatial.norm.weight" not in known:
                continue  # no transformers in this stage: the next row's number is the right one
            result[name] = published.format(**found.groupdict())
            break
        else:
            raise InputError("the map of published names lacks a tensor", where="weights.published_names", got=name)
    return result


# containers ---------------------------------------------------------------------------------------


class _Ignored:
    """Stand-in for an object that a training framework left in a checkpoint. Keeps nothing, does nothing."""

    def __init__(self, *_: object, **__: object) -> None: ...

    def __setstate__(self, _: object) -> None: ...


INERT = tuple(
    (
        "omegaconf.dictconfig.DictConfig omegaconf.listconfig.ListConfig omegaconf.base.ContainerMetadata "
        "omegaconf.base.Metadata omegaconf.nodes.AnyNode omegaconf.nodes.IntegerNode omegaconf.nodes.FloatNode "
        "omegaconf.nodes.StringNode omegaconf.nodes.BooleanNode typing.Any builtins.dict builtins.list builtins.tuple "
        "builtins.int builtins.float builtins.str builtins.bool argparse.Namespace numpy.dtype "
        "numpy.core.multiarray.scalar numpy._core.multiarray.scalar "
        "pytorch_lightning.callbacks.model_checkpoint.ModelCheckpoint "
        "lightning.pytorch.callbacks.model_checkpoint.ModelCheckpoint torch.optim.lr_scheduler.LambdaLR "
        "deepspeed.runtime.fp16.loss_scaler.LossScaler deepspeed.runtime.fp16.loss_scaler.DynamicLossScaler "
        "deepspeed.runtime.zero.config.ZeroStageEnum"
    ).split()
)
"""Names in pickles that are replaced by `_Ignored`. Not one of them is imported or called."""

INERT_MAPPINGS: dict[str, Any] = {
    "collections.defaultdict": lambda *_: OrderedDict(),
    "lightning_fabric.utilities.data.AttributeDict": OrderedDict,
    "pytorch_lightning.utilities.parsing.AttributeDict": OrderedDict,
}
"""The same for kinds of mappings, which are filled entry by entry."""

_PREFIXES = ("_forward_module.", "module.", "_orig_mod.")


def read_checkpoint(path: Path) -> dict[str, Tensor]:
    """All named tensors of a published checkpoint, under the names in the file, without wrapper prefixes.

    Understood: a training-framework file (`state_dict` inside), a DeepSpeed file (`module` inside, names that start
    with `_forward_module.`), a plain mapping of names to tensors, safetensors, and a TorchScript archive, of which only
    the tensors are read. Tensors are mapped from the file where its format allows, so that memory is taken as they are
    used. InputError: missing, truncated, or holds objects that are not on the list of harmless ones, or no tensors.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError("no such checkpoint", where=str(path))
    if path.suffix == ".safetensors":
        return _without_prefix(checkpoint.read_tensors(path))
    if is_torchscript(path):
        return _without_prefix(read_torchscript(path))
    content = _unpickle(path)
    found = _named_tensors(content)
    if not found:
        what = "the file holds no named tensors"
        got = ", ".join(map(str, list(content)[:8])) if isinstance(content, Mapping) else type(content).__name__
        raise InputError(what, where=str(path), expected="state_dict, module, or names with tensors", got=got)
    return _without_prefix(found)


def _unpickle(path: Path) -> Any:
    stand_ins: list[Any] = [(_Ignored, name) for name in INERT]
    stand_ins += [(stand_in, name) for name, stand_in in INERT_MAPPINGS.items()]
    try:
        with torch.serialization.safe_globals(stand_ins):
            return torch.load(path, map_location="cpu", weights_only=True, mmap=zipfile.is_zipfile(path))
    except MemoryError:
        raise
    except _UNREADABLE as error:
        text = str(error)
        refused = re.search(r"GLOBAL (\S+)", text)
        if refused is not None:
            what = "the checkpoint holds an object that is neither a tensor nor known to be harmless; it was not loaded"
            expected = "tensors, numbers, text and plain containers"
            remedy = "do not load it elsewhere either, unless you trust its maker; ask for safetensors"
            raise InputError(what, where=str(path), expected=expected, got=refused.group(1), remedy=remedy) from error
        if failures.is_memory(error):
            raise MemoryError(text) from error
        where, expected = str(path), "a complete file written by torch.save, or safetensors"
        got = text.splitlines()[0][:200] if text else type(error).__name__
        remedy = "fetch the file again and compare its size"
        raise InputError("not a readable checkpoint", where=where, expected=expected, got=got, remedy=remedy) from error


_UNREADABLE: tuple[type[Exception], ...] = (
    *(EOFError, RuntimeError, ValueError, LookupError, TypeError, AttributeError, OSError),
    # through torch: this package imports no pickle
    torch.serialization.pickle.UnpicklingError,  # type: ignore[attr-defined]
)


def _named_tensors(content: Any) -> dict[str, Tensor]:
    """The mapping of names to tensors inside whatever a checkpoint file holds."""
    if not isinstance(content, Mapping):
        return {}
    for key in ("state_dict", "module"):
        if isinstance(content.get(key), Mapping):
            return _named_tensors(content[key])
    return {name: value for name, value in content.items() if isinstance(name, str) and isinstance(value, Tensor)}


def _without_prefix(tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    for prefix in _PREFIXES:
        if tensors and all(name.startswith(prefix) for name in tensors):
            return _without_prefix({name[len(prefix) :]: value for name, value in tensors.items()})
    return dict(tensors)


# matching -----------------------------------------------------------------------------------------


def match(state: Mapping[str, Tensor], wanted: Mapping[str, Sequence[int]], where: str) -> dict[str, Tensor]:
    """The tensors of a checkpoint (published name -> tensor) under our names, strictly. wanted: our name -> shape, all
    that the model needs and nothing else. InputError as in ``match_exactly``."""
    published = published_names(wanted)
    known = set(published.values())
    read = {name: value for name, value in state.items() if name in known or name not in UNUSED}
    match_exactly(read, {published[ours]: shape for ours, shape in wanted.items()}, where, "the published model")
    return {ours: state[theirs] for ours, theirs in published.items()}


def refuse_bad_values(tensors: Mapping[str, Tensor], where: str) -> None:
    """InputError for the first tensor that does not hold finite floating-point numbers; ``where``: its file."""
    for name, value in tensors.items():
        if not value.is_floating_point():
            got = str(value.dtype)
            raise InputError("a tensor does not hold floating-point numbers", where=f"{where}: {name}", got=got)
        if not bool(torch.isfinite(value).all()):
            raise InputError("a tensor holds values that are not finite", where=f"{where}: {name}")


def shapes_of(network: torch.nn.Module) -> dict[str, tuple[int, ...]]:
    """Name -> shape of every tensor that a network needs."""
    return {name: tuple(value.shape) for name, value in network.state_dict().items()}


def match_exactly(state: Mapping[str, Tensor], wanted: Mapping[str, Sequence[int]], where: str, network: str) -> None:
    """InputError where names of a checkpoint are missing, unknown, or have another shape than its network needs; the
    first ones of each kind are listed with the counts. ``network``: what to call it."""
    missing = [name for name in wanted if name not in state]
    unexpected = [name for name in state if name not in wanted]
    misshaped = [
        f"{name} {tuple(state[name].shape)} instead of {tuple(shape)}"
        for name, shape in wanted.items()
        if name in state and tuple(state[name].shape) != tuple(shape)
    ]
    if missing or unexpected or misshaped:
        lines = [
            f"{len(names)} {kind}: " + ", ".join(names[:5]) + (", ..." if len(names) > 5 else "")
            for kind, names in (("missing", missing), ("unexpected", unexpected), ("of another shape", misshaped))
            if names
        ]
        what = "the checkpoint is not the network it should be"
        got, remedy = "; ".join(lines), "check that the file is complete and of the right kind"
        raise InputError(what, where=where, expected=f"{len(wanted)} tensors of {network}", got=got, remedy=remedy)

"""Mixed precision where the hardware gains from it."""

import contextlib
from contextlib import AbstractContextManager

import torch as th


def has_fast_bfloat16(device: th.device) -> bool:
    """
    Tell whether bfloat16 is native; emulated, it is far slower than float32 (pytorch issue 118499).

    :param device: where the networks live
    :return: whether to use it
    """
    if device.type == "cuda":
        with th.cuda.device(device):  # for another one may be of another kind
            return th.cuda.is_bf16_supported(including_emulation=False)
    capabilities = th.cpu.get_capabilities() if device.type == "cpu" else {}
    return bool(capabilities.get("avx512_bf16") or capabilities.get("amx_bf16"))


def autocast(device: th.device) -> AbstractContextManager[None]:
    """
    Compute convolutions and matrix products in bfloat16 where that is native.

    Without autocast's cache of converted weights: it would be shared by threads, and outlive a step of the optimiser.

    :param device: where the networks live
    :return: a context, which does nothing elsewhere
    """
    if has_fast_bfloat16(device):
        return th.autocast(device.type, dtype=th.bfloat16, cache_enabled=False)
    return contextlib.nullcontext()


def working_dtype(device: th.device) -> th.dtype:
    """
    Tell what convolutions compute in, so that their inputs are converted once and not by each of them.

    :param device: where the networks live
    :return: the type of :func:`autocast` inside of it, float32 elsewhere
    """
    return th.get_autocast_dtype(device.type) if th.is_autocast_enabled(device.type) else th.float32

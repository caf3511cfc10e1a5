"""Loading a model of unknown origin: JSON values and tensors are read from it, and no code in it is run."""

from collections.abc import Iterator
from contextlib import contextmanager
from types import UnionType
from typing import Any, TypeVar, Union, get_args, get_origin

import torch as th
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.save_util import recursive_getattr
from stable_baselines3.common.type_aliases import GymEnv
from stable_baselines3.common.utils import check_for_correct_spaces
from stable_baselines3.common.vec_env import VecEnv
from torch.nn.modules.module import register_module_parameter_registration_hook

from sb3_esad.common.description import DESCRIPTION, is_pickled, read_setting, settings_of
from sb3_esad.common.optimizers import refuse_misshapen_state
from sb3_esad.common.plain_zip import read_json, read_members, read_tensors, refusal, shown
from sb3_esad.common.save_util import Target, saved_file

Algorithm = TypeVar("Algorithm", bound=OffPolicyAlgorithm)

LARGEST_FILE = 2**30
"""Bytes of a model that may be loaded without trust."""
POLICY, VARIABLES = "policy", "pytorch_variables"
TEXTS = {"data", DESCRIPTION, "_stable_baselines3_version", "system_info.txt"}
ENTRY = 100
"""Bytes that torch needs at least for a tensor beside its numbers."""
PICKLED = object()
"""Stands for a value that is not looked at."""


def load_untrusted(
    algorithm: type[Algorithm],
    path: Target,
    env: GymEnv | None,
    device: th.device | str,
    custom_objects: dict[str, Any] | None,
    **kwargs: Any,
) -> Algorithm:
    """
    Load a saved model as SB3's ``load`` does, without trust in who made it.

    What the file's settings ask for may not be larger than the file. Going on with the training uses these settings, too.

    :param algorithm: class of the model
    :param path: its zip
    :param env: environment to go on with, None to predict only
    :param device: where to compute
    :param custom_objects: take the place of what the file has under their names, which is not looked at then
    :param kwargs: likewise
    :return: the model
    :raises ValueError: if the file holds anything else than plain values and tensors that make such a model
    """
    with saved_file(path, algorithm.__name__) as (file, name):
        content = file.read(LARGEST_FILE + 1)
    try:
        if len(content) > LARGEST_FILE:
            raise refusal(f"it has more than {LARGEST_FILE} bytes")
        return _load(algorithm, read_members(content), env, device, custom_objects or {}, kwargs)
    except Exception as error:  # what is read may be anything
        raise ValueError(f"{name} was not loaded: {_sentence(error)}") from error


def _load(
    algorithm: type[Algorithm],
    members: dict[str, bytes],
    env: GymEnv | None,
    device: th.device | str,
    custom_objects: dict[str, Any],
    kwargs: dict[str, Any],
) -> Algorithm:
    read = _read_values(algorithm, members)
    given = {**{name: value for name, value in custom_objects.items() if name in read}, **kwargs}
    # Not where a stranger wants a log to be written
    values = {**read, "tensorboard_log": None, **given}
    _check("policy_class", values["policy_class"], type)
    model = algorithm(values["policy_class"], env, device=device, _init_setup_model=False)  # type: ignore[call-arg,arg-type]
    kinds = settings_of(model)
    settings = {name: value for name, value in values.items() if name in kinds}
    for name in settings.keys() - given.keys():
        _check(name, settings[name], kinds[name])
    tensors = _read_tensors(members)
    if model.env is not None:
        _check_env(model.env, settings)
        settings["n_envs"] = model.env.num_envs
    vars(model).update(settings | given)
    with _no_larger_than(len(members.get(f"{POLICY}.pth", b""))):
        model._setup_model()
    _restore_counts(model, {name: read[name] for name in read.keys() - settings.keys() - given.keys()})
    _restore_tensors(model, tensors)
    if model.use_sde:
        model.policy.reset_noise()  # type: ignore[operator]  # as SB3 does, for the sake of other devices
    return model


def _read_values(algorithm: type[OffPolicyAlgorithm], members: dict[str, bytes]) -> dict[str, Any]:
    """Read all attributes, pickled ones by their description; spaces and policy are there in any case."""
    description = read_json(members, DESCRIPTION)
    if description.get("class") != algorithm.__name__:
        raise refusal(f"it holds a model of {shown.repr(description.get('class'))}", "load it with the class that saved it")
    described = description.get("settings", {})
    values: dict[str, Any] = {"policy_class": None, "observation_space": None, "action_space": None}
    for name, saved in read_json(members, "data").items():
        plain = read_setting(described[name], algorithm) if name in described else PICKLED
        values[name] = plain if is_pickled(saved) else saved
    return values


def _read_tensors(members: dict[str, bytes]) -> dict[str, Any]:
    """Read all files of tensors, by their names without suffix."""
    tensors = {}
    for name, content in members.items():
        if name.endswith(".pth"):
            with _naming(name):
                tensors[name.removesuffix(".pth")] = read_tensors(content)
        elif name not in TEXTS:
            raise refusal(f"its member {shown.repr(name)} is none that save() writes")
    return tensors


def _check(name: str, value: Any, annotation: Any) -> None:
    """Refuse a setting that is of another type than the constructor's argument."""
    if value is PICKLED:
        remedy = f"pass custom_objects={{{name!r}: ...}}, or trusted=True only if you trust whoever made it"
        raise refusal(f"its key {name!r} is pickled, which may hide code", remedy)
    parts = get_args(annotation) if get_origin(annotation) in (Union, UnionType) else (annotation,)
    kinds = [kind for part in parts if isinstance(kind := get_origin(part) or part, type)]
    if kinds and not isinstance(value, (*kinds, int) if float in kinds else tuple(kinds)):
        wanted = " or ".join(kind.__name__ for kind in kinds)
        raise refusal(f"its key {name!r} is {shown.repr(value)} instead of a value of {wanted}")


def _check_env(env: VecEnv, settings: dict[str, Any]) -> None:
    try:
        check_for_correct_spaces(env, settings["observation_space"], settings["action_space"])
    except ValueError as error:
        raise refusal(str(error), "give an environment like the one that it has learned in") from error


@contextmanager
def _no_larger_than(size: int) -> Iterator[None]:
    """Refuse networks as soon as they need more bytes than the saved ones have."""

    def count(module: th.nn.Module, name: str, parameter: th.nn.Parameter) -> None:
        nonlocal size
        size -= parameter.nbytes + ENTRY
        if size < 0:
            raise refusal(f"its settings ask for larger networks than its member '{POLICY}.pth' has")

    hook = register_module_parameter_registration_hook(count)
    try:
        yield
    finally:
        hook.remove()


def _restore_counts(model: OffPolicyAlgorithm, values: dict[str, Any]) -> None:
    """Restore what training has counted; what else of it was pickled begins anew."""
    for name, value in values.items():
        if name not in vars(model) or name in model._excluded_save_params():
            raise refusal(f"its key {shown.repr(name)} is no attribute of a saved {type(model).__name__}")
        present = vars(model)[name]
        kind = (int, float) if isinstance(present, float) else type(present)
        if isinstance(value, kind) and isinstance(value, bool | int | float | str):
            setattr(model, name, value)
        elif value is not PICKLED and value != present:
            raise refusal(f"its key {name!r} is {shown.repr(value)} instead of a {type(present).__name__}")


def _restore_tensors(model: OffPolicyAlgorithm, tensors: dict[str, Any]) -> None:
    networks, variables = model._get_torch_save_params()
    for name in tensors.keys() ^ {*networks, VARIABLES}:
        kind = "is none of" if name in tensors else "is missing, unlike in"
        raise refusal(f"its member {shown.repr(f'{name}.pth')} {kind} a saved {type(model).__name__}")
    for name in networks:
        with _naming(f"{name}.pth"):
            part = recursive_getattr(model, name)
            part.load_state_dict(tensors[name])
            if isinstance(part, th.optim.Optimizer):
                refuse_misshapen_state(part)
    with _naming(f"{VARIABLES}.pth"):
        _restore_variables(model, variables, tensors[VARIABLES])


def _restore_variables(model: OffPolicyAlgorithm, names: list[str], saved: dict[str, th.Tensor]) -> None:
    if saved.keys() != set(names):
        raise refusal(f"it has {shown.repr(sorted(saved))} instead of {names}")
    for name in names:
        variable = recursive_getattr(model, name)
        if saved[name].shape != variable.shape:
            raise refusal(f"its {name!r} has the shape {tuple(saved[name].shape)} instead of {tuple(variable.shape)}")
        variable.data.copy_(saved[name])


@contextmanager
def _naming(member: str) -> Iterator[None]:
    try:
        yield
    except Exception as error:  # what is read may be anything
        raise ValueError(f"its member {shown.repr(member)} does not fit: {_sentence(error)}") from error


def _sentence(error: Exception) -> str:
    """Give the sentence of an error of ours, and make one of any other."""
    words = "".join(filter(str.isprintable, " ".join(str(error).split())))
    if isinstance(error, ValueError) and words.endswith("."):
        return words
    return str(refusal(f"no model can be made of it ({type(error).__name__}: {words[:200]})"))

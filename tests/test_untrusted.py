"""Models of unknown origin: ours load to the same predictions, and whatever else is in a zip, none of its code is run."""

import copy
import io
import json
import pickle
import re
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from hypothesis import given, settings
from hypothesis import strategies as st
from stable_baselines3 import SAC
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.utils import LinearSchedule

from sb3_esad import ESADLEND
from sb3_esad.common.policies import LatentPolicy
from sb3_esad.wcsac import WCSAC
from tests.conftest import SPACES, TINY, CountingEnv, actions_of, assert_same, make_env
from tests.tampering import (
    Bomb,
    Tampering,
    data_with,
    described,
    member,
    pack,
    pickled,
    policy_kwargs,
    setting,
    tamper,
    torch_file,
    unpack,
    with_pickle,
    without,
    zipped,
)

pytestmark = pytest.mark.usefixtures("nothing_else_happens")


def train(policy: str = "MlpPolicy", **kwargs: Any) -> ESADLEND:
    return ESADLEND(policy, make_env(policy), **{**TINY, "penalty_warmup": 0, "ent_coef": "auto", **kwargs}).learn(32)


def make_wcsac(**kwargs: Any) -> WCSAC:
    tiny: dict[str, Any] = {"policy_kwargs": {"net_arch": [4]}, "buffer_size": 100, "learning_starts": 10, "device": "cpu"}
    return WCSAC("MlpPolicy", make_env(), **{**tiny, **kwargs})


def load(content: bytes, algorithm: Any = ESADLEND, **kwargs: Any) -> Any:
    return algorithm.load(io.BytesIO(content), device="cpu", trusted=False, **kwargs)


def assert_refused(content: bytes, *words: str, **kwargs: Any) -> None:
    """One sentence, on one line, that names the file and whatever else it must."""
    with pytest.raises(ValueError) as error:
        load(content, **kwargs)
    message = str(error.value)
    assert re.fullmatch(r"the given file object was not loaded: [^\n]+\.", message) and message.isprintable(), message
    for word in words:
        assert word in message


@pytest.fixture(scope="module")
def saved() -> bytes:
    return zipped(train())


@pytest.fixture(scope="module")
def fresh() -> bytes:
    """A model that has not learned is smaller."""
    return zipped(ESADLEND("MlpPolicy", make_env(), **TINY))


@pytest.fixture(scope="module")
def fresh_actions(fresh: bytes) -> np.ndarray:
    return actions_of(load(fresh))


# Ours: the same either way


@pytest.mark.parametrize("policy", SPACES)
def test_both_ways_lead_to_the_same_model(policy: str) -> None:
    model = train(policy)
    content = zipped(model)
    mine, theirs = load(content), ESADLEND.load(io.BytesIO(content), device="cpu")
    stock = BaseAlgorithm.load.__func__(ESADLEND, io.BytesIO(content), device="cpu")  # type: ignore[attr-defined]
    assert_same(mine.get_parameters(), theirs.get_parameters())
    for loaded in (mine, theirs, stock):
        np.testing.assert_array_equal(actions_of(loaded), actions_of(model))
    run = {"_last_obs", "_last_episode_starts", "_last_original_obs", "ep_info_buffer", "ep_success_buffer"}
    built = {
        "policy",
        "actor",
        "critic",
        "critic_target",
        "penalty",
        "entropy",
        "replay_buffer",
        "lr_schedule",
        "_episode_costs",
        "_images",
        "_selections",
    }
    for name in vars(theirs).keys() - run - built:
        assert getattr(mine, name) == getattr(theirs, name), name


def test_training_goes_on(saved: bytes) -> None:
    model = load(saved, env=make_env(n_envs=2), tensorboard_log=None)
    assert model.n_envs == 2 and model.num_timesteps == 32
    model.learn(48, reset_num_timesteps=False)
    assert model.num_timesteps == 80 and model._n_updates > load(saved)._n_updates
    assert all(parameter.isfinite().all() for parameter in model.policy.parameters())


def test_another_environment_is_refused(saved: bytes) -> None:
    assert_refused(saved, "Observation spaces do not match", "give an environment like", env=CountingEnv())


def test_paths_and_file_objects(saved: bytes, tmp_path: Path) -> None:
    (tmp_path / "model.zip").write_bytes(saved)
    for path in (str(tmp_path / "model"), tmp_path / "model.zip"):
        assert ESADLEND.load(path, trusted=False).num_timesteps == 32
    with (tmp_path / "model.zip").open("rb") as file:
        assert ESADLEND.load(file, trusted=False).num_timesteps == 32
        assert file.tell() == 0
    with pytest.raises(ValueError, match="There is no file"):
        ESADLEND.load(tmp_path / "other", trusted=False)


def rate_of(model: ESADLEND) -> list[float]:
    return [model.lr_schedule(remaining) for remaining in (1.0, 0.6, 0.2)]


@pytest.mark.parametrize(
    "arguments",
    [
        {},  # the default falls: HoldThenFall
        {"learning_rate": LinearSchedule(0.01, 0.001, 0.8)},
        {"ent_coef": 0.2, "risk_level": np.float32(0.25)},
        {"cost_limit": None, "train_freq": (1, "episode")},
        {"cost_limit": 0.0, "lagrangian_multiplier_init": 3.0, "cost_key": "crashed", "buffer_size": 77},
        {"policy_kwargs": {"net_arch": {"pi": [5], "qf": [6]}, "head_kwargs": {"free_nats": 2.0}}},
    ],
    ids=str,
)
def test_settings_survive(arguments: dict[str, Any]) -> None:
    usual = {name: value for name, value in TINY.items() if name != "learning_rate"}
    model = ESADLEND("MlpPolicy", make_env(), **{**usual, **arguments})
    loaded = load(zipped(model))
    for name in arguments.keys() - {"learning_rate"}:
        assert getattr(loaded, name) == getattr(model, name)
    assert rate_of(loaded) == rate_of(model) and type(loaded.learning_rate) is not type(lambda: 0)
    assert loaded.train_freq == model.train_freq and loaded.cost_limit == model.cost_limit
    assert_same(loaded.penalty.state_dict(), model.penalty.state_dict())
    assert loaded.entropy() == model.entropy()
    assert loaded.replay_buffer.read_costs.cost_key == model.cost_key


def test_arguments_may_be_replaced(saved: bytes) -> None:
    loaded = load(saved, custom_objects={"learning_rate": 0.5, "lr_schedule": None, "unheard_of": 1}, cost_limit=0.7)
    assert loaded.lr_schedule(1) == 0.5 and loaded.cost_limit == loaded.penalty.cost_limit == 0.7
    assert not hasattr(loaded, "unheard_of"), "as in SB3"


def test_the_description_is_plain_and_complete(saved: bytes) -> None:
    def refuse(number: str) -> None:
        raise AssertionError(number)

    description = json.loads(unpack(saved)["sb3_esad.json"], parse_constant=refuse)
    assert description["class"] == "ESADLEND" and description["settings"]["policy_class"] == {"class": "MlpPolicy"}
    assert {"observation_space", "action_space", "train_freq"} <= description["settings"].keys()
    assert description["versions"].keys() == {"sb3_esad", "stable_baselines3", "gymnasium", "torch", "python"}


class MyPolicy(LatentPolicy):
    """A policy without an alias."""


@pytest.mark.parametrize(
    ("name", "arguments"),
    [
        ("action_noise", {"action_noise": NormalActionNoise(np.zeros(1), np.ones(1))}),
        ("learning_rate", {"learning_rate": lambda remaining: 0.1 * remaining}),
        ("policy_kwargs", {"policy_kwargs": {**TINY["policy_kwargs"], "optimizer_class": th.optim.RMSprop}}),
        ("policy_class", {"policy": MyPolicy}),
    ],
)
def test_what_has_no_plain_form_is_asked_for(name: str, arguments: dict[str, Any]) -> None:
    model = ESADLEND(**{"policy": "MlpPolicy", "env": make_env(), **TINY, **arguments})
    content = zipped(model)
    assert_refused(content, f"its key '{name}' is pickled", f"custom_objects={{'{name}': ...}}")
    loaded = load(content, custom_objects={name: getattr(model, name)})
    np.testing.assert_array_equal(actions_of(loaded), actions_of(model))
    assert ESADLEND.load(io.BytesIO(content), device="cpu").num_timesteps == 0


def test_attributes_of_the_user_are_refused_by_name() -> None:
    model = ESADLEND("MlpPolicy", make_env(), **TINY)
    model.note = object()  # type: ignore[attr-defined]
    assert_refused(zipped(model), "'note'", "no attribute of a saved ESADLEND")
    assert load(zipped(model, exclude=["note", "cost_limit"])).cost_limit == 0.05


@pytest.mark.parametrize("arguments", [{}, {"ent_coef": 0.3}, {"use_sde": True}], ids=str)
def test_another_algorithm(arguments: dict[str, Any]) -> None:
    """With variables that are no modules, and networks of SB3."""
    model = make_wcsac(**arguments).learn(20)
    content = zipped(model)
    loaded = load(content, WCSAC, env=make_env())
    assert_same(loaded.get_parameters(), model.get_parameters())
    (variable,) = model._get_torch_save_params()[1]
    assert th.equal(getattr(loaded, variable), getattr(model, variable))
    np.testing.assert_array_equal(actions_of(loaded), actions_of(model))
    loaded.learn(20, reset_num_timesteps=False)
    assert loaded.num_timesteps == 40


# Not ours: a bomb leaves a trace if any code of a zip is run


def test_the_bombs_are_live(fresh: bytes, tmp_path: Path) -> None:
    """Where there is trust, the same pickles do run."""
    ESADLEND.load(io.BytesIO(tamper(fresh, data_with(note=pickled(Bomb(tmp_path / "data"))))), device="cpu")
    th.load(io.BytesIO(torch_file({"a": Bomb(tmp_path / "tensors")})), weights_only=False)
    assert {path.name for path in tmp_path.iterdir()} == {"data", "tensors"}


REBUILT = {"policy_class", "observation_space", "action_space", "train_freq", "replay_buffer_class", "lr_schedule"}
BEGUN_ANEW = {"_last_obs", "_last_episode_starts", "_last_original_obs", "ep_info_buffer", "ep_success_buffer"}
COUNTS = {"num_timesteps", "_n_updates", "_total_timesteps", "start_time", "total_cost"}


def test_code_that_is_not_looked_at(fresh: bytes, fresh_actions: np.ndarray, trace: Path) -> None:
    bombs = {name: pickled(Bomb(trace)) for name in {*REBUILT, *BEGUN_ANEW, *COUNTS, "tensorboard_log"}}
    np.testing.assert_array_equal(actions_of(load(tamper(fresh, data_with(**bombs)))), fresh_actions)


def test_code_in_the_data(fresh: bytes, trace: Path) -> None:
    """Any other pickle is refused by its name."""
    arguments = {name for name in json.loads(unpack(fresh)["data"]) if name[0] != "_"} - REBUILT - BEGUN_ANEW - COUNTS
    assert len(arguments) > 40
    for name in (*arguments - {"tensorboard_log"}, "note", "predict", "__class__", "env", "replay_buffer"):
        assert_refused(tamper(fresh, data_with(**{name: pickled(Bomb(trace))})), repr(name))


FORMS_OF_CODE: dict[str, Callable[[Any], bytes]] = {
    "a pickle": pickle.dumps,
    "a pickle in torch's file": lambda bomb: with_pickle(pickle.dumps(bomb, protocol=2)),
    "an entry of a dictionary": lambda bomb: torch_file({"weight": bomb}),
    "torch's former format": lambda bomb: torch_file({"weight": bomb}, _use_new_zipfile_serialization=False),
}


@pytest.mark.parametrize("form", FORMS_OF_CODE)
def test_code_among_the_tensors(form: str, fresh: bytes, trace: Path) -> None:
    code = FORMS_OF_CODE[form](Bomb(trace))
    names = [name for name in unpack(fresh) if name.endswith(".pth")]
    assert len(names) == 9
    for name in names:
        assert_refused(tamper(fresh, member(name, code)), f"'{name}' does not fit")


def test_code_in_the_description(fresh: bytes, trace: Path) -> None:
    raw = pickle.dumps(Bomb(trace))
    assert_refused(tamper(fresh, lambda members: members.update({"sb3_esad.json": raw})), "'sb3_esad.json' is no JSON")
    for plain in (
        pickled(Bomb(trace)),
        {"class": "Bomb"},
        {"class": "__import__"},
        {"exec": {"source": "1/0"}},
        {"eval": ["1/0"]},
    ):
        assert_refused(tamper(fresh, setting("train_freq", plain)))


def box(shape: list[int]) -> dict[str, Any]:
    return {"Box": {"low": 0, "high": 1, "shape": shape, "dtype": "float32"}}


TAMPERINGS: dict[str, tuple[Tampering, str]] = {
    # Names
    "path traversal": (member("../../evil.pth", torch_file({})), "'../../evil.pth' is none of a saved ESADLEND"),
    "absolute path": (member("/etc/evil", b"x"), "'/etc/evil' is none"),
    "backslashes": (member("..\\evil.pth", torch_file({})), "is none"),
    "attributes of attributes": (member("policy.predict.__func__.__globals__.pth", torch_file({})), "is none"),
    "another network": (member("policy.actor.pth", torch_file({})), "'policy.actor.pth' is none"),
    "a folder": (member("policy/", b""), "'policy/' is none"),
    "an executable": (member("run_me.py", b"1/0"), "'run_me.py' is none"),
    "terminal codes": (member("\x1b[2J\n.pth", torch_file({})), "is none"),
    "terminal codes, and no tensors": (member("\x1b[2J\n.pth", b"x"), "does not fit"),
    "variables of the class": (
        member("pytorch_variables.pth", torch_file({"__class__": th.zeros(1)})),
        "['__class__'] instead of []",
    ),
    # Missing
    "no data": (without("data"), "no member 'data'"),
    "no description": (without("sb3_esad.json"), "no member 'sb3_esad.json'"),
    "no policy": (without("policy.pth"), "larger networks than its member 'policy.pth' has"),
    "no penalty": (without("penalty.pth"), "'penalty.pth' is missing"),
    "no spaces": (described(settings={}), "'policy_class' is pickled"),
    # Not what they should be
    "data is a list": (member("data", b"[]"), "'data' holds [] instead of a JSON object"),
    "data is no text": (member("data", b"\xff\xfe\x00"), "'data' is no JSON"),
    "deep data": (member("data", b"[" * 10**6), "'data' is no JSON"),
    "a number without end": (member("data", b'{"gamma": ' + b"9" * 10**5 + b"}"), "'data' is no JSON"),
    "another class": (described(**{"class": "SAC"}), "holds a model of 'SAC'"),
    "a class that is none": (described(**{"class": ["ESADLEND"]}), "holds a model of ['ESADLEND']"),
    "settings that are none": (described(settings=5), "no model can be made of it"),
    # Attributes
    "a method": (data_with(_setup_model=1), "'_setup_model' is no attribute"),
    "another method": (data_with(predict="x"), "'predict' is no attribute"),
    "the class": (data_with(__class__="x"), "'__class__' is no attribute"),
    "the dictionary": (data_with(__dict__={}), "'__dict__' is no attribute"),
    "an environment": (data_with(env="evil_module:Env-v0"), "'env' is no attribute"),
    "a device": (data_with(device="cuda"), "'device' is no attribute"),
    "a logger": (data_with(_custom_logger=True), "'_custom_logger' is no attribute"),
    "an unknown key": (data_with(note=1), "'note' is no attribute"),
    "a policy by name": (data_with(policy_class="MlpPolicy"), "'policy_class' is 'MlpPolicy'"),
    "a space by name": (data_with(observation_space="Box"), "'observation_space' is 'Box'"),
    "a list for a number": (data_with(batch_size=[1]), "'batch_size' is [1]"),
    "a word for a number": (data_with(gamma="x"), "'gamma' is 'x'"),
    "a dictionary for a number": (data_with(num_timesteps={"a": 1}), "'num_timesteps' is {'a': 1} instead of a int"),
    "a list for nothing": (data_with(_last_obs=[1]), "'_last_obs' is [1] instead of a NoneType"),
    "a discount that is none": (data_with(gamma=float("nan")), "gamma is nan; choose a discount in [0, 1]"),
    "an optimiser by name": (policy_kwargs(optimizer_class="exec"), "no model can be made of it"),
    "an extractor by name": (policy_kwargs(features_extractor_class="exec"), "no model can be made of it"),
    "an unknown policy argument": (policy_kwargs(hook="exec"), "unexpected keyword argument 'hook'"),
    "arguments of the policy given twice": (policy_kwargs(observation_space=1), "no model can be made of it"),
    "arguments of the buffer": (data_with(replay_buffer_kwargs={"device": "cuda"}), "no model can be made of it"),
    "a pickle within a pickle": (policy_kwargs(**{":serialized:": "gASV"}), "'policy_kwargs' is pickled"),
    "a buffer as policy": (setting("policy_class", {"class": "SequenceReplayBuffer"}), "no model can be made of it"),
    "a policy as buffer": (setting("replay_buffer_class", {"class": "MlpPolicy"}), "replay_buffer_class is 'MlpPolicy'"),
    "no actions": (setting("action_space", {"Dict": {}}), "no model can be made of it"),
    # Absurd numbers
    "steps": (data_with(buffer_size=10**13), "MemoryError"),
    "environments": (data_with(n_envs=10**13, buffer_size=10**15), "MemoryError"),
    "no environments": (data_with(n_envs=0), "ZeroDivisionError"),
    "units": (policy_kwargs(net_arch=[10**9]), ""),
    "too many units to multiply": (policy_kwargs(net_arch=[10**9, 10**9]), ""),
    "more units than any number": (policy_kwargs(net_arch=[10**30]), ""),
    "a few units more": (policy_kwargs(net_arch=[2000]), "larger networks"),
    "negative units": (policy_kwargs(net_arch=[-5]), "no model can be made of it"),
    "layers": (policy_kwargs(net_arch=[1] * 10**5), "larger networks"),
    "memory": (policy_kwargs(memory_channels=10**7), "larger networks"),
    "heads": (policy_kwargs(world_model_kwargs={"units": 10**8}), "larger networks"),
    "pixels": (setting("observation_space", box([10**6, 10**6])), "The size of a space is 1000000000000"),
    "a long observation": (setting("observation_space", box([10**6])), "larger networks"),
    "choices": (setting("observation_space", {"Discrete": {"n": 10**15, "start": 0, "dtype": "int64"}}), ""),
    "switches": (setting("observation_space", {"MultiBinary": {"n": 10**12}}), ""),
    "a longer window": (data_with(sequence_length=10**12), "sequence_length is 1000000000000"),
    "candidates": (data_with(n_candidates=10**9), "n_candidates is 1000000000"),
    "steps to look ahead": (data_with(barrier_steps=10**9), "barrier_steps is 1000000000"),
    "proposals": (data_with(n_proposals=10**9), "n_proposals is 1000000000"),
    "steps of diffusion": (policy_kwargs(head_kwargs={"diffusion_steps": 10**9}), "diffusion_steps is 1000000000"),
    "another seed": (data_with(seed=-1), ""),
    # Tensors
    "no tensors": (member("penalty.pth", torch_file(5)), "'penalty.pth' does not fit"),
    "other networks": (member("policy.pth", torch_file({"a": th.zeros(10**6)})), "'policy.pth' does not fit"),
    "smaller networks": (
        member("policy.pth", torch_file({"a": th.zeros(3)})),
        "larger networks than its member 'policy.pth' has",
    ),
    "another penalty": (member("penalty.pth", torch_file({"multiplier": th.zeros(5)})), "'penalty.pth' does not fit"),
    "an empty file": (member("entropy.pth", b""), "'entropy.pth' does not fit: it is cut off or damaged"),
    "half a file": (
        lambda members: members.update({"policy.pth": members["policy.pth"][:5000]}),
        "'policy.pth' does not fit: it is",
    ),
}


@pytest.mark.parametrize("name", ["policy.actor.optimizer.pth", "entropy.optimizer.pth"])
def test_averages_of_another_shape(name: str, saved: bytes) -> None:
    """Fused kernels of torch would write beyond the end of them."""

    def shorten(state: Any) -> Any:
        if isinstance(state, dict):
            return {key: th.zeros(0) if key == "exp_avg" else shorten(each) for key, each in state.items()}
        return [shorten(each) for each in state] if isinstance(state, list) else state

    state = th.load(io.BytesIO(unpack(saved)[name]), weights_only=True)
    assert_refused(tamper(saved, member(name, torch_file(shorten(state)))), f"'{name}' does not fit: The state 'exp_avg'")


@pytest.mark.parametrize("name", TAMPERINGS)
def test_tampered(name: str, fresh: bytes) -> None:
    tampering, words = TAMPERINGS[name]
    assert_refused(tamper(fresh, tampering), words)


# Zips that are not what they seem


def rewritten(content: bytes, change: Callable[[zipfile.ZipFile], Any]) -> bytes:
    """The same zip with another list of its members."""
    file = io.BytesIO(content)
    with zipfile.ZipFile(file, "a") as archive:
        archive._didModify = True  # type: ignore[attr-defined]  # so that the list is written anew
        change(archive)
    return file.getvalue()


def lie_about_size(archive: zipfile.ZipFile) -> None:
    archive.getinfo("data").file_size = 10**12


def lie_about_encryption(archive: zipfile.ZipFile) -> None:
    archive.getinfo("data").flag_bits |= 1


def overlap(archive: zipfile.ZipFile) -> None:
    for i in range(1000):
        same = copy.copy(archive.getinfo("policy.pth"))
        same.filename = same.orig_filename = f"policy{i}.pth"
        archive.filelist.append(same)


@pytest.mark.filterwarnings("ignore:Duplicate name:UserWarning")
def add_twice(archive: zipfile.ZipFile) -> None:
    archive.writestr("data", "{}")


ZIPS: dict[str, tuple[Callable[[bytes], bytes], str]] = {
    "nothing": (lambda content: b"", "it is cut off or damaged"),
    "no zip": (lambda content: b"PK" + bytes(100), "it is cut off or damaged"),
    "a pickle": (lambda content: pickle.dumps({"a": 1}), "it is cut off or damaged"),
    "an empty zip": (lambda content: pack({}), "no member 'sb3_esad.json'"),
    "photos": (lambda content: pack({"holiday.jpg": b"x"}), "no member 'sb3_esad.json'"),
    "compressed": (lambda content: pack(unpack(content), zipfile.ZIP_DEFLATED), "is compressed"),
    "a bomb": (lambda content: pack({**unpack(content), "data": bytes(10**8)}, zipfile.ZIP_DEFLATED), "'data' is compressed"),
    "a bomb in a bomb": (
        lambda content: tamper(content, member("policy.pth", pack({"archive/data.pkl": bytes(10**8)}, zipfile.ZIP_DEFLATED))),
        "'policy.pth' does not fit: its member 'archive/data.pkl' is compressed",
    ),
    "a size that is none": (lambda content: rewritten(content, lie_about_size), "'data' claims to be larger than the file"),
    "encrypted": (lambda content: rewritten(content, lie_about_encryption), "it is cut off or damaged"),
    "members on top of each other": (lambda content: rewritten(content, overlap), "claims to be larger than the file"),
    "the same member twice": (lambda content: rewritten(content, add_twice), "two members 'data'"),
    "names that end early": (
        lambda content: tamper(content, member("data2", b"{}")).replace(b"data2", b"data\0"),
        "two members 'data'",
    ),
    "another algorithm": (lambda content: zipped(make_wcsac()), "holds a model of 'WCSAC'"),
    "SB3's own": (lambda content: zipped(SAC("MlpPolicy", make_env(), buffer_size=10)), "no member 'sb3_esad.json'"),
}


@pytest.mark.filterwarnings("ignore:Duplicate name:UserWarning")
@pytest.mark.parametrize("name", ZIPS)
def test_zips_that_are_not_what_they_seem(name: str, fresh: bytes) -> None:
    change, words = ZIPS[name]
    assert_refused(change(fresh), words)


def test_files_of_any_size_are_not_read(fresh: bytes, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sb3_esad.common.untrusted.LARGEST_FILE", len(fresh) - 1)
    assert_refused(fresh, "it has more than")


HARMLESS: dict[str, Tampering] = {
    "a log elsewhere": data_with(tensorboard_log="/etc"),
    "a discount": data_with(gamma=0.5),
    "a large buffer, of which nothing is filled": data_with(buffer_size=10**9),
    "another version": member("_stable_baselines3_version", b"99"),
    "terminal codes": member("system_info.txt", b"\x1b[2J"),
    "settings that nobody asks for": setting("note", {"HoldThenFall": {"start": 1, "hold": 0}}),
}


@pytest.mark.parametrize("name", HARMLESS)
def test_harmless(name: str, fresh: bytes, fresh_actions: np.ndarray) -> None:
    loaded = load(tamper(fresh, HARMLESS[name]))
    np.testing.assert_array_equal(actions_of(loaded), fresh_actions)
    assert loaded.tensorboard_log is None


def test_nothing_wakes_up_when_it_is_saved_again(fresh: bytes, tmp_path: Path, trace: Path) -> None:
    """A value that is plain to us must not be a pickle to SB3 later."""
    loaded = load(tamper(fresh, data_with(_last_obs=pickled(Bomb(trace)), cost_key=":serialized:")))
    loaded.save(tmp_path / "again")
    assert ESADLEND.load(tmp_path / "again", device="cpu").cost_key == ":serialized:"


# Generated zips: refused in a sentence, or harmless


def attempt(content: bytes) -> Any:
    try:
        return load(content)
    except ValueError as error:
        assert re.fullmatch(r"the given file object was not loaded: [^\n]+\.", str(error)) and str(error).isprintable()
        return None


def assert_harmless(content: bytes) -> None:
    """Refused in a sentence, or a model that acts."""
    loaded = attempt(content)
    if loaded is not None:
        action, _ = loaded.predict(loaded.observation_space.sample(), deterministic=True)
        assert np.size(action) == 1


EDITS = st.lists(
    st.tuples(st.sampled_from(["change", "cut", "insert", "move"]), st.floats(0, 1), st.integers(1, 200), st.integers(1, 255)),
    min_size=1,
    max_size=4,
)


def edited(content: bytes, edits: list[tuple[str, float, int, int]]) -> bytes:
    """The same with some bytes changed, cut out, inserted or moved."""
    changed = bytearray(content)
    for edit, place, n, value in edits:
        start = int(place * max(len(changed) - n, 0))
        part = changed[start : start + n]
        if edit == "change":
            changed[start : start + n % 3 + 1] = bytes(byte ^ value for byte in changed[start : start + n % 3 + 1])
        elif edit == "insert":
            changed[start:start] = bytes([value]) * n
        elif edit == "cut":
            del changed[start : start + (n if n < 150 else len(changed))]
        else:
            del changed[start : start + n]
            changed[value:value] = part
    return bytes(changed)


@given(EDITS)
@settings(max_examples=100, deadline=None)
def test_damaged_zips(fresh: bytes, fresh_actions: np.ndarray, edits: list[tuple[str, float, int, int]]) -> None:
    loaded = attempt(edited(fresh, edits))
    if loaded is not None:  # what is not protected by checksums means nothing
        np.testing.assert_array_equal(actions_of(loaded), fresh_actions)


@given(st.data())
@settings(max_examples=20, deadline=None)
def test_damaged_members(fresh: bytes, data: st.DataObject) -> None:
    """With checksums that are right again."""
    members = unpack(fresh)
    name = data.draw(st.sampled_from(sorted(members)))
    assert_harmless(pack({**members, name: edited(members[name], data.draw(EDITS))}))


JSON_VALUES = st.recursive(
    st.none() | st.booleans() | st.integers(-(10**20), 10**20) | st.floats() | st.text(max_size=5) | st.just(":serialized:"),
    lambda inner: (
        st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5) | st.just(":serialized:"), inner, max_size=3)
    ),
    max_leaves=6,
)


@given(st.data())
@settings(max_examples=25, deadline=None)
def test_any_value_under_any_key(fresh: bytes, trace: Path, data: st.DataObject) -> None:
    names = [*json.loads(unpack(fresh)["data"]), *dir(ESADLEND)]
    value = data.draw(JSON_VALUES | st.just(pickled(Bomb(trace))))
    assert_harmless(tamper(fresh, data_with(**{data.draw(st.sampled_from(names)): value})))


@given(st.data())
@settings(max_examples=25, deadline=None)
def test_any_description(fresh: bytes, trace: Path, data: st.DataObject) -> None:
    plain = json.loads(unpack(fresh)["sb3_esad.json"])["settings"]
    name = data.draw(st.sampled_from(sorted(plain)))
    (kind, arguments), *_ = plain[name].items()
    argument = data.draw(st.sampled_from(sorted(arguments)) if isinstance(arguments, dict) else st.just(""))
    value = data.draw(JSON_VALUES | st.just(pickled(Bomb(trace))))
    changed = {kind: {**arguments, argument: value}} if argument else {kind: value}
    assert_harmless(tamper(fresh, setting(name, changed)))

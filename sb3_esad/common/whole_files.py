"""Saved models and replay buffers that are there as a whole or not at all, and foreign ones that are refused with a reason."""

import io
import pathlib
from collections.abc import Iterable
from typing import Any, ClassVar, TypeVar

import torch as th
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.type_aliases import GymEnv

from sb3_esad.common.cost_buffers import CostBuffer, refuse_other_buffer
from sb3_esad.common.description import add_description
from sb3_esad.common.save_util import check_saved_model, whole_file
from sb3_esad.common.untrusted import load_untrusted

SelfWhole = TypeVar("SelfWhole", bound="WholeFiles")


class WholeFiles(OffPolicyAlgorithm):
    """Saving and loading of an algorithm; by :attr:`saved_marks`, attributes, its models are told from others."""

    saved_marks: ClassVar[tuple[str, ...]]
    replay_buffer: CostBuffer

    def save(
        self,
        path: str | pathlib.Path | io.BufferedIOBase,
        exclude: Iterable[str] | None = None,
        include: Iterable[str] | None = None,
    ) -> None:
        """
        Save the model to a zip that is there as a whole or not at all.

        :param path: where to; ``.zip`` is added to a path without a suffix
        :param exclude: attributes to leave out beside the usual ones
        :param include: attributes to save although they are usually left out
        """
        content = io.BytesIO()
        super().save(content, exclude, include)
        add_description(content, self)
        with whole_file(path, ".zip") as target:
            if isinstance(target, pathlib.Path):
                target.write_bytes(content.getbuffer())
            else:
                target.write(content.getbuffer())

    @classmethod
    def load(
        cls: type[SelfWhole],
        path: str | pathlib.Path | io.BufferedIOBase,
        env: GymEnv | None = None,
        device: th.device | str = "auto",
        custom_objects: dict[str, Any] | None = None,
        print_system_info: bool = False,
        force_reset: bool = True,
        trusted: bool = True,
        **kwargs: Any,
    ) -> SelfWhole:
        """
        Load a saved model; one of unknown origin with ``trusted=False``, for SB3's way runs whatever code is in it.

        Without trust nothing but JSON values and tensors is read. Arguments that have no such form, such as an
        ``action_noise``, a function as ``learning_rate`` or classes in ``policy_kwargs``, are refused unless they are given in
        ``custom_objects``; records of the run, such as the latest episodes, begin anew.

        :param path: its zip; ``.zip`` may be left out
        :param env: environment to go on with; None to predict only
        :param device: where to compute
        :param custom_objects: take the place of what the file has under their names
        :param print_system_info: whether to print where it was saved; with trust only
        :param force_reset: whether to reset the environment first; without trust it always is
        :param trusted: whether code in the file may be run
        :param kwargs: attributes to replace
        :return: the model
        :raises ValueError: if the file is missing, damaged, of another version or holds something else
        """
        if not trusted:
            return load_untrusted(cls, path, env, device, custom_objects, **kwargs)
        check_saved_model(path, cls.__name__, marks=cls.saved_marks)
        try:
            return super().load(path, env, device, custom_objects, print_system_info, force_reset, **kwargs)
        except ValueError:
            raise
        except Exception as error:  # what is read may be anything
            reason = "was saved by another version of sb3_esad, or the arguments given to load() do not fit it"
            # SB3 looks for another cause of a ValueError, in vain, and raises what it stumbles over
            cause = error.__context__ if isinstance(error.__context__, ValueError) else error
            what = f"{type(cause).__name__}: {str(cause).partition(chr(10))[0]}"
            raise ValueError(f"The model in {path} {reason} ({what}).") from error

    def save_replay_buffer(self, path: str | pathlib.Path | io.BufferedIOBase) -> None:
        """
        Save the replay buffer to a file that is there as a whole or not at all.

        :param path: where to; ``.pkl`` is added to a path without a suffix
        """
        with whole_file(path, ".pkl") as target:
            super().save_replay_buffer(target)

    def load_replay_buffer(self, path: str | pathlib.Path | io.BufferedIOBase, truncate_last_traj: bool = True) -> None:
        """
        Load a saved replay buffer; what is asked of it, such as the key of the cost, is what this model asks.

        :param path: file that :meth:`save_replay_buffer` has written
        :param truncate_last_traj: see SB3's ``OffPolicyAlgorithm.load_replay_buffer``
        :raises ValueError: if the buffer is of another kind, or of other environments than the model's
        """
        own = self.replay_buffer
        try:
            super().load_replay_buffer(path, truncate_last_traj)
            loaded = self.replay_buffer
        finally:
            self.replay_buffer = own
        wanted = self._empty_buffer() if own is None else own
        refuse_other_buffer(loaded, wanted)
        loaded.take_settings_of(wanted)
        self.replay_buffer = loaded

    def _empty_buffer(self) -> CostBuffer:
        """What the model would begin with, where the user has dropped its buffer to free the memory."""
        make: Any = self.replay_buffer_class
        place = self.observation_space, self.action_space, self.device, self.n_envs
        return make(self.buffer_size, *place, **self.replay_buffer_kwargs)

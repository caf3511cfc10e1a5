"""Saved models and replay buffers that are there as a whole or not at all, and foreign ones that are refused with a reason."""

import io
import pathlib
from collections.abc import Iterable
from typing import Any, ClassVar, TypeVar

from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_esad.common.cost_buffers import CostBuffer, refuse_other_buffer
from sb3_esad.common.save_util import check_saved_model, whole_file

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
        with whole_file(path, ".zip") as target:
            super().save(target, exclude, include)

    @classmethod
    def load(cls: type[SelfWhole], path: str | pathlib.Path | io.BufferedIOBase, *args: Any, **kwargs: Any) -> SelfWhole:
        """
        Load a saved model.

        :param path: its zip; ``.zip`` may be left out
        :param args: see SB3's ``BaseAlgorithm.load``
        :param kwargs: likewise
        :return: the model
        :raises ValueError: if the file is missing, damaged, of another version or holds something else
        """
        check_saved_model(path, cls.__name__, marks=cls.saved_marks)
        try:
            return super().load(path, *args, **kwargs)
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
        refuse_other_buffer(loaded, own)
        loaded.take_settings_of(own)
        self.replay_buffer = loaded

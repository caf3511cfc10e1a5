"""What would be wrong on a GPU, as far as a CPU can tell."""

from collections.abc import Mapping, Sequence
from typing import Any

import pytest
import torch as th
from torch.utils._python_dispatch import TorchDispatchMode

from sb3_esad import ESADLEND
from sb3_esad.common.multipliers import AugmentedLagrangian
from sb3_esad.common.noise import fixed_seed
from sb3_esad.common.selection import SafetyFilter
from tests.conftest import TINY, CountingEnv

PLACES = (th.ops.aten.nonzero,)
BY_INDEX = (th.ops.aten.index, th.ops.aten.index_put, th.ops.aten.index_put_, th.ops.aten._index_put_impl_)


class Masks(TorchDispatchMode):
    """Counts operations whose result has a size that only the device knows: the host waits for each of them."""

    count = 0

    def __torch_dispatch__(
        self, func: Any, types: Sequence[type], args: Sequence[Any] = (), kwargs: Mapping[str, Any] | None = None
    ) -> Any:
        operation = func.overloadpacket
        masked = operation in BY_INDEX and any(index is not None and index.dtype == th.bool for index in args[1])
        self.count += masked or operation in PLACES
        return func(*args, **(kwargs or {}))


@pytest.mark.parametrize("episode_length", [3, 30])
def test_an_update_waits_as_often_however_many_episodes_begin_in_it(episode_length: int) -> None:
    """Twice, to find where episodes begin."""
    model = ESADLEND("MlpPolicy", CountingEnv(episode_length), **TINY).learn(40)
    for gradient_steps in (1, 3):
        with Masks() as masks:
            model.train(gradient_steps, batch_size=4)
        assert masks.count == 2 * gradient_steps


@pytest.mark.parametrize("filter_start", [None, 0])
def test_a_decision_waits_once_for_what_the_filter_refuses(filter_start: int | None) -> None:
    model = ESADLEND("MlpPolicy", CountingEnv(), filter_start=filter_start, **TINY)
    if isinstance(model.policy.action_filter, SafetyFilter):
        model.policy.action_filter.penalty = Sceptic(cost_limit=0.05)
    with Masks() as masks:
        model.predict(model.observation_space.sample())
    assert masks.count == (0 if filter_start is None else 1)


class Sceptic(AugmentedLagrangian):
    """Finds all critics calibrated, and admits nothing."""

    calibrated = True

    def admissible(self, risk: th.Tensor, barrier: th.Tensor) -> th.Tensor:
        return th.zeros_like(risk, dtype=th.bool)


def test_fixed_numbers_leave_the_others_as_they_are() -> None:
    th.manual_seed(3)
    expected = th.rand(4)
    th.manual_seed(3)
    with fixed_seed(th.device("cpu")):
        fixed = th.rand(2)
    with pytest.raises(KeyError), fixed_seed(th.device("cpu")):
        assert th.equal(th.rand(2), fixed)
        raise KeyError
    assert th.equal(th.rand(4), expected)
